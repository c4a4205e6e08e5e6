"""Stems: axes of masks that show them, between the bases of leaves, or along thin parts of photos."""
