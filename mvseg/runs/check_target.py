"""Accuracy of a whole chain, by the photographed page of `mvseg.formats.target`: its shapes are cut out by their
colour, measured as leaves are, and compared with their true areas."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import torch
from numpy.typing import NDArray
from scipy import ndimage
from skimage.filters import threshold_otsu

from mvseg.arrays import Floats
from mvseg.checks.numbers import IMAGES
from mvseg.errors import InputError, faults_of
from mvseg.formats.label_png import write_label_png
from mvseg.formats.lens import distort
from mvseg.formats.markers import find_scene_markers
from mvseg.formats.photos import Photos, require_photos
from mvseg.formats.scene_folder import load_scene
from mvseg.formats.target import BAR, FAMILY, Shape, list_shapes, tag_corners
from mvseg.pipeline.run_scene import run_scene
from mvseg.poses.alignment import align
from mvseg.reconstruction.numbers import IMAGE
from mvseg.reconstruction.triangulate import triangulate_points
from mvseg.results.plant_files import METRES
from mvseg.results.result import Result
from mvseg.system.running import progress_bar
from mvseg.traits.leaf import missing

NORMAL_95 = 1.96  # definition: standard deviations
# chosen: of lengths; 2 % of areas. More is said to be a wrong scale: printers that fit a page shrink it by 3 %, and
# tags are measured to 0.1 %, so a third more or less changes no verdict about these.
MOST_OFF = 0.01
LUMA = np.array([0.299, 0.587, 0.114])  # brightness as JPEG has it
MOST_OUTSIDE = 1  # chosen: of four: two outside of their 95 % intervals are chance in 1.4 % of sound chains


@dataclass(frozen=True)
class MeasuredShape:
    """One shape of the page.

    Attributes:
        name: see `list_shapes`.
        true_area: as printed, mm^2.
        area, sd: as measured, mm^2; NaN if it was not.
        num_views: how many of its masks were measured together.
        num_masks: its masks, one in each photo that shows it whole.
        method: measured on which shape, or why it was not.
    """

    name: str
    true_area: float
    area: float
    sd: float
    num_views: int
    num_masks: int
    method: str

    @property
    def error(self) -> float:
        """Share of the true area; NaN if it was not measured."""
        return self.area / self.true_area - 1

    @property
    def holds(self) -> bool:
        """Whether the true area is in the 95 % interval of the measured one."""
        return abs(self.area - self.true_area) <= NORMAL_95 * self.sd


@dataclass(frozen=True)
class TargetCheck:
    """Verdict of the photographed page on a chain.

    Attributes:
        num_tags: tags of which a corner is seen in two photos or more.
        scale: lengths of the scene over those of the print, by the tags.
        residual: of the tags' corners from where they are on the print, root mean square, mm.
    """

    shapes: tuple[MeasuredShape, ...]
    num_tags: int
    scale: float
    residual: float

    @property
    def is_right(self) -> bool:
        """Scale right to 1 %, every shape measured, at most one outside of its interval."""
        is_inside = [shape.holds for shape in self.shapes]
        measured = bool(np.isfinite([shape.error for shape in self.shapes]).all())
        return measured and abs(self.scale - 1) <= MOST_OFF and is_inside.count(False) <= MOST_OUTSIDE

    @property
    def verdict(self) -> str:
        errors = np.array([shape.error for shape in self.shapes])
        for shape in self.shapes:
            if np.isnan(shape.error):
                return f"the {shape.name} has no area: {shape.method}"
        at_scale = f"{np.abs((1 + errors) / self.scale**2 - 1).max():.1%} at the scale of the tags"
        if abs(self.scale - 1) > MOST_OFF:
            return (
                f"lengths are {abs(self.scale - 1):.1%} too {'short' if self.scale < 1 else 'long'}: the page was not "
                f"printed at 100 % (measure the bar of {BAR:g} mm, and say --bar), or the scale of the cameras is "
                f"wrong; areas are right to {at_scale}"
            )
        num_inside = sum(shape.holds for shape in self.shapes)
        said = f"{num_inside} of {len(errors)} within their intervals"
        said = f"areas are right to {np.abs(errors).max():.1%} ({at_scale}), {said}"
        return said if self.is_right else f"{said}: they are less certain than their standard deviations say"

    def describe(self) -> dict[str, Any]:
        """Content of target.json: areas in mm^2, errors as shares; null where there is none."""
        shapes = [asdict(shape) | {"error": shape.error, "holds": shape.holds} for shape in self.shapes]
        known = [{key: None if value != value else value for key, value in shape.items()} for shape in shapes]
        return asdict(self) | {"shapes": known, "is_right": self.is_right, "verdict": self.verdict}


def check_target(folder: Path, *, bar: float = BAR) -> TargetCheck:
    """Measure the shapes of the photographed page with the stages of `mvseg infer`.

    The tags tell where shapes are on the photos, and which mask shows which; masks and areas do not. The cameras of the
    scene state the unit of their lengths; `bar` is the length of the printed scale bar, by a ruler, mm: a factor of
    tags and areas. Raises InputError: bad scene; the unit is not known; no tag is seen in two photos; a photo shows no
    whole shape.
    """
    if not 0 < bar < np.inf:
        raise InputError(f"bar is {bar:g}, expected its length in mm, about {BAR:g}")
    scene = load_scene(folder)
    require_photos(scene, folder)
    if scene.unit.lower() not in METRES:
        said = f"their unit is {scene.unit}" if scene.unit else "they say no unit"
        raise InputError(f"{scene.source}: {said}, expected mm, cm or m, as mvseg pose --unit mm states it")
    mm = 1000 * METRES[scene.unit.lower()]
    photos = Photos(scene)
    corners = _find_corners(photos)
    with faults_of(f"{folder}: {len(corners)} corners of the page's tags"):
        places = tag_corners()
        page = np.array([[*places[number][corner], 0] for number, corner in corners])
        alignment = align(page, np.array(list(corners.values())))
    shapes = dict(enumerate(list_shapes(), start=1))
    with tempfile.TemporaryDirectory() as masks:
        for view in progress_bar(range(len(scene.views)), name="masks", unit="photo"):
            labels = _cut_view(photos, view, shapes, alignment.similarity)
            write_label_png(Path(masks) / f"{scene.views[view].name}.png", labels)
        result = run_scene(folder, masks)
    printed = bar / BAR
    return TargetCheck(
        shapes=tuple(_measured(result, shape, label, mm=mm, printed=printed) for label, shape in shapes.items()),
        num_tags=len({number for number, _ in corners}),
        scale=float(alignment.similarity.scale) * mm / printed,
        residual=alignment.rms * mm,
    )


def _find_corners(photos: Photos) -> Mapping[tuple[int, int], Floats]:
    scene, on_page, seen = photos.scene, tag_corners(), find_scene_markers(photos, (FAMILY,))[FAMILY]
    sightings = {corner: places for corner, places in seen.items() if corner[0] in on_page}
    corners = triangulate_points(scene.cameras, sightings)
    if not corners:
        found = "no tag of the page is found in the photos"
        if sightings:
            found = f"{len({number for number, _ in sightings})} tags are found, but the cameras agree on none of them"
        raise InputError(f"{scene.source}: {found}, expected photos of the page that mvseg target writes")
    return corners


def _cut_view(photos: Photos, view: int, shapes: Mapping[int, Shape], world_from_page: pycolmap.Sim3d) -> np.ndarray:
    """(H, W) masks of the shapes whole in a photo, with its lens distortion. Raises InputError: none is there."""
    scene = photos.scene
    camera, size, places = scene.cameras[[view]], scene.cameras.sizes[view].numpy(), {}
    for label, shape in shapes.items():
        points = world_from_page * np.pad(np.concatenate([shape.cell, shape.outline]), ((0, 0), (0, 1)))
        px, depth = (each[0].numpy() for each in camera.project(torch.from_numpy(points)))
        if (depth > 0).all() and (px[4:] > 0).all() and (px[4:] < size).all():
            places[label] = px[:4], px[4:]
    labels = cut_shapes(photos(view), places)
    if not labels.any():
        problem = "none of the page's shapes is found"
        expected = "expected one whole, printed in colour; leave the photo out"
        raise InputError(f"{scene.views[view].path}: view {view}: {problem}, {expected}")
    return np.asarray(distort(labels, scene.views[view].lens, scene.cameras.K[view].numpy()), np.uint16)


def _measured(result: Result, shape: Shape, label: int, *, mm: float, printed: float) -> MeasuredShape:
    is_shape = result.regions.labels == label
    ids = Counter(result.masks.instance_ids[is_shape & (result.masks.instance_ids > 0)].tolist())
    instance, num_views = ids.most_common(1)[0] if ids else (0, 0)
    area = missing("no photos of it fit together" if is_shape.any() else "no photo shows it whole")
    if instance and result.traits is not None:
        area = result.traits.leaves[instance - 1].numbers["area"]
    return MeasuredShape(
        name=shape.name,
        true_area=shape.area * printed**2,
        area=area.value * mm**2,
        sd=area.sd * mm**2,
        num_views=num_views,
        num_masks=int(is_shape.sum()),
        method=area.method,
    )


def cut_shapes(photo: NDArray[np.uint8], places: Mapping[int, tuple[Floats, Floats]]) -> NDArray[np.uint16]:
    """Label map (H, W) of the shapes that were found in one photo (H, W, 3) RGB, 0 where none is. A mask is what
    differs in colour from the paper of its cell. The outline only decides whether it is the shape: its edge plays no
    part in the mask.

    Args:
        places: {label: cell and outline}, where they should be: (4, 2) pixels around the shape and white paper, which
            may lie partly outside; and (P, 2) pixels of the shape, all in the photo.
    """
    height, width = photo.shape[:2]
    labels = np.zeros((height, width), np.uint16)
    for label, (cell, outline) in places.items():
        low, high = np.floor(cell.min(0)), np.ceil(cell.max(0))
        (x1, y1), (x2, y2) = (np.clip(each, 0, (width, height)).astype(int) for each in (low, high))
        part = photo[y1:y2, x1:x2]
        mask = _cut(part, _fill(cell - (x1, y1), part.shape[:2]))
        shape = _fill(outline - (x1, y1), part.shape[:2])
        if (mask & shape).sum() >= IMAGES.least_iou * (mask | shape).sum():
            labels[y1:y2, x1:x2][mask] = label
    return labels


def _cut(part: NDArray[np.uint8], is_cell: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(h, w) bool: the largest piece of a cell that is ink by half or more, by brightness; reflections are filled."""
    light = ((part + 1.0) / 256) ** IMAGES.gamma
    lack = 1 - 2 * light[..., 1] / (light[..., 0] + light[..., 2])  # of green, in any light and shade: magenta
    is_ink = lack > threshold_otsu(lack[is_cell])
    if not (is_ink & is_cell).any():  # grey all over
        return is_ink & is_cell
    colors = np.stack([np.median(light[is_cell & where], 0) for where in (~is_ink, is_ink)])
    strength = cv2.GaussianBlur((light @ np.linalg.pinv(colors)).sum(2), (0, 0), IMAGES.smooth_px).clip(0)
    half = colors.mean(0) ** (1 / IMAGES.gamma) @ LUMA
    pieces, count = ndimage.label((part / 255 @ LUMA < half * strength ** (1 / IMAGES.gamma)) & is_cell)
    sizes = np.bincount(pieces.ravel(), minlength=count + 1)
    sizes[0] = 0
    return np.asarray(ndimage.binary_fill_holes(pieces == sizes.argmax()))


def _fill(polygon: Floats, size: tuple[int, int]) -> NDArray[np.bool_]:
    filled = np.zeros(size, np.uint8)
    corners = np.round((polygon - 0.5) * (1 << IMAGE.sub_pixel_bits)).astype(np.int32)
    return np.asarray(cv2.fillPoly(filled, [corners], 1, shift=IMAGE.sub_pixel_bits), bool)
