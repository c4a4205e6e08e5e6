"""Given masks as the views verify them, with surfaces that are known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest
import torch

from mvseg.masks import Masks
from mvseg.matching.config import MatchConfig
from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.scene import Cameras
from mvseg.verification.choose import Edited, Judges, choose_leaves, find_again


def verify_ids(
    masks: Masks,
    surfaces: Mapping[int, LeafSurface] | None = None,
    *,
    cameras: Cameras,
    config: MatchConfig = MatchConfig(),
    edited: Edited | None = None,
) -> Masks:
    """The masks with the ids that hold; None: surfaces are fitted."""

    masks = replace(masks, proposal=torch.arange(len(masks)))

    def fit(regions: Any, ids: torch.Tensor, *others: Any, **more: Any) -> Mapping[int, LeafSurface]:
        is_known = surfaces is not None and torch.equal(ids.cpu(), masks.instance_ids.cpu())
        return surfaces if is_known and surfaces is not None else fit_surfaces(regions, ids, *others, **more)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mvseg.verification.choose.fit_surfaces", fit)
        judges = Judges(cameras.to("cpu"), holds=True, cache={})
        again = find_again(masks.to("cpu"), judges, config)
        tables = {"matched": masks} | ({} if again is None else {"matched again": again})
        return choose_leaves(masks, tables, judges, edited=edited).masks
