"""How well masks show surfaces: everything of a view drawn once, nearest first. Not in the paper.

A surface is nearer than another as a whole, by the depth of its middle. Stems and pots hide nothing here. Large photos
are compared at every second, third ... pixel: leaves that matter are many pixels wide all the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csc_array

from mvseg.arrays import Bools, Floats, Ints
from mvseg.crop import Crop
from mvseg.formats.photos import ReadPhoto
from mvseg.masks import Masks
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.regions import Regions
from mvseg.scene import Cameras
from mvseg.verification.numbers import COLORS, EVIDENCE


@dataclass(frozen=True, eq=False)
class Drawn:
    """One view: N masks and K surfaces, as the pixels (P,) of the thinned photo that they cover.

    Attributes:
        rows: (N,) int64, the masks of the view, by their rows in the table.
        masks: (P, N) int32 of 0 and 1.
        parts: (P, K) int32, what the surfaces cover as if nothing hid them.
        depth: (K,) of their middles, world units; infinite without a surface.
        colors: (P,) int64, the colour of each pixel but for its lightness, a number below `COLORS.hues` squared; None
            without a photo.
    """

    rows: Ints
    masks: csc_array
    parts: csc_array
    depth: Floats
    colors: Ints | None = None

    @cached_property
    def common(self) -> Floats:
        """(N, K) pixels that a mask and a part share."""
        return np.asarray((self.masks.T @ self.parts).toarray(), np.float64)

    @cached_property
    def is_shared(self) -> Bools:
        """(N, N) whether one covers more than `EVIDENCE.shared` of the smaller one of two masks."""
        areas, both = self.masks.sum(0), (self.masks.T @ self.masks).toarray()
        return np.asarray(both > EVIDENCE.shared * np.maximum(np.minimum(areas[:, None], areas), 1))


@dataclass(frozen=True, eq=False)
class Evidence:
    """How well D masks show K surfaces.

    Attributes:
        visible: (D, K) IoU with the part that nothing nearer hides.
        claimed: (D, K) the same, but hidden pixels that the mask shows count as visible: photos know better what
            lies in front.
        share: (V, K) unhidden share of the surface's image; 0 where it has none.
    """

    visible: Floats
    claimed: Floats
    share: Floats


def draw_views(
    regions: Regions,
    surfaces: Sequence[LeafSurface | None],
    cameras: Cameras,
    *,
    photos: ReadPhoto | None = None,
) -> tuple[Drawn, ...]:
    """V views of D regions and K surfaces, on the CPU. `photos`: for their colours."""
    drawn, all_depths = [], _depths(surfaces, cameras)
    nothing = [Crop((0, 0, 0, 0), torch.zeros(0, 0, dtype=torch.bool))] * len(cameras)
    crops = [nothing if each is None else each.project_parts(cameras) for each in surfaces]
    for view, (width, height) in enumerate(cameras.sizes.tolist()):
        step = -(-max(width, height) // EVIDENCE.most_px)
        size = len(range(step // 2, height, step)), len(range(step // 2, width, step))
        rows = (regions.view_index == view).nonzero()[:, 0].numpy()
        pixels = _columns([regions.placed(row) for row in rows.tolist()], size, step)
        covered = _columns([parts[view] for parts in crops], size, step)
        colors = None if photos is None else _number_colors(photos(view)[step // 2 :: step, step // 2 :: step])
        drawn.append(Drawn(rows=rows, masks=pixels, parts=covered, depth=all_depths[view], colors=colors))
    return tuple(drawn)


def _number_colors(photo: NDArray[np.uint8]) -> Ints:
    lab = cv2.cvtColor(np.ascontiguousarray(photo), cv2.COLOR_RGB2LAB).astype(np.int64) * COLORS.hues // 256
    return np.asarray((lab[..., 1] * COLORS.hues + lab[..., 2]).ravel(), np.int64)


def _depths(surfaces: Sequence[LeafSurface | None], cameras: Cameras) -> Floats:
    depths = np.full((len(cameras), len(surfaces)), np.inf)
    for index, each in enumerate(surfaces):
        if each is not None:
            depths[:, index] = cameras.project(each.points().reshape(-1, 3).mean(0, keepdim=True))[1][:, 0].numpy()
    return depths


def paint_view(surfaces: Mapping[int, LeafSurface], cameras: Cameras, view: int) -> Ints:
    """(H, W), at full size, the instance whose surface each pixel of a view shows, 0 = none. Surfaces that are not
    credible show and hide nothing."""
    width, height = cameras.sizes[view].tolist()
    camera, canvas = cameras[[view]].to("cpu"), np.zeros((height, width), np.int64)
    credible = {instance: each for instance, each in surfaces.items() if each.is_credible}
    names, parts = list(credible), list(credible.values())
    for index in np.argsort(_depths(parts, camera)[0], kind="stable")[::-1].tolist():  # the farthest first
        part = parts[index].project_parts(camera)[0]
        part.cut(canvas)[part.pixels.numpy()] = names[index]
    return canvas


def _columns(crops: Sequence[Crop], size: tuple[int, int], step: int) -> csc_array:
    """(P, N) of masks in their boxes: every `step`-th pixel of the frame, from the middle of the first step on."""
    indices, ends = [np.zeros(0, np.int64)], [0]
    for crop in crops:
        x1, y1, _, _ = crop.box
        first_x, first_y = ((step // 2 - start) % step for start in (x1, y1))
        y, x = np.nonzero(crop.pixels.numpy()[first_y::step, first_x::step])
        indices.append((y + (y1 + first_y) // step) * size[1] + x + (x1 + first_x) // step)
        ends.append(ends[-1] + len(y))
    ones = np.ones(ends[-1], np.int32)
    return csc_array((ones, np.concatenate(indices), np.array(ends)), shape=(size[0] * size[1], len(crops)))


def see(drawn: Sequence[Drawn], num_masks: int, hides: Bools) -> Evidence:
    """The evidence, where the surfaces `hides` (K,) hide what lies behind them, each as a whole, by its middle."""
    shape = num_masks, len(hides)
    visible, claimed = np.zeros((2, *shape))
    share = np.zeros((len(drawn), len(hides)))
    for view, each in enumerate(drawn):
        seen = _unhidden(each, hides)
        sizes, areas = seen.sum(0), each.masks.sum(0)[:, None]
        with_seen = (each.masks.T @ seen).toarray()
        either = np.maximum(areas + sizes - with_seen, 1)
        visible[each.rows], claimed[each.rows] = with_seen / either, each.common / either
        share[view] = sizes / np.maximum(each.parts.sum(0), 1)
    return Evidence(visible=visible, claimed=claimed, share=share)


def _unhidden(drawn: Drawn, hides: Bools) -> csc_array:
    parts, taken = drawn.parts, np.zeros(drawn.parts.shape[0], bool)
    pixels = np.ones(parts.nnz, np.int32)
    for index in np.argsort(drawn.depth, kind="stable").tolist():
        span = slice(parts.indptr[index], parts.indptr[index + 1])
        pixels[span] = ~taken[parts.indices[span]]
        if hides[index]:
            taken[parts.indices[span]] = True
    return csc_array((pixels, parts.indices, parts.indptr), shape=parts.shape)


def see_instances(regions: Regions, surfaces: Mapping[int, LeafSurface], cameras: Cameras) -> Evidence:
    """Evidence of D masks and the credible surfaces; columns are instance ids, from 0 on, 0 where there is nothing."""
    credible = {instance: each for instance, each in surfaces.items() if each.is_credible}
    drawn = draw_views(regions, list(credible.values()), cameras)
    seen, by_id = see(drawn, len(regions), np.ones(len(credible), bool)), {}
    for name, values in vars(seen).items():
        by_id[name] = np.zeros((len(values), 1 + max(surfaces, default=0)))
        by_id[name][:, list(credible)] = values
    return Evidence(**by_id)


def median_parallax(masks: Masks, cameras: Cameras) -> float:
    """Degrees; median over the instances of the largest angle between two lines of sight to their masks; infinite
    without an instance that two views show."""
    boxes = masks.regions.boxes.double()
    centres = torch.cat((boxes[:, :2] + boxes[:, 2:], torch.full_like(boxes[:, :1], 2)), 1) / 2
    sights = (cameras.world_from_px[masks.view_index] @ centres[:, :, None])[..., 0]
    sights = sights / sights.norm(dim=1, keepdim=True)
    angles = []
    for instance in masks.instance_ids[masks.instance_ids > 0].unique().tolist():
        own = sights[masks.instance_ids == instance]
        if len(own) > 1:
            angles.append(torch.rad2deg(torch.acos((own @ own.T).clamp(-1, 1)).max()))
    return float(torch.stack(angles).median()) if angles else float("inf")
