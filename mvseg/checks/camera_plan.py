"""The walk round the plant from above: where cameras stand, which way they look, and on which sides none stands."""

from __future__ import annotations

import re
import textwrap
from dataclasses import replace
from html import escape

import numpy as np

from mvseg.arrays import Floats
from mvseg.checks.cameras import find_coverage
from mvseg.checks.numbers import CAMERAS
from mvseg.scene import Scene
from mvseg.verification.numbers import EVIDENCE

WALK_FILE = "walk.svg"
INK, RED, GREEN = "#3c3c3c", "#d73027", "#1a9850"
RING = 'fill="none" cx="200" cy="200" r="175" pathLength="360"'
ARROW = '<path d="M14 0-6 6-2 0-6-6z" transform="translate({:.1f} {:.1f}) rotate({:.1f})"/>'
TEXT = '<text x="{:.1f}" y="{:.1f}" text-anchor="middle">{}</text>'


def draw_walk(scene: Scene, off: tuple[int, ...] = ()) -> tuple[str, str]:
    """Draw V >= 1 cameras from above, across `scene.up`, or else across the plane that they span.

    A gap between neighbours is wider than 30 degrees and than two usual steps. Cameras that look past the point, or
    stand above it, fill no gap.

    Returns:
        A sentence: how far the cameras go round the plant, and between which views others are missing.
        An SVG. The ring round the point that most cameras look at is green, and red in the gaps. Cameras are arrows
        with their numbers; red ones look past the point or are in `off`.
    """
    cameras, names = scene.cameras.to("cpu"), [view.name for view in scene.views]
    coverage = find_coverage(cameras)
    sights = cameras.centers.numpy() - coverage.point
    rays = sights / np.linalg.norm(sights, axis=1, keepdims=True).clip(min=1e-300)
    axes = _axes_from_above(replace(scene, cameras=cameras), rays)
    views = np.flatnonzero(coverage.sees & (np.linalg.norm(rays @ axes, axis=1) > CAMERAS.overhead))
    azimuths = np.degrees(np.arctan2(*(rays[views] @ axes).T[::-1]))
    views, azimuths = views[azimuths.argsort()], np.sort(azimuths)
    steps = np.diff(azimuths, append=azimuths[:1] + 360)
    usual = float(np.median(np.sort(steps)[:-1])) if len(steps) > 1 else 0.0
    is_wide = steps > max(EVIDENCE.least_parallax, 2 * min(usual, CAMERAS.wide))
    gaps = [*zip(azimuths[is_wide], steps[is_wide], views[is_wide], np.roll(views, -1)[is_wide], strict=True)]
    sentence = f"photos from {360 - steps[is_wide].sum() if len(views) else 0:.0f} of 360 degrees round the plant"
    sides = [f"the {width:.0f} degrees between {names[a]} and {names[b]}" for _, width, a, b in gaps]
    sentence += f"; none from {', '.join(sides)}" if sides else ""
    lines = textwrap.wrap(sentence, 64)
    size = f'viewBox="0 0 400 {395 + 18 * len(lines)}" font-family="sans-serif" font-size="12"'
    parts = [f'<svg xmlns="http://www.w3.org/2000/svg" {size}><rect width="100%" height="100%" fill="#fff"/>']
    parts += [f'<circle {RING} stroke="{GREEN}" stroke-width="6"/><circle cx="200" cy="200" r="7" fill="{GREEN}"/>']
    for azimuth, width, _, _ in gaps:
        arc = f'{RING} stroke-dasharray="{width:.2f} 360" transform="rotate({-azimuth - width:.2f} 200 200)"'
        parts.append(f'<circle {arc} stroke="#fff" stroke-width="7"/><circle {arc} stroke="{RED}" stroke-width="2"/>')
    places = sights @ axes / np.linalg.norm(sights @ axes, axis=1).max().clip(min=1e-300)
    turns = -np.degrees(np.arctan2(*(cameras.R[:, 2].numpy() @ axes).T[::-1]))
    for view, ((x, y), turn) in enumerate(zip(places, turns, strict=True)):
        color = RED if view in off or not coverage.sees[view] else INK
        arrow = ARROW.format(200 + 140 * x, 200 - 140 * y, turn)
        # the frame's, in a film; of more than 30 cameras, each second or third one has room for it
        number = int(names[view][6:]) if re.fullmatch(r"frame-\d+", names[view]) else view
        text = TEXT.format(200 + 158 * x, 204 - 158 * y, "" if view % (1 + len(names) // 30) else number)
        parts.append(f'<g fill="{color}"><title>{escape(names[view])}</title>{arrow}{text}</g>')
    texts = [TEXT.format(200, 396 + 18 * row, escape(line)) for row, line in enumerate(lines)]
    return sentence, "\n".join([*parts, *texts, "</svg>", ""])


def _axes_from_above(scene: Scene, rays: Floats) -> Floats:
    """(3, 2) the directions of the world that the picture shows as right and up; `rays` go to the cameras."""
    if scene.up is not None:
        up = np.array(scene.up)
    else:  # the cameras of a short walk are nearly on a line, which spans no plane
        beside = CAMERAS.beside * len(rays) ** 0.5 * rays.mean(0)
        up = np.linalg.svd(np.vstack((rays - rays.mean(0), scene.cameras.R[:, 0].numpy(), beside)))[2][2]
        up = up if up @ scene.cameras.R[:, 1].numpy().sum(0) < 0 else -up
    right = np.linalg.svd(up[None])[2][1]
    return np.stack((right, np.cross(up, right)), 1)
