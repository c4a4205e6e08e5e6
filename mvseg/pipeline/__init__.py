"""The whole method: one file a stage, and `run_scene.py` is the page to begin with."""
