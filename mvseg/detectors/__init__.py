"""Mask R-CNNs: built by name, loaded from files or from the zoo, run."""

from mvseg.system.torchvision_import import import_torchvision

import_torchvision()
