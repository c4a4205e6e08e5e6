"""Mask R-CNNs that look at one photo at a time: built by name, loaded from files or from the zoo, run."""

MIN_IMAGE_SIZE, MAX_IMAGE_SIZE = 32, 16_384  # limit: pixels of the longer side that photos are scaled to
