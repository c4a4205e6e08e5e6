"""Mask R-CNNs: built by name, loaded from files or from the zoo, run."""
