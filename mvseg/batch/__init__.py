"""Scenes from their folders to result folders: one, or a night's plants."""
