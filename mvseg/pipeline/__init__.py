"""The whole method: one file a stage; begin with `run_scene.py`."""
