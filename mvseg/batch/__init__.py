"""Scenes from their folders to result folders."""
