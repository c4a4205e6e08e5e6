"""The command `mvseg <verb>`: one file per verb."""

from mvseg.cli.command import main

__all__ = ["main"]
