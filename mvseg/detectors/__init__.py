"""Mask R-CNNs that look at one photo at a time: built by name, loaded from files or from the zoo, run."""
