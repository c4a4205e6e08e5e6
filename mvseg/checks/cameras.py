"""Cameras on their own: do they look at one place, from different sides, and could their lenses exist?"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mvseg.arrays import Floats
from mvseg.checks.numbers import CAMERAS
from mvseg.findings.finding import Finding, Rule, Values, list_findings
from mvseg.matching.pencil import is_coincident
from mvseg.scene import Cameras, Scene
from mvseg.verification.numbers import EVIDENCE

DEPTHS = np.geomspace(0.02, 500, 80)  # depths of candidate points, in the median distance of two cameras
GRID = (0.25, 0.5, 0.75)  # chosen: places of rays with candidate points, in the photo's width and height
UNITS = {1000: "millimetres and metres", 100: "centimetres and metres", 10: "millimetres and centimetres"}
FLIP = np.diag([1.0, -1.0, -1.0])  # from cameras that look along -z with +y up (OpenGL, Blender)


@dataclass(frozen=True, eq=False)
class Coverage:
    """A point that as many cameras as possible look at.

    Attributes:
        point: (3,) world coordinates; of equally good ones, the closest to the centres of the photos.
        sees: (V,) bool, cameras that have it in their image and in front of them.
        angle: (V,) degrees between the rays of each camera and its neighbour at the point; nan without such rays.
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
    cameras, names = scene.cameras, tuple(view.name for view in scene.views)
    rules = [*_place_rules(cameras, coverage), *_lens_rules(cameras)]
    world = {"unknown_unit": not scene.unit, "unknown_up": scene.up is None, "upside_down": scene.seems_upside_down}
    rules += [(code, "warning" if code == "upside_down" else "note", None, {}) for code in world if world[code]]
    return list_findings(rules, names)


def _place_rules(cameras: Cameras, coverage: Coverage) -> list[Rule]:
    if bool(is_coincident(cameras).all()):
        return [("same_place", "error", None, {})]
    if wrong := _mixed_units(cameras, coverage) or _other_reading(cameras, coverage):
        return [wrong]
    num, total = int(coverage.sees.sum()), len(cameras)
    unseeing = np.flatnonzero(~coverage.sees).tolist()
    rules: list[Rule] = []
    if num < 2:
        rules.append(("no_common_point", "error", None, {}))
    elif num > total / 2:
        rules.append(("look_past", "warning", unseeing, {"others": num}))
    elif unseeing:
        rules.append(("few_look_at_one_point", "warning", None, {"num": num, "total": total}))
    rules += _baseline_rules(cameras, coverage)
    centers = cameras.centers.numpy()
    distance = np.linalg.norm(centers - np.median(centers, 0), axis=1)
    usual = float(np.median(distance))
    far = np.flatnonzero(distance > CAMERAS.far * usual).tolist() if total > 3 and usual > 0 else []
    return [*rules, ("far_out", "warning", far, {"ratio": float(distance.max()) / max(usual, 1e-300)})]


def _baseline_rules(cameras: Cameras, coverage: Coverage) -> list[Rule]:
    twins = torch.triu(is_coincident(cameras), diagonal=1).nonzero().flatten().unique().tolist()
    rules: list[Rule] = [("same_position", "warning", twins, {})]
    walked = _widest_angle(cameras, coverage)
    if coverage.sees.sum() > 1 and walked < EVIDENCE.least_parallax:
        rules.append(("no_depth" if walked < CAMERAS.narrow else "one_sided", "warning", None, {"degrees": walked}))
    angle = np.nan_to_num(coverage.angle)
    lonely = np.flatnonzero(angle > CAMERAS.wide).tolist()
    return [*rules, ("next_view_far", "warning", lonely, {"degrees": float(angle.max())})]


def _lens_rules(cameras: Cameras) -> list[Rule]:
    K, sizes = cameras.K.numpy(), cameras.sizes.numpy().astype(float)
    focal, center = K[:, [0, 1], [0, 1]], K[:, :2, 2]
    degrees, (least, most) = field_of_view(cameras), CAMERAS.field_of_view
    beside = np.abs(center / sizes - 0.5).max(1)
    rules = (
        ("odd_field_of_view", (degrees < least) | (degrees > most), "degrees", degrees),
        ("odd_principal_point", beside > CAMERAS.off_center, "share", beside),
        ("odd_focal_lengths", focal.max(1) > CAMERAS.square * focal.min(1), "ratio", focal.max(1) / focal.min(1)),
    )
    return [
        (code, "warning", np.flatnonzero(is_odd).tolist(),
         {name: float(value[is_odd].max(initial=0)), "least": least, "most": most})
        for code, is_odd, name, value in rules
    ]  # fmt: skip


def field_of_view(cameras: Cameras) -> Floats:
    """(V,) degrees, along the diagonal of each photo."""
    half = cameras.sizes.double() / 2 / torch.stack((cameras.K[:, 0, 0], cameras.K[:, 1, 1]), 1)
    return np.asarray(torch.rad2deg(2 * half.norm(dim=1).atan()).numpy())


def _mixed_units(cameras: Cameras, coverage: Coverage) -> Rule | None:
    """The rule about views whose t is in another unit; None without any: some factor makes all look at one point."""
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
            groups = find_coverage(scaled)
            if groups.sees.mean() < CAMERAS.all or _distance_ratio(scaled, groups, is_short) > CAMERAS.alike:
                continue
            few, ratio = (is_short, 1 / factor) if 2 * place <= len(cameras) else (~is_short, float(factor))
            views, num = few.nonzero()[:, 0].tolist(), int(groups.sees.sum())
            is_sure = factor > min(UNITS) or share < CAMERAS.all
            counts: Values = {"others": len(cameras) - len(views), "num": num, "total": len(cameras)}
            return "mixed_units", "error" if is_sure else "warning", views, {**counts, "ratio": ratio, "units": units}
    return None


def _distance_ratio(cameras: Cameras, coverage: Coverage, is_short: Tensor) -> float:
    distance = torch.linalg.vector_norm(cameras.centers - torch.from_numpy(coverage.point), dim=1)
    short, long = (float(distance[group].median().clamp(min=1e-300)) for group in (is_short, ~is_short))
    return max(short / long, long / short)


def _other_reading(cameras: Cameras, coverage: Coverage) -> Rule | None:
    """The rule about what R and t seem to be instead; None if they seem right."""
    R, t, flip = cameras.R, cameras.t, torch.from_numpy(FLIP)
    readings = {
        "inverse_poses": replace(cameras, R=R.mT, t=cameras.centers),
        "opengl_poses": replace(cameras, R=flip @ R, t=t @ flip),
        "inverse_opengl_poses": replace(cameras, R=flip @ R.mT, t=cameras.centers @ flip),
    }
    num_now, degrees_now = int(coverage.sees.sum()), _widest_angle(cameras, coverage)
    best = (0, 0.0, "")
    for code, reading in readings.items():
        if not bool(is_coincident(reading).all()):
            found = find_coverage(reading)
            best = max(best, (int(found.sees.sum()), round(_widest_angle(reading, found), 3), code))
    num, degrees, code = best
    is_better = num_now < CAMERAS.most * len(cameras) or degrees_now * CAMERAS.wider < degrees
    if num < CAMERAS.all * len(cameras) or not is_better:
        return None
    now = {"num_now": num_now, "degrees_now": degrees_now, "total": len(cameras)}
    return code, "error", None, {"num": num, "degrees": degrees, **now}


def _widest_angle(cameras: Cameras, coverage: Coverage) -> float:
    toward = coverage.point - cameras.centers.numpy()[coverage.sees]
    toward /= np.linalg.norm(toward, axis=1, keepdims=True).clip(min=1e-300)
    return float(np.degrees(np.arccos(np.clip(toward @ toward.T, -1, 1).min()))) if len(toward) > 1 else 0.0


def _look(cameras: Cameras, points: Tensor) -> tuple[Tensor, Tensor]:
    """(V, P) bool, which cameras have which points in their images, and (V, P) how far from the middle; 1 = border."""
    px, depth = cameras.project(points)
    off = (px / cameras.sizes[:, None] - 0.5).abs().amax(2) * 2
    sees = (depth > 0) & (off < 1)
    return sees, torch.where(sees, off, 1.0)
