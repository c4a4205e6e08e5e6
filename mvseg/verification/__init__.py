"""Judges masks by the surfaces of leaves: which leaf a mask shows (q), what is a leaf (P), and what was missed."""
