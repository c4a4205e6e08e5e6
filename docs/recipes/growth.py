"""A logistic curve of area over time for each leaf of growth.csv, weighted by the standard deviations.

    python growth.py tracks/growth.csv

Prints plant, track, final size, rate and day of the fastest growth of each leaf with five dates or more, and the
standard deviations of the three.
"""

from __future__ import annotations

import csv
import sys
from itertools import groupby
from pathlib import Path

import numpy as np
from scipy.optimize import curve_fit


def main(path: Path) -> None:
    table = csv.DictReader(path.read_text(encoding="utf-8").splitlines())
    rows = [row for row in table if row["trait"] == "area"]
    for leaf, own in groupby(rows, lambda row: (row["plant"], row["track"])):
        time, area, sd = np.array([[float(row[name]) for name in ("time", "value", "sd")] for row in own]).T
        if len(time) >= 5:
            start = (area.max(), 0.5, np.median(time))
            fit, covariance = curve_fit(logistic, time, area, p0=start, sigma=sd, absolute_sigma=True, maxfev=10_000)
            print(*leaf, fit, np.sqrt(np.diag(covariance)))


def logistic(t: np.ndarray, size: float, rate: float, middle: float) -> np.ndarray:
    return size / (1 + np.exp(-rate * (t - middle)))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
