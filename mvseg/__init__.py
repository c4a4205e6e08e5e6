"""mvseg: the same instance, with the same id, in every calibrated view and in 3D."""

__version__ = "0.1.0"
