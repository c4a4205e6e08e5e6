"""Cameras on their own: do they look at one place, from different sides, and could their lenses exist?"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mvseg.checks.finding import Finding, Rule, list_findings
from mvseg.checks.numbers import CAMERAS
from mvseg.formats.find_views import name_views
from mvseg.matching.pencil import is_coincident
from mvseg.scene import Cameras, Scene

Floats = NDArray[np.float64]

DEPTHS = np.geomspace(0.02, 500, 80)  # depths of candidate points, in the median distance of two cameras
GRID = (0.25, 0.5, 0.75)  # places of the rays with the candidate points, as shares of the photo's width and height
UNITS = {1000: "millimetres and metres", 100: "centimetres and metres", 10: "millimetres and centimetres"}
FLIP = np.diag([1.0, -1.0, -1.0])  # from cameras that look along -z with +y up (OpenGL, Blender)


@dataclass(frozen=True, eq=False)
class Coverage:
    """A point that as many cameras as possible look at.

    Attributes:
        point: (3,) world coordinates; of several that equally many cameras see, the one closest to the centres of the
            photos.
        sees: (V,) bool, cameras that have it in their image and in front of them.
        angle: (V,) degrees between the rays of each camera and its neighbour at the point; nan for cameras that do not
            look at it, or are the only ones.
    """

    point: Floats
    sees: NDArray[np.bool_]
    angle: Floats


def find_coverage(cameras: Cameras) -> Coverage:
    """The point that most of V >= 1 cameras look at, among points on their rays."""
    centers = cameras.centers
    apart = torch.linalg.vector_norm(centers[:, None] - centers, dim=2)
    scale = float(apart[apart > 0].median()) if bool((apart > 0).any()) else 1.0
    sizes = cameras.sizes.to(centers)
    grid = torch.tensor([[u, v, 1.0] for u in GRID for v in GRID]).to(centers)
    px = grid[None] * torch.nn.functional.pad(sizes, (0, 1), value=1.0)[:, None]
    rays = torch.nn.functional.normalize(px @ cameras.world_from_px.mT, dim=2)
    depths = torch.from_numpy(DEPTHS * scale).to(centers)
    some = torch.linspace(0, len(cameras) - 1, min(len(cameras), CAMERAS.most_sources)).long()
    points = (centers[some, None, None] + rays[some, :, None] * depths[:, None]).reshape(-1, 3)
    looks = [_look(cameras, part) for part in points.split(CAMERAS.points_at_once)]
    # the most views, and then the middle of the photos
    best = points[int(torch.cat([sees.sum(0).double() - off.mean(0) / 2 for sees, off in looks]).argmax())]
    sees = _look(cameras, best[None])[0][:, 0]
    toward = torch.nn.functional.normalize(best - centers, dim=1)
    is_other = sees & ~torch.eye(len(cameras), dtype=torch.bool)
    nearest = torch.where(is_other, toward @ toward.T, -2).amax(1)
    angle = torch.where(sees & (nearest > -2), torch.rad2deg(nearest.clamp(-1, 1).acos()), torch.nan)
    return Coverage(point=best.numpy(), sees=sees.numpy(), angle=angle.numpy())


def camera_findings(scene: Scene, coverage: Coverage) -> list[Finding]:
    """The findings about the cameras of a scene."""
    names = tuple(view.name for view in scene.views)
    return [
        *_place_findings(scene.cameras, coverage, names),
        *_lens_findings(scene.cameras, names),
        *_world_findings(scene),
    ]


def _place_findings(cameras: Cameras, coverage: Coverage, names: tuple[str, ...]) -> list[Finding]:
    if bool(is_coincident(cameras).all()):
        what = "all cameras are at one place, where depth cannot be seen: do R and t map world points to the camera?"
        return [Finding(where="cameras", what=what, level="error")]
    if (mixed := _mixed_units(cameras, coverage, names)) is not None:
        return [mixed]
    if reading := _other_reading(cameras, coverage):
        return [Finding(where="cameras", what=reading, level="error")]
    share = coverage.sees.mean()
    findings: list[Finding] = []
    unseeing = tuple(np.flatnonzero(~coverage.sees).tolist())
    if coverage.sees.sum() < 2:
        what = "no two cameras look at one point: do R and t map world points to the camera?"
        findings.append(Finding(where="cameras", what=what, level="error"))
    elif unseeing and share > 0.5:
        point = f"the point that the other {coverage.sees.sum()} look at"
        rule: Rule = ("warning", unseeing, f"{{}} look past {point}: check the pose, or leave the photo out")
        findings += list_findings("cameras", [rule], names)
    elif unseeing:
        what = f"no point is seen by more than {coverage.sees.sum()} of {len(names)} cameras: check the poses, unless "
        findings.append(Finding(where="cameras", what=f"{what}the photos show different plants", level="warning"))
    findings += _baseline_findings(cameras, coverage, names)
    centers = cameras.centers.numpy()
    distance = np.linalg.norm(centers - np.median(centers, 0), axis=1)
    usual = float(np.median(distance))
    far = tuple(np.flatnonzero(distance > CAMERAS.far * usual).tolist()) if len(names) > 3 and usual > 0 else ()
    what = (
        f"{{}}: {distance.max() / max(usual, 1e-300):.0f} times as far out as the other cameras; is t in another unit?"
    )
    return findings + list_findings("cameras", [("warning", far, what)], names)


def _baseline_findings(cameras: Cameras, coverage: Coverage, names: tuple[str, ...]) -> list[Finding]:
    twins = torch.triu(is_coincident(cameras), diagonal=1).nonzero().flatten().unique().tolist()
    what = "{} have the same position as other cameras, which gives no depth: move the camera"
    findings = list_findings("cameras", [("warning", twins, what)], names)
    spread = _widest_angle(cameras, coverage)
    if coverage.sees.sum() > 1 and spread < CAMERAS.narrow:
        what = f"the views differ by {spread:.1f} degrees at most: depth is uncertain; photograph from more sides"
        findings.append(Finding(where="cameras", what=what, level="warning"))
    angle = np.nan_to_num(coverage.angle)
    facts = f"the next view is {angle.max():.0f} degrees away and shows few of the same leaves"
    lonely: Rule = ("warning", np.flatnonzero(angle > CAMERAS.wide).tolist(), f"{{}}: {facts}; add photos between")
    return findings + list_findings("cameras", [lonely], names)


def _lens_findings(cameras: Cameras, names: tuple[str, ...]) -> list[Finding]:
    K, sizes = cameras.K.numpy(), cameras.sizes.numpy().astype(float)
    focal, center = K[:, [0, 1], [0, 1]], K[:, :2, 2]
    view_deg, (least, most) = field_of_view(cameras), CAMERAS.field_of_view
    found = (
        (
            (view_deg < least) | (view_deg > most),
            f"a field of view of {{:.0f}} degrees, expected {least:.0f} to {most:.0f}: is K in "
            "pixels, of photos of this size?",
            view_deg,
        ),
        (
            (np.abs(center / sizes - 0.5) > CAMERAS.off_center).any(1),
            "a principal point {:.0%} of the photo's size beside its middle: is K that of photos of another size, or "
            "before they were cropped?",
            np.abs(center / sizes - 0.5).max(1),
        ),
        (
            focal.max(1) > CAMERAS.square * focal.min(1),
            "focal lengths of x and y that differ by a factor of {:.2f}: was the photo scaled in one direction only?",
            focal.max(1) / focal.min(1),
        ),
    )
    rules: list[Rule] = [
        ("warning", np.flatnonzero(is_odd).tolist(), "{} have " + what.format(value[is_odd].max(initial=0)))
        for is_odd, what, value in found
    ]
    return list_findings("cameras", rules, names)


def _world_findings(scene: Scene) -> list[Finding]:
    notes = []
    if not scene.unit:
        notes.append("the cameras do not say their unit: lengths are in world units, unless --scale and --unit say it")
    if scene.up is None:
        notes.append("the cameras do not say which way is up: heights and angles are not measured, unless --up says it")
    elif scene.seems_upside_down:
        notes.append("up may be upside down: the cameras look up at the plant, or hang upside down; if not, reverse it")
    return [Finding(where="cameras", what=what, level="note") for what in notes]


def field_of_view(cameras: Cameras) -> Floats:
    """(V,) degrees, along the diagonal of each photo."""
    half = cameras.sizes.double() / 2 / torch.stack((cameras.K[:, 0, 0], cameras.K[:, 1, 1]), 1)
    return np.asarray(torch.rad2deg(2 * half.norm(dim=1).atan()).numpy())


def _mixed_units(cameras: Cameras, coverage: Coverage, names: tuple[str, ...]) -> Finding | None:
    """Is t in one unit in some views, and in another one in the rest?

    Then there are two lengths of t, and with a factor between units all cameras look at one point from like distances.
    Cameras that do so as they are have one unit, wherever the world's origin is.
    """
    lengths = torch.linalg.vector_norm(cameras.t, dim=1)
    order = lengths.argsort()
    ordered = lengths[order].clamp(min=1e-300)
    share = coverage.sees.mean()
    for place in ((ordered[1:] > CAMERAS.gap * ordered[:-1]).nonzero()[:, 0] + 1).tolist():
        is_short = torch.zeros(len(cameras), dtype=torch.bool)
        is_short[order[:place]] = True
        if share >= CAMERAS.all and _distance_ratio(cameras, coverage, is_short) < CAMERAS.gap:
            continue
        for factor, units in UNITS.items():
            scaled = replace(cameras, t=torch.where(is_short[:, None], factor * cameras.t, cameras.t))
            found = find_coverage(scaled)
            if found.sees.mean() < CAMERAS.all or _distance_ratio(scaled, found, is_short) > CAMERAS.alike:
                continue
            few, length = (is_short, "short") if 2 * place <= len(cameras) else (~is_short, "long")
            views = tuple(few.nonzero()[:, 0].tolist())
            facts = f"t is some {factor} times as {length} as in the other {len(cameras) - len(views)}"
            step = f"is t in another unit ({units})? In one, {found.sees.sum()} of {len(cameras)} look at one point"
            what = f"{name_views(views, names)}: {facts}; {step}"
            is_sure = factor > min(UNITS) or share < CAMERAS.all
            return Finding(where="cameras", what=what, level="error" if is_sure else "warning", views=views)
    return None


def _distance_ratio(cameras: Cameras, coverage: Coverage, is_short: Tensor) -> float:
    """Ratio of the median distances of two groups of cameras from the point; at least 1."""
    distance = torch.linalg.vector_norm(cameras.centers - torch.from_numpy(coverage.point), dim=1)
    short, long = (float(distance[group].median().clamp(min=1e-300)) for group in (is_short, ~is_short))
    return max(short / long, long / short)


def _other_reading(cameras: Cameras, coverage: Coverage) -> str | None:
    """What R and t seem to be instead, as a sentence; None if they seem right.

    Inverted poses may still look at one point: cameras around a plant then stand close together and look in one
    direction, each rotated about its own axis.
    """
    R, t, flip = cameras.R, cameras.t, torch.from_numpy(FLIP)
    inverse = replace(cameras, R=R.mT, t=cameras.centers)
    readings = (
        (inverse, "R and t seem to map camera points to the world: write the inverse, R^T and -R^T t"),
        (
            replace(cameras, R=flip @ R, t=t @ flip),
            "they seem to look along -z, as in OpenGL: negate rows 2 and 3 of R and t",
        ),
        (
            replace(cameras, R=flip @ R.mT, t=cameras.centers @ flip),
            "R and t seem to map points of OpenGL's cameras to the world, as Blender's do: invert them and negate rows "
            "2 and 3",
        ),
    )
    given = (int(coverage.sees.sum()), _widest_angle(cameras, coverage))
    best = (0, 0.0, "")
    for reading, what in readings:
        if not bool(is_coincident(reading).all()):
            found = find_coverage(reading)
            best = max(best, (int(found.sees.sum()), round(_widest_angle(reading, found), 3), what))
    num, angle, what = best
    if num < CAMERAS.all * len(cameras):
        return None
    if given[0] < CAMERAS.most * len(cameras):
        return f"the cameras do not look at one place; {what}, and {num} of {len(cameras)} would"
    if given[1] * CAMERAS.wider < angle:
        facts = f"the cameras look from directions that differ by {given[1]:.0f} degrees only"
        return f"{facts}; {what}, and they differ by {angle:.0f}"
    return None


def _widest_angle(cameras: Cameras, coverage: Coverage) -> float:
    """Degrees between the most different rays of the cameras that look at the point; 0 if fewer than two do."""
    toward = coverage.point - cameras.centers.numpy()[coverage.sees]
    toward /= np.linalg.norm(toward, axis=1, keepdims=True).clip(min=1e-300)
    return float(np.degrees(np.arccos(np.clip(toward @ toward.T, -1, 1).min()))) if len(toward) > 1 else 0.0


def _look(cameras: Cameras, points: Tensor) -> tuple[Tensor, Tensor]:
    """(V, P) bool, which cameras have which points in their images, and (V, P) how far from the middle; 1 = border."""
    px, depth = cameras.project(points)
    off = (px / cameras.sizes[:, None] - 0.5).abs().amax(2) * 2
    sees = (depth > 0) & (off < 1)
    return sees, torch.where(sees, off, 1.0)
