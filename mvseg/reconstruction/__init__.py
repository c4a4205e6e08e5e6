"""Turns the masks of one instance in several views into its shape in 3D: a surface or voxels."""
