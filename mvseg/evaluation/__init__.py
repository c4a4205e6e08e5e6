"""Measures how good masks, ids and shapes are, against the true ones."""
