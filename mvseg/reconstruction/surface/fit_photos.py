"""Surfaces fitted to their outlines, fitted again to the texture in the photos as well; kept where that is better."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from mvseg.reconstruction.surface.fit_patch import NUM_WARM_STEPS, PatchFit, fit_patch
from mvseg.reconstruction.surface.mask_errors import MaskErrors
from mvseg.reconstruction.surface.mask_stack import MaskStack
from mvseg.reconstruction.surface.photo_consistency import (
    FINE_PX,
    LeafPhotos,
    compare_views,
    crop_photos,
    photo_residuals,
)

LEAST_WIDTH = 25.0  # working pixels, at the widest place: outlines know more of narrower blades than their texture does
LEAST_GAIN = 0.02  # in the agreement of the views
MOST_LOSS = 1.15, 0.01  # the outline may be so many times, and so many working pixels, farther from those of the masks


def fit_photos(
    stacks: Mapping[int, MaskStack],
    fits: Mapping[int, PatchFit],
    photos: Callable[[int], NDArray[np.uint8]],
    *,
    sizes: Sequence[Sequence[int]],
    errors: MaskErrors | None = None,
) -> dict[int, PatchFit]:
    """The fits, each replaced by one in which the views agree better on the texture, if there is one.

    Args:
        stacks: instance id -> its masks.
        fits: instance id -> its fit to their outlines; as many or fewer.
        photos: view index -> (H, W, 3) uint8 RGB; called at most once per view.
        sizes: width and height of each view.
        errors: how the masks err, see `fit_patch`.

    Raises:
        InputError: a photo is of another size.
    """
    crops = crop_photos({instance: stacks[instance] for instance in fits}, photos, sizes=sizes)
    return {
        instance: _fit_leaf(stacks[instance], fit, crops[instance], errors=errors) for instance, fit in fits.items()
    }


def _fit_leaf(masks: MaskStack, fit: PatchFit, photos: LeafPhotos, *, errors: MaskErrors | None) -> PatchFit:
    comparison = compare_views(masks, photos, fit.coefficients, step_px=FINE_PX)
    if comparison.width < LEAST_WIDTH:
        return fit
    other = fit_patch(masks, fit.coefficients, num_steps=NUM_WARM_STEPS, errors=errors, photos=photos)
    before, after = (photo_residuals(comparison, one.coefficients).agreement for one in (fit, other))
    keeps_outline = other.rms_px <= MOST_LOSS[0] * fit.rms_px + MOST_LOSS[1] * masks.enlargement
    return other if after > before + LEAST_GAIN and keeps_outline else fit
