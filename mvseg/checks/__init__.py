"""Finds what is wrong with cameras, photos, masks and poses of a scene before anything long runs."""
