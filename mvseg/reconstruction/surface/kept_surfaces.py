"""Surfaces are kept by the content of their masks: a run fits an instance once, as long as its masks stay the same."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from functools import partial
from types import MappingProxyType

from torch import Tensor

from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.regions import Regions
from mvseg.scene import Cameras
from mvseg.system.running import now_running


def fit_kept(
    regions: Regions,
    instance_ids: Tensor,
    cameras: Cameras,
    *,
    starts: Mapping[int, LeafSurface] = MappingProxyType({}),
    most_views: int | None = None,
    is_rough: bool = False,
) -> dict[int, LeafSurface]:
    """As `fit_surfaces`; where the run keeps what it computed, see `running`, only the instances that it has not fitted
    yet to the same masks, with the same cameras and options. A surface also depends a little on the masks of other
    instances, which may hide it: the one that was fitted first is kept when only these change.

    Args:
        regions: D regions.
        instance_ids: (D,) int64, from 1 on; -1 = no instance.
        cameras: V cameras.
        starts, most_views, is_rough: see `fit_surfaces`; `starts` say where a fit begins, not what it finds.

    Returns:
        {instance id: surface} for every instance.
    """
    fit = partial(
        fit_surfaces, regions, instance_ids, cameras, starts=starts, most_views=most_views, is_rough=is_rough
    )
    kept = now_running().kept
    if kept is None:
        return fit()
    ids = instance_ids[instance_ids > 0].unique().tolist()
    how = f"{most_views} {is_rough}"
    names = {each: name_fit(regions.select(instance_ids == each), cameras, how=how) for each in ids}
    known = {each: kept[name] for each, name in names.items() if name in kept}
    if ids and len(known) == len(ids):
        return known
    surfaces = fit(known=known)
    kept.update({names[each]: surface for each, surface in surfaces.items()})
    return surfaces


def name_fit(regions: Regions, cameras: Cameras, *, how: str) -> str:
    """A name of a surface that is fitted to these masks, with these cameras, in the way that `how` says."""
    return json.dumps([_digest(cameras.px_from_world), how, sorted(name_each(regions))])


def name_each(regions: Regions) -> list[str]:
    """A name of each of D regions, that it shares with no other."""
    regions = regions.to("cpu")
    places = zip(regions.view_index.tolist(), regions.boxes.tolist(), strict=True)
    return [json.dumps([view, *box, _digest(regions.crop(row))]) for row, (view, box) in enumerate(places)]


def _digest(values: Tensor) -> str:
    return hashlib.sha256(values.cpu().numpy().tobytes()).hexdigest()
