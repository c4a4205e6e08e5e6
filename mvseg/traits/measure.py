"""Traits of a plant and of its leaves, start to finish."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from itertools import chain
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
import torch

from mvseg.errors import check_arguments
from mvseg.formats.photos import Photos
from mvseg.matching.result import Matching
from mvseg.reconstruction.shapes import Surfaces, Voxels, best_shape
from mvseg.reconstruction.stem.slenderness import stem_chances
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.reconstruction.voxels import VoxelGrid
from mvseg.scene import Scene
from mvseg.traits.appearance import measure_appearance
from mvseg.traits.config import TraitsConfig
from mvseg.traits.filters import Kind, Rejection, find_rejected, median_iou
from mvseg.traits.leaf import NEED_UP, Measurement, measure_area, measure_leaf, measure_voxels, missing
from mvseg.traits.nodes import NODE_COLUMNS, NODE_NUMBERS, Stem
from mvseg.traits.ontology import DEFINITIONS, LEAF_TRAITS, UNKNOWN_UNIT, unit_of
from mvseg.traits.plant import measure_whole
from mvseg.traits.stems import StemMark, axes_of_masks, find_stems, judge_stems, up_of_stem
from mvseg.traits.up import level_frame

NO_SURE_VIEWS = missing("not measured: the matcher gives no probabilities")
TILT_DEG = 10.0  # fitted: python -m benchmarks.stems --cache DIR --up; root mean square of lobed plants
NO_NODE = missing("not measured: leaves and photos show no stem that it sits on")
GOOD = "good"
USELESS = {"poor_fit"}  # codes of reasons, by the errors of areas that `python -m benchmarks.traits` prints for each
Use = Literal["yes", "look", "no"]
UpFrom = Literal["scene", "stem", ""]
NO_MASKS = LeafSurface.none(torch.zeros(0, dtype=torch.int64), "no_masks", "has no masks")


@dataclass(frozen=True, eq=False)
class LeafTraits:
    """One instance; `leaf` is its id.

    Attributes:
        numbers: {trait: number} of all `LEAF_TRAITS`.
        method: "surface", "voxels", or "none" for an instance without a shape.
        reasons: {code: sentence} of the reasons to doubt the numbers, or why there are none; empty for a good leaf.
        rejection: kind of the reason why it does not count as a leaf, None where it does.
        unit: of its lengths, "" when unknown.
        probability: that it is a leaf, where the views chose it; None elsewhere.
    """

    leaf: int
    numbers: Mapping[str, Measurement]
    method: str
    reasons: Mapping[str, str]
    rejection: Kind | None
    unit: str = ""
    probability: float | None = None

    @property
    def quality(self) -> str:
        """The reasons in words; "good" without any."""
        return "; ".join(self.reasons.values()) or GOOD

    @property
    def use(self) -> Use:
        """Whether to use its numbers: "yes", "look" at it first, or "no" if it is rejected, has no shape, or its
        surface fits badly. Of voxels, which replace the worst surfaces, "look"."""
        if self.rejection is not None or self.method == "none":
            return "no"
        if self.method != "surface":
            return "look"
        return "no" if USELESS & self.reasons.keys() else "look" if self.reasons else "yes"

    def __repr__(self) -> str:
        area, length = self.numbers["area"], self.numbers["length"]
        if not (area.exists and length.exists):
            return f"leaf {self.leaf}: {self.quality}"
        square, unit = (unit_of(DEFINITIONS[name].kind, self.unit) for name in ("area", "length"))
        return f"leaf {self.leaf}: {area} {square}, {length} {unit} long"


@dataclass(frozen=True, eq=False)
class Traits:
    """All traits of one scene.

    Attributes:
        plant: name of the scene.
        unit: of its lengths, "" when unknown.
        leaves: one entry per instance, by id.
        whole: {trait: number} of all `PLANT_TRAITS`.
        up: unit vector, None when unknown.
        up_from: "scene", or "stem" where nothing else tells up; "" when unknown.
        stems: with their nodes, that of the most leaves first.
    """

    plant: str
    unit: str
    leaves: tuple[LeafTraits, ...]
    whole: Mapping[str, Measurement]
    up: tuple[float, float, float] | None
    stems: tuple[Stem, ...] = ()
    up_from: UpFrom = ""

    def __repr__(self) -> str:
        stems = "" if not self.stems else f", {len(self.stems)} stem" + "s" * (len(self.stems) > 1)
        return f"Traits('{self.plant}': {len(self.leaves)} leaves{stems}, {self.unit or UNKNOWN_UNIT})"

    def table(self) -> dict[str, list[Any]]:
        """Columns with a row per leaf, which `pandas.DataFrame` takes: whether to `use` it, the codes of the `doubts`,
        each trait with its standard deviation, the unit of lengths, the method, the quality in words, and how likely it
        is a leaf, where the views chose it."""
        columns: dict[str, list[Any]] = {
            "plant": [self.plant] * len(self.leaves),
            "leaf": [leaf.leaf for leaf in self.leaves],
            "use": [leaf.use for leaf in self.leaves],
            "doubts": ["; ".join(leaf.reasons) for leaf in self.leaves],
        }
        for trait in LEAF_TRAITS:
            numbers = [leaf.numbers[trait.name] for leaf in self.leaves]
            columns[trait.name] = [number.value for number in numbers]
            if trait.has_sd:
                columns[f"{trait.name}_sd"] = [number.sd for number in numbers]
        columns["unit"] = [self.unit or UNKNOWN_UNIT] * len(self.leaves)
        names = "method", "quality", "probability"
        return columns | {name: [getattr(leaf, name) for leaf in self.leaves] for name in names}

    def node_table(self) -> dict[str, list[Any]]:
        """Columns of nodes.csv with a row per leaf of a stem, by rank, which `pandas.DataFrame` takes."""
        rows: list[tuple[Any, ...]] = []
        for stem in self.stems:
            of_stem = self.unit or UNKNOWN_UNIT, stem.source, stem.probability, *astuple(stem.phyllotaxis)
            for node in stem.nodes:
                counted = stem.number, node.number, node.leaves_per_node, node.rank, node.leaf
                pairs = [(getattr(node, name).value, getattr(node, name).sd) for name in NODE_NUMBERS]
                rows.append((self.plant, *counted, *chain(*pairs), *node.place, *node.base, *of_stem))
        return {name: [row[place] for row in rows] for place, name in enumerate(NODE_COLUMNS)}

    @property
    def rejected(self) -> dict[int, Kind]:
        """{id of an instance that is no leaf to be measured: kind of the reason}."""
        return {leaf.leaf: leaf.rejection for leaf in self.leaves if leaf.rejection is not None}


@check_arguments
def measure_plant(
    scene: Scene,
    matching: Matching,
    *,
    surfaces: Surfaces | None,
    voxels: Voxels,
    photos: Photos | None = None,
    config: TraitsConfig = TraitsConfig(),
    stems: Collection[int] = (),
    probabilities: Mapping[int, float] = MappingProxyType({}),
    stem_marks: Sequence[StemMark] = (),
) -> Traits:
    """Measure all instances, and the plant that those make which count as leaves; on the CPU, wherever the inputs are.

    Args:
        scene: gives unit and the direction of up (None: angles and heights are left out).
        surfaces: {instance id: surface}; None where none were asked for.
        photos: of the scene; None: they are read.
        stems: ids of instances that are stems, as the user says.
        probabilities: {instance id: how likely it is a leaf}, where the views chose it.
        stem_marks: statements of the user about stems, see `judge_stems`.

    Returns:
        The traits; an instance that cannot be measured, or is rejected, has empty numbers that say why.

    Raises:
        InputError: a photo is broken, or missing while others exist.
    """
    instances, masks = range(1, matching.num_instances + 1), matching.masks
    best = {instance: best_shape(instance, surfaces, voxels) for instance in instances}
    every = {instance: shape for instance, shape in best.items() if isinstance(shape, LeafSurface)}
    frame = None if scene.up is None else level_frame(scene.up)
    sure_views = {} if matching.support is None else dict(zip(instances, matching.support.tolist(), strict=True))
    photos = photos or Photos(scene)
    appearance = measure_appearance(every, masks, scene.cameras, photos=photos)
    visible = {instance: numbers["visible_share"].value for instance, numbers in appearance.items()}
    chances = {instance: chance for instance, chance in stem_chances(surfaces or {}).items() if instance not in stems}
    rejected = find_rejected(every, config=config, sure_views=sure_views, visible_shares=visible, stems=chances)
    rejected |= {instance: Rejection("stem", "its masks are of the category of stems") for instance in stems}
    blades = {instance: surface for instance, surface in every.items() if instance not in rejected}
    plant_stems: tuple[Stem, ...] = ()
    if config.stems == "auto":
        ids = sorted(instance for instance, each in rejected.items() if each.kind == "stem")
        of_masks = axes_of_masks({stem: surfaces[stem] for stem in ids if surfaces and stem in surfaces})
        plant_stems = find_stems(blades, masks, scene.cameras, frame=frame, photos=photos, of_masks=of_masks)
        plant_stems = judge_stems(plant_stems, stem_marks, scene.cameras)
    tilt_deg = 0.0
    if frame is None and (upward := up_of_stem(plant_stems, blades, scene.cameras)) is not None:
        frame, tilt_deg = level_frame(upward), TILT_DEG
    ground = extent = 0.0  # heights start from the lowest point of all blades
    if frame is not None and blades:
        points = np.concatenate([surface.points().numpy().reshape(-1, 3) for surface in blades.values()]) @ frame.T
        ground, extent = float(points[:, 2].min()), float(np.ptp(points[:, :2], axis=0).max())
    of_leaf = {node.leaf: node for stem in plant_stems for node in stem.nodes}
    leaves = []
    for instance in instances:
        num_views = len(torch.unique(masks.view_index[masks.instance_ids == instance]))
        numbers = {"num_views": Measurement(float(num_views), float("nan"), "masks"), "sure_views": NO_SURE_VIEWS}
        if instance in sure_views:
            numbers["sure_views"] = Measurement(float(sure_views[instance]), float("nan"), "matching")
        if instance in blades:
            measured = measure_leaf(blades[instance], frame, ground=ground)
            numbers |= tilt(measured, tilt_deg, extent=extent) | appearance[instance]
            numbers["node_height"] = NO_NODE
        if (node := of_leaf.get(instance)) is not None:
            numbers |= {"node_height": node.height, "insertion_angle": node.insertion_angle}
        if instance in voxels and instance not in rejected:
            numbers |= measure_voxels(voxels[instance])
        fitted = None if surfaces is None else surfaces.get(instance, NO_MASKS)
        if fitted is not None and fitted.exists and instance not in blades and instance not in rejected:
            numbers["area"] = measure_area(fitted)
        leaf = describe_leaf(instance, numbers, best[instance], fitted=fitted, rejection=rejected.get(instance))
        leaves.append(replace(leaf, unit=scene.unit, probability=probabilities.get(instance)))
    useless = [leaf.leaf for leaf in leaves if leaf.leaf in blades and leaf.use == "no"]
    whole = measure_whole(blades, frame, num_leaves=len(instances) - len(rejected), useless=useless)
    x, y, z = (0.0, 0.0, 0.0) if frame is None else map(float, frame[2])
    up, whole = None if frame is None else scene.up or (x, y, z), tilt(whole, tilt_deg, extent=extent)
    up_from: UpFrom = "" if frame is None else "scene" if scene.up is not None else "stem"
    return Traits(scene.name, scene.unit, tuple(leaves), whole, up, stems=plant_stems, up_from=up_from)


def tilt(numbers: Mapping[str, Measurement], degrees: float, *, extent: float) -> dict[str, Measurement]:
    """The numbers, with larger deviations for those that need up, where up is that of the stem. The stem leans by so
    many degrees (standard deviation); heights err by that over half of the `extent` of the plant. Unchanged for 0."""
    tilted = dict(numbers)
    for name, number in numbers.items():
        if degrees and number.exists and name in (*NEED_UP, "height"):
            error = degrees if DEFINITIONS[name].kind == "degree" else np.radians(degrees) * extent / 2
            tilted[name] = Measurement(number.value, math.hypot(number.sd, error), f"{number.method}, up from the stem")
    return tilted


def describe_leaf(
    instance: int,
    numbers: Mapping[str, Measurement],
    shape: LeafSurface | VoxelGrid | None,
    *,
    fitted: LeafSurface | None,
    rejection: Rejection | None,
) -> LeafTraits:
    """The leaf with all of its traits, from the `numbers` that were measured; those that are missing with the reason.
    `shape` stands for it; `fitted` is its surface, credible or not, None where no surfaces were asked for; `rejection`
    says why it does not count as a leaf."""
    reasons = {} if fitted is None else dict(fitted.reasons)
    if shape is None and fitted is None:
        reasons = {"no_shape": "has no shape: seen in one view, or its masks agree on no point"}
    if rejection is not None:
        why = f"rejected: {rejection.reason}"
        reasons = {rejection.kind: why, **reasons}
    elif fitted is None:
        why = "no surface was asked for"
    elif isinstance(shape, LeafSurface):
        why = "not measured: only voxels have it"
    else:
        reasons = {"no_surface": "no credible surface", **reasons}
        why = "; ".join(reasons.values())
    of_trait = {trait.name: numbers.get(trait.name, missing(why)) for trait in LEAF_TRAITS}
    if isinstance(shape, LeafSurface):
        of_trait["iou"] = Measurement(median_iou(shape), float("nan"), "; ".join(("surface", *reasons.values())))
    elif shape is not None and (num_parts := shape.num_pieces) > 1:
        reasons["pieces"] = f"in {num_parts} pieces"
        of_trait["iou"] = missing(f"{why}; in {num_parts} pieces")
    method = "none" if shape is None else "surface" if isinstance(shape, LeafSurface) else "voxels"
    kind = None if rejection is None else rejection.kind
    return LeafTraits(leaf=instance, numbers=of_trait, method=method, reasons=reasons, rejection=kind)
