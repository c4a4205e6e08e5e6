"""Serves pages on which the user corrects: saves each edit at once, and computes again what follows from it."""
