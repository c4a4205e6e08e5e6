"""Serves pages on which a person corrects: saves each edit at once, and computes again what follows from it."""
