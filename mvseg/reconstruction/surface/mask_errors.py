"""How the masks of one segmenter err: each is a little too large or too small as a whole.

The masks of one leaf only show their differences; the best guess is that they are right on average. The differences of
all leaves of a segmenter together show how its errors are spread, and with that each leaf's share is found better:
errors that end sharply at 3 px tell by their extremes, errors with long tails by their middle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from mvseg.arrays import Floats
from mvseg.reconstruction.numbers import ERRORS


@dataclass(frozen=True, eq=False)
class MaskErrors:
    """Symmetric density of how far the masks of a segmenter lie off the true outlines.

    Attributes:
        sd_px: their standard deviation.
        density: (2 G + 1,) per pixel, at -G ... G steps of `ERRORS.step_px`.
    """

    sd_px: float
    density: Floats

    @property
    def share(self) -> float:
        """How much of a measured offset is to be believed: all of it where masks differ by more than is measured."""
        return self.sd_px**2 / (self.sd_px**2 + ERRORS.measured_px**2)

    def centre(self, offsets: Floats) -> tuple[float, float]:
        """Place of offset 0 among the offsets (S,) of one leaf, in pixels, and its standard deviation: of the posterior
        over all places between the smallest and the largest offset."""
        places = np.arange(offsets.min(), offsets.max() + ERRORS.step_px, ERRORS.step_px)
        middle = len(self.density) // 2
        cells = np.round((offsets - places[:, None]) / ERRORS.step_px).astype(int) + middle
        density = self.density[np.clip(cells, 0, 2 * middle)]
        evidence = np.log(density + ERRORS.floor).sum(1)
        weight = np.exp(evidence - evidence.max())
        weight /= weight.sum()
        mean = float(weight @ places)
        return mean, float(np.sqrt(weight @ (places - mean) ** 2 + ERRORS.step_px**2))


def learn_mask_errors(offsets: Sequence[Floats]) -> MaskErrors | None:
    """The spread of the offsets of all masks of a scene: of each leaf, (S,) pixels by which its masks are too large, up
    to a number that they share. None where there are too few masks, or they differ so little that they are clean."""
    if sum(map(len, offsets)) < ERRORS.least_masks:
        return None
    centres = [winsorised_mean(each) for each in offsets]
    errors = _spread(offsets, centres)
    if errors.sd_px < ERRORS.least_spread_px:
        return None
    for _ in range(ERRORS.rounds):
        centres = [errors.centre(each)[0] for each in offsets]
        errors = _spread(offsets, centres)
    return errors


def winsorised_mean(values: Floats) -> float:
    """Mean of (S,) values of which the largest and smallest fifth are pulled in to the next one."""
    ordered = np.sort(values)
    cut = len(values) // 5
    return float(np.clip(values, ordered[cut], ordered[-1 - cut]).mean())


def _spread(offsets: Sequence[Floats], centres: Sequence[float]) -> MaskErrors:
    """Kernel density of the offsets and their negatives, with half of Scott's bandwidth: it may have edges."""
    # Differences to a centre of S values are too small by this factor.
    widen = [np.sqrt(len(each) / max(len(each) - 1, 1)) for each in offsets]
    away = [(each - centre) * by for each, centre, by in zip(offsets, centres, widen, strict=True)]
    sample = np.abs(np.concatenate(away))
    spread = float(np.sqrt((sample**2).mean()))
    bandwidth = max(0.5 * spread * (2 * len(sample)) ** -0.2, ERRORS.measured_px / 2)
    half = int(np.ceil((sample.max() + 4 * bandwidth) / ERRORS.step_px))
    counts = np.bincount(np.round(sample / ERRORS.step_px).astype(int), minlength=half + 1)
    density = counts / (2 * len(sample) * ERRORS.step_px)
    both = np.concatenate([density[:0:-1], density])
    both[half] *= 2
    return MaskErrors(sd_px=spread, density=gaussian_filter1d(both, bandwidth / ERRORS.step_px, mode="constant"))
