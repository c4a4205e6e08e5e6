"""Readers of masks, one file per format; each gives the masks of one photo, in the frame of the photo."""
