"""The version, on its own so that the build can read it and every room may."""

__version__ = "0.1.0"
