"""Draws docs/walks.svg, how two sets of cameras stand round their plants: `python -m benchmarks.figures.walks GOOD BAD`

Each dot is a camera as the plant sees it: all round the circle by its azimuth, and the nearer to the middle the higher
it stands. GOOD and BAD are scene folders.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from mvseg.formats.scene_folder import load_scene
from mvseg.scene import nearest_point

OUT = Path(__file__).parents[2] / "docs" / "walks.svg"
RADIUS, STEP = 110, 290
SAID = ("good: round the plant, at two heights", "bad: from one side only")


def find_directions(folder: Path) -> np.ndarray:
    """(V, 3) unit vectors from the point that all cameras look at to these, in axes whose third one is up."""
    cameras = load_scene(folder).cameras
    axes = cameras.R[:, 2].double().numpy()
    up = -cameras.R[:, 1].double().numpy().mean(0)  # where photos are upright
    up /= np.linalg.norm(up)
    east = np.cross(up, axes.mean(0) if abs(up @ axes.mean(0)) < 0.9 else axes[0])
    east /= np.linalg.norm(east)
    sights = (cameras.centers - nearest_point(cameras.centers, cameras.R[:, 2])).double().numpy()
    return (sights / np.linalg.norm(sights, axis=1, keepdims=True)) @ np.stack([east, np.cross(up, east), up], 1)


def main() -> None:
    style = 'font-family="sans-serif" font-size="12"'
    parts = [f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {2 * STEP} 290" {style}>']
    for number, folder in enumerate(map(Path, sys.argv[1:3])):
        x, y = STEP * number + STEP / 2, 130
        for height in (0, 30, 60):
            radius = RADIUS * (90 - height) / 90
            parts.append(f'<circle cx="{x}" cy="{y}" r="{radius:.1f}" fill="none" stroke="#bbb"/>')
            parts.append(f'<text x="{x + 3}" y="{y - radius + 12:.1f}" fill="#888">{height}°</text>')
        parts.append(f'<circle cx="{x}" cy="{y}" r="9" fill="#4a8f3c"/>')
        for east, north, up in find_directions(folder):
            reach = RADIUS * np.degrees(np.arccos(np.clip(up, -1, 1))) / 90 / max(np.hypot(east, north), 1e-9)
            parts.append(f'<circle cx="{x + reach * east:.1f}" cy="{y - reach * north:.1f}" r="5" fill="#c2571a"/>')
        parts.append(f'<text x="{x}" y="275" text-anchor="middle">{SAID[number]}</text>')
    OUT.write_text("\n".join([*parts, "</svg>", ""]), encoding="utf-8")


if __name__ == "__main__":
    main()
