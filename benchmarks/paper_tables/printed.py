"""What the paper prints: tables 1 to 3 of Doi et al., ACCV 2020."""

from __future__ import annotations

VIEWS, LEAVES = (20, 10, 5, 3), (32, 16, 8, 4)  # the columns of tables 1 and 3

# table 1: 20, 10, 5, 3 cameras, 32, 16, 8, 4 leaves, average; the values are averages over all cells of a column
TABLE_1 = {
    "s_match": {
        "MVS-based": (0.935, 0.735, 0.211, 0.215, 0.337, 0.584, 0.543, 0.631, 0.524),
        "Point-based": (0.715, 0.697, 0.521, 0.463, 0.477, 0.497, 0.612, 0.810, 0.599),
        "Sparse": (0.392, 0.488, 0.562, 0.509, 0.376, 0.455, 0.500, 0.620, 0.488),
        "MVIS": (0.905, 0.910, 0.860, 0.856, 0.655, 0.895, 0.987, 0.994, 0.883),
    },
    "e_k": {
        "MVS-based": (1.50, 7.25, 13.25, 9.25, 17.00, 10.00, 3.25, 1.00, 7.81),
        "Point-based": (19.50, 25.75, 4.00, 8.50, 11.75, 16.75, 20.25, 9.00, 14.44),
        "Sparse": (31.00, 26.00, 21.50, 9.25, 15.25, 25.75, 22.25, 24.50, 21.94),
        "MVIS": (2.00, 2.25, 3.00, 2.50, 9.00, 0.75, 0.00, 0.00, 2.44),
    },
}

# table 2: s_match and e_k of the real plant
TABLE_2 = {
    "MVS-based": (0.220, 36),
    "Point-based": (0.239, 34),
    "Sparse": (0.237, 41),
    "MVIS": (0.562, 26),
}

# table 3: 20, 10, 5, 3 cameras averaged over the leaves, then 32, 16, 8, 4 leaves with 10 cameras; None = N/A
TABLE_3 = {
    "MVS points": (0.027, 0.125, None, None, 0.311, 0.111, 0.046, 0.030),
    "Semantic segmentation": (1.593, 1.707, 2.556, 2.068, 1.306, 2.269, 1.396, 1.858),
    "MVIS": (0.077, 0.082, 0.185, 0.129, 0.183, 0.057, 0.046, 0.042),
}
