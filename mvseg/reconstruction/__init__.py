"""From the masks of one instance to its shape in 3D."""
