"""The simulated plant that ships with mvseg."""

from importlib.resources import files
from pathlib import Path


def demo_scene() -> Path:
    """The scene folder of a basil-like plant of 12 leaves in 9 views.

    It holds `cameras.json`, `images/`, `masks/` (numbers shuffled per view) and `truth/` (label PNGs with the true ids,
    leaf meshes, traits). Read from it, write elsewhere: it is part of the installation.
    """
    return Path(str(files("mvseg") / "demo_plant"))
