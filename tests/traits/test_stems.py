from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from blade_scene import SIZE, ring_cameras
from known_leaves import bent_blade, flat_leaf, move, turn_about
from mvseg.errors import InputError
from mvseg.masks import Masks
from mvseg.reconstruction.stem.leaf_bases import axes_of_bases, find_ends
from mvseg.reconstruction.stem.slenderness import stem_chances
from mvseg.reconstruction.stem.stem_axis import StemAxis, sweep_circle
from mvseg.reconstruction.stem.stem_path import find_path
from mvseg.reconstruction.stem.thin_parts import ThinView, find_cells, see_thin, share_of_views
from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.regions import regions_from_label_maps
from mvseg.results.plant_graph import plant_graph
from mvseg.traits.leaf import Measurement, missing
from mvseg.traits.measure import LeafTraits, Traits
from mvseg.traits.nodes import Stem, group_leaves
from mvseg.traits.stems import MaskAxis, StemMark, axes_of_masks, find_stems, judge_stems, up_of_stem
from mvseg.traits.table import read_nodes, write_nodes
from mvseg.traits.up import level_frame
from tube_scene import BENT, T, tube_masks
from warned import warns_of

UP = np.array([0.0, 0.0, 1.0])
CAMERAS = ring_cameras(8, distance=600.0)
PETIOLE = 9.0


class NoPhotos:
    exist = False


NO_PHOTOS = NoPhotos()


def leaf_at(height: float, azimuth: float, *, petiole: float = PETIOLE, x: float = 0.0) -> LeafSurface:
    """A leaf of 40 that leaves a vertical stem at x; its petiole rises by 7 degrees, as its chord does."""
    out = petiole * np.array([np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth)), np.tan(np.radians(7))])
    return move(bent_blade(), turn_about(UP, azimuth), shift=(out[0] + x, out[1], out[2] + height))


def plant_of(azimuths: Callable[[int], float], heights: Callable[[int], float]) -> dict[int, LeafSurface]:
    """Eight leaves with mixed ids."""
    return {(5 * n) % 11 + 1: leaf_at(heights(n), azimuths(n)) for n in range(8)}


def stems_of(
    leaves: dict[int, LeafSurface], up: np.ndarray | None = UP, photos: object = NO_PHOTOS
) -> tuple[Stem, ...]:
    regions = regions_from_label_maps([np.zeros((SIZE, SIZE), np.int64)] * len(CAMERAS))
    frame = None if up is None else level_frame(up)
    return find_stems(leaves, Masks.of(regions), CAMERAS, frame=frame, photos=photos)  # type: ignore[arg-type]


PLANTS = {
    "distichous": (180.0, plant_of(lambda n: 30 + 180 * n, lambda n: 20.0 * n)),
    "spiral": (137.5, plant_of(lambda n: 30 - 137.5 * n, lambda n: 20.0 * n)),
    "decussate": (90.0, plant_of(lambda n: 10 + 180 * (n % 2) + 90 * (n // 2), lambda n: 30.0 * (n // 2) + n % 2)),
}


@pytest.mark.parametrize("name", PLANTS)
@pytest.mark.parametrize("up", [UP, None], ids=["up", "no up"])
def test_leaves_are_ordered_along_their_stem(name: str, up: np.ndarray | None) -> None:
    angle, leaves = PLANTS[name]
    (stem,) = stems_of(leaves, up)
    assert stem.source == "leaf bases"
    assert (stem.phyllotaxis.name, stem.phyllotaxis.angle) == (name, angle)
    assert stem.phyllotaxis.probability > 0.9
    assert [node.rank for node in stem.nodes] == list(range(1, 9))
    per_node = 2 if name == "decussate" else 1
    assert [node.number for node in stem.nodes] == [1 + rank // per_node for rank in range(8)]
    assert {node.leaves_per_node for node in stem.nodes} == {per_node}
    order = [node.leaf for node in stem.nodes]
    pairs = [{*order[n : n + 2]} for n in range(0, 8, 2)]
    assert pairs == [{(5 * n) % 11 + 1, (5 * n + 5) % 11 + 1} for n in range(0, 8, 2)]
    heights = [node.height.value for node in stem.nodes]
    assert heights == sorted(heights)
    expected = {"decussate": 30.0, "spiral": 20.0, "distichous": 20.0}[name]
    steps = np.diff(heights[::2] if name == "decussate" else heights)
    assert steps == pytest.approx(expected, abs=1.5)
    assert (np.abs(np.array([node.place for node in stem.nodes])[:, :2]) < 3).all()
    assert all(abs(node.insertion_angle.value - 90) < 12 for node in stem.nodes)
    divergences = [node.divergence.value for node in stem.nodes[1:]]
    if name != "decussate":
        assert divergences == pytest.approx([angle] * 7, abs=6)
    assert not stem.nodes[0].internode.exists
    assert not stem.nodes[0].divergence.exists
    if name == "spiral" and up is not None:  # azimuths are those of the level frame
        off = np.array([node.node_azimuth.value for node in stem.nodes]) - 30 + 137.5 * np.arange(8)
        assert np.abs(np.exp(1j * np.radians(off)) - 1).max() < 0.1


@pytest.mark.parametrize("seed", [0, 1])
def test_a_turned_and_scaled_world_has_the_same_nodes(seed: int) -> None:
    turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    leaves = PLANTS["spiral"][1]
    (first,) = stems_of(leaves)
    moved = {leaf: move(each, turn, scale=3.0, shift=(1000, -50, 7)) for leaf, each in reversed(leaves.items())}
    (other,) = stems_of(moved, turn @ UP)
    assert [node.leaf for node in other.nodes] == [node.leaf for node in first.nodes]
    for one, two in zip(first.nodes, other.nodes, strict=True):
        assert two.height.value / 3 == pytest.approx(one.height.value, abs=0.3)
        assert two.height.sd / 3 == pytest.approx(one.height.sd, rel=0.1)


def test_a_leaf_that_was_taken_the_wrong_way_round_is_turned() -> None:
    from mvseg.reconstruction.surface.orientation import _transform, reversal_matrix

    leaves = dict(PLANTS["spiral"][1])
    leaves[1] = _transform(leaves[1], reversal_matrix())
    (stem,) = stems_of(leaves)
    assert len(stem.nodes) == 8
    (axis,) = axes_of_bases(leaves, UP)
    first, second = find_ends(leaves)
    expected = np.where((first.ids == 1)[:, None], second.points, first.points)
    np.testing.assert_array_equal(axis.bases.points, expected)


def test_two_stems_have_their_own_leaves() -> None:
    first = {n + 1: leaf_at(25.0 * n, 137.5 * n) for n in range(5)}
    second = {n + 6: leaf_at(25.0 * n, 20 + 180.0 * n, x=180.0) for n in range(4)}
    stems = stems_of(first | second)
    assert [sorted(node.leaf for node in stem.nodes) for stem in stems] == [[1, 2, 3, 4, 5], [6, 7, 8, 9]]
    assert [stem.number for stem in stems] == [1, 2]


def test_no_stem_where_leaves_do_not_agree_or_it_hardly_rises() -> None:
    assert stems_of({}) == ()
    assert stems_of({1: leaf_at(0, 0), 2: leaf_at(20, 180)}) == ()
    rosette = {n + 1: leaf_at(0.2 * n, 137.5 * n) for n in range(8)}
    assert stems_of(rosette) == ()
    rng = np.random.default_rng(3)
    turns = [turn_about(rng.normal(size=3), 360 * rng.random()) for _ in range(8)]
    strewn = {n + 1: move(bent_blade(), turn, shift=tuple(rng.normal(0, 300, 3))) for n, turn in enumerate(turns)}
    assert stems_of(strewn) == ()
    leaves = PLANTS["spiral"][1]
    for lean, num_stems in ((30, 1), (60, 0)):
        turned = {leaf: move(surface, turn_about(np.array([1.0, 0, 0]), lean)) for leaf, surface in leaves.items()}
        assert len(stems_of(turned)) == num_stems


class Drawn:
    """Photos of dark vertical lines, each at an x."""

    exist = True

    def __init__(self, *lines: float) -> None:
        self.lines = [np.stack([x + 0 * T, 0 * T, 150 * T - 5], 1) for x in lines]

    def __call__(self, view: int) -> np.ndarray:
        return draw_lines(self.lines, 3, CAMERAS.px_from_world.numpy()[view])


@pytest.mark.parametrize("lean", [0, 20])
def test_where_nothing_else_says_which_way_is_up_a_stem_does_that_is_shown(lean: float) -> None:
    turn = turn_about(np.array([1.0, 0, 0]), lean)
    leaves = {leaf: move(surface, turn) for leaf, surface in PLANTS["spiral"][1].items()}
    stems = stems_of(leaves, None)
    assert up_of_stem(stems, leaves, CAMERAS) is None  # of leaf bases alone
    shown = tuple(replace(stem, tells_up=True) for stem in stems)
    up = up_of_stem(shown, leaves, CAMERAS)
    assert up is not None
    assert up @ (turn @ UP) > np.cos(np.radians(3))
    assert up_of_stem((*shown, *shown), leaves, CAMERAS) is None
    long = {leaf: move(surface, np.eye(3), scale=10) for leaf, surface in leaves.items()}
    assert up_of_stem(shown, long, CAMERAS) is None


def test_of_two_stems_in_one_pot_the_one_that_is_shown_tells_no_up() -> None:
    one = PLANTS["spiral"][1]
    (alone,) = stems_of(one, None, Drawn(0.0))
    assert alone.tells_up
    assert stems_of(one, None, Drawn(300.0)) == ()  # through free air
    two = one | {leaf + 20: move(surface, np.eye(3), shift=(180.0, 0, 0)) for leaf, surface in one.items()}
    (told,) = stems_of(two, None, Drawn(0.0))
    first, second = stems = sorted(stems_of(two, None, Drawn(0.0, 180.0)), key=lambda stem: stem.axis.points[0, 0])
    assert not any(stem.tells_up for stem in (told, *stems))
    column, row = CAMERAS[[2]].project(torch.tensor([[180.0, 0, 70]]))[0][0, 0].int().tolist()
    no, yes = (StemMark(2, column, row, is_stem) for is_stem in (False, True))
    assert judge_stems(stems, (yes, no), CAMERAS) == (first,)
    assert [stem.probability == 1 for stem in judge_stems(stems, (no, yes), CAMERAS)] == [False, True]
    assert judge_stems(stems, (), CAMERAS) == (first, second)
    assert judge_stems((), (no,), CAMERAS) == ()


def test_masks_of_stems_tell_better_than_leaves() -> None:
    cameras = ring_cameras(10)
    axis = StemAxis(BENT, 0.06 + 0 * T)
    leaves = {}
    for number, place in enumerate((20, 32, 44), start=1):
        azimuth = 100.0 * number
        out = 0.1 * np.array([np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth)), np.tan(np.radians(7))])
        leaves[number] = move(bent_blade(), turn_about(UP, azimuth), scale=0.01, shift=tuple(BENT[place] + out))
    regions = regions_from_label_maps([np.zeros((SIZE, SIZE), np.int64)] * len(cameras))
    (stem,) = find_stems(
        leaves,
        Masks.of(regions),
        cameras,
        frame=level_frame(UP),
        photos=NO_PHOTOS,
        of_masks=[MaskAxis(axis.reverse(), knows_foot=True)],  # type: ignore[arg-type]
    )
    assert stem.source == "masks"
    assert stem.tells_up
    assert [node.leaf for node in stem.nodes] == [1, 2, 3]
    along = np.append(0, np.linalg.norm(np.diff(BENT, axis=0), axis=1).cumsum())
    assert [node.height.value for node in stem.nodes] == pytest.approx(along[[20, 32, 44]], abs=0.04)
    assert stem.axis.points[0, 2] < stem.axis.points[-1, 2]


@pytest.mark.parametrize("case", ["whole", "internodes", "pot"])
def test_masks_of_internodes_are_one_stem_and_a_pot_is_no_foot(case: str) -> None:
    cameras, thirds = ring_cameras(10 if case == "pot" else 6), [slice(22), slice(20, 43), slice(41, 64)]
    parts = thirds if case == "internodes" else [slice(None)]
    radius = 0.06 * np.where((T < 0.15) & (case == "pot"), 9, 1)
    drawn = [tube_masks(BENT[part], radius[part], cameras) for part in parts]
    maps = [np.select(views, range(1, len(parts) + 1)) for views in zip(*drawn, strict=True)]
    regions = regions_from_label_maps([each.astype(np.int64) for each in maps])
    surfaces = fit_surfaces(regions, regions.labels, cameras)
    if case == "pot":
        with warns_of("stem_with_pot"):
            (joined,) = axes_of_masks(surfaces)
    else:
        (joined,) = axes_of_masks(surfaces)
        length = float(np.linalg.norm(np.diff(BENT, axis=0), axis=1).sum())
        assert joined.axis.length == pytest.approx(length, rel=0.1)
        away = np.linalg.norm(joined.axis.points[:, None] - BENT, axis=2).min(1)
        assert float(np.median(away)) < 0.03
        assert 0.05 < float(np.median(joined.axis.radius)) < 0.1
    assert joined.knows_foot == (case != "pot")


def test_a_stem_is_drawn_as_a_tube_of_its_radius() -> None:
    mesh = sweep_circle(BENT, 0.06 + 0 * T)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(np.pi * 0.06**2 * StemAxis.along(BENT).length, rel=0.06)


def test_stems_are_slender_for_their_plant_and_close_leaves_share_a_node() -> None:
    """In any world; where all leaves are as slender, there are none."""
    widths = dict(enumerate((10, 9, 8, 2), start=1))
    chances = stem_chances({number: flat_leaf(length=40.0, half_width=width) for number, width in widths.items()})
    assert chances[4] > 0.99
    assert max(chances[number] for number in (1, 2, 3)) < 1e-6
    small = {number: flat_leaf(length=4.0, half_width=width / 10) for number, width in widths.items()}
    assert stem_chances(small) == pytest.approx(chances, abs=1e-6)
    assert max(stem_chances({number: flat_leaf(length=40.0, half_width=2.0) for number in (1, 2)}).values()) < 1e-6
    assert stem_chances({}) == {}
    along = np.array([0.0, 0.5, 1.2, 1.9, 5.0])
    assert group_leaves(along, np.ones(5)).tolist() == [0, 0, 1, 1, 2]
    assert group_leaves(7 * along, np.full(5, 7.0)).tolist() == [0, 0, 1, 1, 2]
    assert group_leaves(along, np.full(5, 0.1)).tolist() == [0, 1, 2, 3, 4]


def test_tables_of_nodes_are_read_as_they_were_written(tmp_path: Path) -> None:
    stems = stems_of(PLANTS["decussate"][1])
    path = tmp_path / "nodes.csv"
    write_nodes(path, Traits("=plant", "mm", (), {}, None, stems))
    text = path.read_text()
    assert text.splitlines()[0] == ",".join(Traits("p", "mm", (), {}, None, stems).node_table())
    assert text.count("\n") == 9
    assert "\n'=plant,1,1,2,1," in text
    (again,) = read_nodes(path)
    assert (again.source, again.phyllotaxis.name) == ("leaf bases", "decussate")
    for one, two in zip(stems[0].nodes, again.nodes, strict=True):
        assert (one.leaf, one.number, one.rank) == (two.leaf, two.number, two.rank)
        assert two.height.value == pytest.approx(one.height.value, abs=1e-3)
        assert two.place == pytest.approx(one.place, abs=1e-2)
    path.write_text(text.replace(",1,1,2,", ",x,1,2,", 1))
    with pytest.raises(InputError, match="no table of nodes"):
        read_nodes(path)
    path.write_text(text.replace("leaves_per_node", "as_an_older_version"))
    assert read_nodes(path) == ()


def test_in_the_graph_of_a_plant_leaves_hang_on_their_nodes_and_others_on_the_plant() -> None:
    (stem,) = stems_of(PLANTS["decussate"][1])
    on_stem = [node.leaf for node in stem.nodes]
    kinds = dict.fromkeys((*on_stem, 20)) | {21: "stem"}
    area = Measurement(200.0, 1.0, "surface")
    leaves = [LeafTraits(leaf, {"area": area, "hue": missing("")}, "surface", {}, kinds[leaf]) for leaf in kinds]
    traits = Traits("plant", "mm", tuple(leaves), {}, None, (stem,))
    graph = json.loads(json.dumps(plant_graph(traits), allow_nan=False))
    ((axis,), (alone,)) = graph["stems"], graph["leaves"]
    assert (axis["mtg"], alone["mtg"], alone["traits"], alone["sd"]) == ("/A1", "/L20", {"area": 200}, {"area": 1})
    nodes, borne = axis["nodes"], [leaf for node in axis["nodes"] for leaf in node["leaves"]]
    assert [(node["mtg"], len(node["leaves"])) for node in nodes] == [("/E1", 2), ("<E2", 2), ("<E3", 2), ("<E4", 2)]
    assert [leaf["mtg"] for leaf in borne] == [f"+L{leaf}" for leaf in on_stem]
    assert [node["traits"].get("internode", 0) for node in nodes] == pytest.approx([0, 30, 30, 30], abs=1.5)
    ends = np.array([leaf["petiole"] for leaf in borne])
    assert np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) == pytest.approx(PETIOLE, abs=2)
    assert (graph["unit"], graph["units"]["area"], graph["units"]["internode"]) == ("mm", "mm^2", "mm")
    bare = plant_graph(replace(traits, stems=()))
    assert (bare["stems"], [leaf["leaf"] for leaf in bare["leaves"]]) == ([], [*on_stem, 20])


def thin_photos(lines: list[np.ndarray], width: int) -> list[np.ndarray]:
    """V photos (H, W, 3) of dark lines (P, 3) before grey."""
    return [draw_lines(lines, width, matrix) for matrix in ring_cameras(10).px_from_world.numpy()]


def draw_lines(lines: list[np.ndarray], width: int, px_from_world: np.ndarray) -> np.ndarray:
    photo = np.full((SIZE, SIZE, 3), 150, np.uint8)
    for line in lines:
        cam = line @ px_from_world[:, :3].T + px_from_world[:, 3]
        px = np.round(cam[:, :2] / cam[:, 2:] * 16 - 8).astype(np.int32)
        cv2.polylines(photo, [px], False, (70, 90, 40), width, shift=4)
    return photo


def test_a_path_through_thin_parts_joins_leaves_to_their_stem() -> None:
    """Whichever way their midribs run: leaves are balls of points here."""
    stem = np.stack([0 * T, 0.1 * T, 1.8 * T - 0.9], 1)
    nodes, rng = {leaf: 4 + 8 * leaf for leaf in range(1, 7)}, np.random.default_rng(0)
    petioles, leaves = [], {}
    for leaf, place in nodes.items():
        ahead = np.array([np.cos(2.4 * leaf), np.sin(2.4 * leaf), 0.3])
        petioles.append(stem[place] + np.linspace(0, 0.35, 20)[:, None] * ahead)
        leaves[leaf] = stem[place] + 0.45 * ahead + rng.uniform(-0.1, 0.1, (400, 3))
    cameras = ring_cameras(10)
    points = np.concatenate(list(leaves.values()))
    views = []
    for photo, matrix in zip(thin_photos([stem, *petioles], 2), cameras.px_from_world.numpy(), strict=True):
        is_leaf = np.zeros((SIZE, SIZE), np.uint8)
        for each in leaves.values():
            cam = each @ matrix[:, :3].T + matrix[:, 3]
            cv2.fillConvexPoly(is_leaf, cv2.convexHull((cam[:, :2] / cam[:, 2:]).astype(np.int32)), 1)
        views.append(see_thin(photo, is_leaf > 0, matrix, points))
    cells = find_cells(views, points, np.eye(3))
    path = find_path(cells, leaves)
    assert path is not None
    away = path.points[:, :2] - np.interp(path.points[:, 2], stem[:, 2], stem[:, 1])[:, None] * [0, 1]
    assert np.abs(away).max() < 4 * cells.size
    assert len(path.petioles) >= 5
    for leaf, way in path.petioles.items():
        assert way[0, 2] == pytest.approx(stem[nodes[leaf], 2], abs=4 * cells.size), leaf
    assert find_path(cells, {leaf: leaves[leaf] for leaf in (1, 2)}) is None
    nothing = [see_thin(np.full((SIZE, SIZE, 3), 150, np.uint8), np.zeros((SIZE, SIZE), bool), matrix, points)
               for matrix in cameras.px_from_world.numpy()]  # fmt: skip
    assert find_path(find_cells(nothing, points, np.eye(3)), leaves) is None


def test_shares_are_those_of_a_loop_over_views_and_pixels() -> None:
    rng, size = np.random.default_rng(4), 9.0
    views = [
        ThinView(rng.random((SIZE, SIZE)).astype(np.float32), rng.random((SIZE, SIZE)) < 0.3, matrix)
        for matrix in CAMERAS.px_from_world.numpy()[:4]
    ]
    points = rng.normal(0, 60, (80, 3))
    cams = [points @ view.px_from_world[:, :3].T + view.px_from_world[:, 3] for view in views]
    expected = np.full(len(points), np.nan)
    for index in range(len(points)):
        shares = []
        for view, cam in zip(views, cams, strict=True):
            x, y = np.floor(cam[index, :2] / cam[index, 2]).astype(int)
            half = round(size * np.linalg.norm(view.px_from_world[0, :3]) / np.median(cam[:, 2]) / 2)
            if 0 <= x < SIZE and 0 <= y < SIZE and not view.is_hidden[y, x]:
                around = view.share[max(y - half, 0) : y + half + 1, max(x - half, 0) : x + half + 1]
                shares.append(around.max())
        if len(shares) >= 3:
            expected[index] = np.mean(shares)
    assert 10 < np.isfinite(expected).sum() < len(points)
    np.testing.assert_allclose(share_of_views(views, points, size), expected, rtol=1e-6)


def test_a_leaf_along_its_stem_has_no_azimuth_but_a_height() -> None:
    leaves = dict(PLANTS["spiral"][1])
    leaves[11] = move(bent_blade(bend_deg=1.0), turn_about(np.array([0, -1.0, 0]), 90), shift=(0.01, 0, 150))
    (stem,) = stems_of(leaves)
    top = next(node for node in stem.nodes if node.leaf == 11)
    assert top.height.exists
    assert not top.node_azimuth.exists
    assert not top.divergence.exists
    assert stem.phyllotaxis.name in ("spiral", "unclear")
