"""Surfaces that are known: each instance is fitted once, as long as its masks stay the same."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable

from mvseg.masks import Masks
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.verification.choose import Fit, Surfaces


def fit_once(fit: Fit) -> Fit:
    """The same, but that each instance is fitted once, as long as its masks stay the same."""
    before: dict[str, LeafSurface] = {}

    def fit_new(masks: Masks, known: Surfaces) -> Surfaces:
        return fit_unknown(masks, before, lambda more: fit(masks, {**known, **more})) or {}

    return fit_new


def fit_unknown(
    masks: Masks, before: dict[str, LeafSurface], fit: Callable[[dict[int, LeafSurface]], Surfaces | None]
) -> Surfaces | None:
    """The surfaces of all instances: those of `before` by the names of their masks, and what `fit` makes of the others,
    which is cached there."""
    ids = masks.instance_ids[masks.instance_ids > 0].unique().tolist()
    names = {instance: name_masks(masks, instance) for instance in ids}
    known = {instance: before[name] for instance, name in names.items() if name in before}
    if known and len(known) == len(names):
        return known
    surfaces = fit(known)
    before.update({names[instance]: surface for instance, surface in (surfaces or {}).items()})
    return surfaces


def name_masks(masks: Masks, instance: int) -> str:
    """A name that two instances share only if they have the same masks in the same views, whatever their numbers."""
    return json.dumps(sorted(name_each(masks.select(masks.instance_ids == instance))))


def name_each(masks: Masks) -> list[str]:
    """A name of each mask, that it shares with no other."""
    regions = masks.regions.to("cpu")
    places = zip(regions.view_index.tolist(), regions.boxes.tolist(), strict=True)
    return [
        json.dumps([view, *box, hashlib.sha256(regions.crop(row).numpy().tobytes()).hexdigest()])
        for row, (view, box) in enumerate(places)
    ]
