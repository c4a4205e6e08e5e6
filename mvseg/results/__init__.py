"""Writes the result folder, whole or not at all, and reads it back; draws the pictures and the page in it."""
