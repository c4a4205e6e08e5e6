"""How slender instances are for their plant: stems are, leaves are not."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.special import expit

from mvseg.reconstruction.numbers import STEM
from mvseg.reconstruction.surface.leaf_surface import LeafSurface


def stem_chances(surfaces: Mapping[int, LeafSurface]) -> dict[int, float]:
    """{id: how likely it is a stem} of all that have a surface: by length over width, over the median of the plant.
    Leaves that are long and narrow are so on the whole plant."""
    aspects = {instance: each.length / each.width for instance, each in surfaces.items() if each.exists}
    usual = np.median(list(aspects.values())) if aspects else 1.0
    return {
        instance: float(expit(np.log(aspect / usual / STEM.stem_aspect) / STEM.aspect_scale))
        for instance, aspect in aspects.items()
    }
