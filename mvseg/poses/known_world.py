"""Scale and axes of a scene whose cameras have neither: from markers, a known distance, or known positions."""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap

from mvseg.arrays import Floats
from mvseg.errors import InputError, faults_of, warn
from mvseg.findings.finding import Finding, list_some
from mvseg.formats.board import BoardConfig
from mvseg.formats.find_views import find_views
from mvseg.formats.lens import pinhole_from_photo
from mvseg.formats.markers import Corner, find_board, find_scene_markers, read_grey
from mvseg.formats.photos import Photos
from mvseg.formats.positions import read_positions
from mvseg.poses.alignment import align, is_one_line, scale_by, spreads
from mvseg.poses.config import WorldFacts
from mvseg.poses.numbers import WORLD
from mvseg.reconstruction.triangulate import triangulate_points
from mvseg.scene import Scene
from mvseg.system.running import progress_bar

MARKER = "marker:"  # in front of a marker's number, where a photo's name could stand
PLACE = re.compile(r"(.+?):(\d+(?:\.\d+)?),(\d+(?:\.\d+)?)(\+|$)")  # photo:x,y+


@dataclass(frozen=True, eq=False)
class Placement:
    """The transform of a scene into its known world, and where it comes from.

    Attributes:
        similarity: world_from_scene.
        source: where the scale comes from, as text; "" if nowhere.
        residual: root mean square residual, in units of the world; None if unknown.
        left_out: names of photos whose positions contradict the others.
        up: direction that points up in the world, where the source says so (a board that lies flat).
    """

    similarity: pycolmap.Sim3d
    unit: str
    source: str = ""
    residual: float | None = None
    left_out: tuple[str, ...] = ()
    up: tuple[float, float, float] | None = None

    def describe(self) -> str:
        """One line: where the scale comes from, and how well it fits."""
        if not self.source:
            return "no scale: lengths are in arbitrary units (--marker, --distance or --positions give one)"
        fit = "" if self.residual is None else f", residual {self.residual:.3g} {self.unit or 'units'}"
        wrong = f", {len(self.left_out)} left out ({list_some(self.left_out)})" if self.left_out else ""
        return f"scale from {self.source}{fit}{wrong}"


def place(scene: Scene, world: WorldFacts) -> Placement:
    """The similarity that transforms a scene into the known world; without a length the scene stays as it is. Warns
    (InputWarning) of markers of different sizes, positions that hardly fit, and positions on one line. Raises
    InputError if the markers or photos named are not seen, or the positions do not fit the photos or are mirrored."""
    if world.board is not None:
        return _by_board(scene, world.board, world.unit)
    if world.marker is not None:
        return _by_markers(scene, world.marker, world.unit)
    if world.distance is not None:
        return _by_distance(scene, world.distance, world.unit)
    if world.positions is not None:
        return _by_positions(scene, world.positions, world.unit)
    return Placement(similarity=scale_by(1.0), unit=world.unit)


def _by_board(scene: Scene, board: BoardConfig, unit: str) -> Placement:
    corners: dict[int, list[tuple[int, Floats]]] = {}
    photos = Photos(scene)
    for view in progress_bar(range(len(scene.views)), name="board", unit="photo"):
        for number, px in zip(*find_board(read_grey(photos, view), board), strict=True):
            corners.setdefault(int(number), []).append((view, px))
    points = triangulate_points(scene.cameras, corners)
    try:
        alignment = align(np.array(list(points.values())).reshape(-1, 3), board.corners()[list(points)])
    except InputError as error:
        message = f"{len(points)} corners of the board are seen in two photos or more"
        raise InputError(f"{message}: {error} (is it {board.columns} x {board.rows} of {board.family}?)") from None
    source, up = f"{int(alignment.is_inlier.sum())} corners of the board", (0.0, 0.0, 1.0)
    return Placement(similarity=alignment.similarity, unit=unit, source=source, residual=alignment.rms, up=up)


def _by_markers(scene: Scene, side: float, unit: str) -> Placement:
    """All corners of all markers are fitted at once: each marker is a square of its own pose, of one common scale."""
    sides = marker_sides(_marker_corners(scene))
    if not len(sides):
        raise InputError("no whole marker is seen in two photos, expected ArUco or AprilTag markers of --marker's size")
    middle = float(np.median(sides))
    if odd := int((np.abs(sides / middle - 1) > WORLD.spread).sum()):
        warn(Finding("markers_differ", values={"odd": odd, "count": len(sides), "share": WORLD.spread}))
    residual = float(np.sqrt(((sides / middle - 1) ** 2).mean())) * side if len(sides) > 1 else None
    source = f"{len(sides)} markers of {side:g} {unit}".rstrip()
    return Placement(similarity=scale_by(side / middle), unit=unit, source=source, residual=residual)


def marker_sides(corners: dict[Corner, Floats]) -> Floats:
    """(M,) sides of the markers of which all four corners are known: the square with the least squared distances."""
    whole = sorted({marker for marker, _ in corners if all((marker, corner) in corners for corner in range(4))})
    quads = np.array([[corners[marker, corner] for corner in range(4)] for marker in whole]).reshape(-1, 4, 3)
    square = np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]) / 2
    # Umeyama's scale: the singular values of the cross-covariance over the variance of the unit square
    from_center = quads - quads.mean(1, keepdims=True)
    return np.linalg.svd(from_center.swapaxes(1, 2) @ square, compute_uv=False).sum(1) / (square**2).sum()


def _marker_corners(scene: Scene) -> dict[Corner, Floats]:
    found = find_scene_markers(Photos(scene))
    return max((triangulate_points(scene.cameras, seen) for seen in found.values()), key=len)


def _by_distance(scene: Scene, distance: tuple[str, str, float], unit: str) -> Placement:
    names, length = distance[:2], distance[2]
    corners = _marker_corners(scene) if any(name.startswith(MARKER) for name in names) else {}
    first, second = (_point(scene, name, corners) for name in names)
    apart = float(np.linalg.norm(first - second))
    if apart <= WORLD.rounding * float(spreads(scene.cameras.centers.cpu().numpy())[0]):
        raise InputError(f"{names[0]} and {names[1]} are at one place, expected two that are {length:g} apart")
    source = f"the distance from {names[0]} to {names[1]}, {length:g} {unit}".rstrip()
    return Placement(similarity=scale_by(length / apart), unit=unit, source=source)


def _point(scene: Scene, name: str, corners: dict[Corner, Floats]) -> Floats:
    places = PLACE.findall(name)
    if places and "".join(f"{photo}:{x},{y}{more}" for photo, x, y, more in places) == name:
        return _spot(scene, name, [(photo, np.array([float(x), float(y)])) for photo, x, y, _ in places])
    if not name.startswith(MARKER):
        return np.asarray(scene.cameras.centers[_view(scene, name)].cpu().numpy())
    number = name.removeprefix(MARKER)
    keys = [(int(number), corner) for corner in range(4)] if number.isdecimal() else []
    quad = [corners[key] for key in keys if key in corners]
    if len(quad) < 4:
        seen = list_some([f"{MARKER}{marker}" for marker in sorted({marker for marker, _ in corners})])
        raise InputError(f"--distance: {name} is not seen whole in two photos, found {seen}")
    return np.mean(quad, axis=0)


def _view(scene: Scene, photo: str) -> int:
    (view,) = find_views([photo], scene, source=Path("--distance"))
    if view is None:
        wanted = f"a marker ({MARKER}7) or a spot in two photos (a.jpg:812,455+b.jpg:790,470)"
        raise InputError(f"--distance: {photo} is neither a registered photo nor {wanted}")
    return view


def _spot(scene: Scene, name: str, places: list[tuple[str, Floats]]) -> Floats:
    """The point that is at these pixels (2,) of the photos as they are, with lens distortion."""
    sightings = []
    for photo, px in places:
        view = _view(scene, photo)
        lens, camera = scene.views[view].lens, scene.cameras[[view]]
        width, height = (lens.width, lens.height) if lens else camera.sizes[0].tolist()
        if px[0] > width or px[1] > height:
            raise InputError(f"--distance: {photo}:{px[0]:g},{px[1]:g} is outside of its {width} x {height} pixels")
        K = camera.K[0].cpu().numpy()
        sightings.append((view, px if lens is None else pinhole_from_photo(lens, K, px[None])[0]))
    points = triangulate_points(scene.cameras, {name: sightings})
    if not points:
        wanted = "the same spot in two photos or more, right to 0.3 % of their width, seen from places that differ"
        raise InputError(f"--distance: {name} is not one point, expected {wanted}")
    return points[name]


def _by_positions(scene: Scene, path: Path, unit: str) -> Placement:
    names, xyz, stated = read_positions(path)
    views = find_views(names, scene, source=path)
    used = [(index, view) for index, view in enumerate(views) if view is not None]
    if len(used) < 2:
        found = f"{len(used)} of its photos are registered ({list_some(names)})"
        raise InputError(f"{path}: {found}, expected three or more")
    unit = unit or stated
    rows, seen = np.array(used).T
    centers, target = scene.cameras.centers.cpu().numpy()[seen], xyz[rows]
    if is_one_line(target):
        return _by_positions_on_a_line(centers, target, path=path, unit=unit)
    with faults_of(path):
        alignment = align(centers, target)
    share = alignment.rms / spreads(target)[0]
    if share > WORLD.misfit:
        warn(Finding("positions_misfit", str(path), {"share": float(share)}))
    wrong = tuple(names[row] for row in rows[~alignment.is_inlier])
    source, similarity = f"{int(alignment.is_inlier.sum())} positions of {path.name}", alignment.similarity
    return Placement(similarity=similarity, unit=unit, source=source, residual=alignment.rms, left_out=wrong)


def _by_positions_on_a_line(centers: Floats, target: Floats, *, path: Path, unit: str) -> Placement:
    """The scale alone: the median ratio of distances, those of far pairs counting."""
    if len(centers) > 2 and np.ptp(target, axis=0).any() and not is_one_line(centers):
        ranges = np.ptp(target, axis=0)
        still = [axis for axis, range_ in zip("xyz", ranges, strict=True) if range_ <= WORLD.flat * ranges.max()]
        hint = f" ({' and '.join(still)} hardly vary: are they degrees, of latitude and longitude?)" if still else ""
        raise InputError(f"{path}: the positions lie on one line, and the cameras that took the photos do not{hint}")
    far = float(np.linalg.norm(target - target.mean(0), axis=1).max())
    pairs = [(i, j) for i, j in combinations(range(len(target)), 2) if np.linalg.norm(target[i] - target[j]) > far / 2]
    ratios = [np.linalg.norm(target[i] - target[j]) / np.linalg.norm(centers[i] - centers[j]) for i, j in pairs]
    if not ratios:
        raise InputError(f"{path}: all positions are at one place, expected where the camera stood")
    away = [points - points.mean(0) for points in (target, centers)]
    places = [each @ np.linalg.svd(each, full_matrices=False)[2][0] for each in away]
    misfit = np.sqrt(max(0.0, 1 - np.corrcoef(*places)[0, 1] ** 2))
    if misfit > WORLD.misfit:
        warn(Finding("positions_misfit", str(path), {"share": float(misfit)}))
    warn(Finding("positions_on_a_line", str(path)))
    source = f"{len(target)} positions on one line of {path.name}"
    return Placement(similarity=scale_by(float(np.median(ratios))), unit=unit, source=source)
