"""Draws docs/matching.jpg: a leaf's bands, hypotheses and cluster: `python benchmarks/figures/matching.py`"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[2]))

from mvseg import Matching, Regions, Scene, epipolar_map, load_masks, load_scene, match_regions
from mvseg.demo import demo_scene
from mvseg.formats.photos import read_photo
from mvseg.matching.nview.plane_sweep import sweep_planes
from mvseg.results.overlay import draw_overlay

DOCS = Path(__file__).parents[2] / "docs"
SOURCE, OTHERS = 1, (3, 5, 7)
ORANGE, WHITE, BLUE = (255, 140, 0), (255, 255, 255), (60, 120, 255)


@dataclass(frozen=True, eq=False)
class Example:
    """A matched scene and one of its regions, `leaf`, in the view SOURCE; `members` (D,) are those of its cluster."""

    scene: Scene
    regions: Regions
    matching: Matching
    leaf: int
    members: torch.Tensor

    def photo(self, view: int) -> np.ndarray:
        return read_photo(self.scene, view).copy()

    def in_view(self, view: int) -> list[int]:
        return (self.regions.view_index == view).nonzero()[:, 0].tolist()

    def outline(self, image: np.ndarray, region: int, color: tuple[int, int, int], *, thickness: int = 2) -> None:
        """Draw the border of a region into the RGB image of its view."""
        mask = self.regions.mask(region, image.shape[1], image.shape[0]).numpy().astype(np.uint8)
        borders, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(image, borders, -1, color, thickness)

    def epipolar_map(self, chosen: torch.Tensor, view: int) -> np.ndarray:
        """(H, W) epipolar map of some regions in a view."""
        width, height = self.scene.cameras.sizes[SOURCE].tolist()
        rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        xy = torch.stack((columns, rows), -1).reshape(-1, 2) + 0.5
        flat = epipolar_map(self.regions.select(chosen), self.scene.cameras, view=view, xy=xy)
        return flat.reshape(height, width).numpy()


def choose_example() -> Example:
    """The shipped scene, and a leaf of median size."""
    scene = load_scene(demo_scene())
    regions = load_masks(scene, demo_scene() / "masks")
    matching = match_regions(regions, scene.cameras)
    here = (regions.view_index == SOURCE).nonzero()[:, 0]
    leaf = int(here[regions.areas[here].argsort()[len(here) // 2]])
    members = matching.instance_ids == matching.instance_ids[leaf]
    return Example(scene=scene, regions=regions, matching=matching, leaf=leaf, members=members)


def caption(image: np.ndarray, text: str) -> np.ndarray:
    image[-32:] //= 3
    cv2.putText(image, text, (12, image.shape[0] - 10), cv2.FONT_HERSHEY_SIMPLEX, 0.7, WHITE, 1, cv2.LINE_AA)
    return image


def draw_bands(example: Example) -> list[np.ndarray]:
    """The mask of the leaf, and its epipolar bands in other views."""
    source = example.photo(SOURCE)
    example.outline(source, example.leaf, ORANGE)
    tiles = [caption(source, f"view {SOURCE}: one mask")]
    for view in OTHERS:
        canvas = example.photo(view)
        band = example.epipolar_map(torch.tensor([example.leaf]), view) > 0
        canvas[band] = 0.5 * canvas[band] + 0.5 * np.array(BLUE)
        for region in example.in_view(view):
            is_member = bool(example.members[region])
            example.outline(canvas, region, ORANGE if is_member else WHITE, thickness=2 if is_member else 1)
        tiles.append(caption(canvas, f"view {view}: its band, and all masks"))
    return tiles


def draw_hypotheses(example: Example) -> list[np.ndarray]:
    """One pixel of the leaf, and the hypotheses along its ray; the one with most members is a large dot."""
    cameras, sweep = example.scene.cameras, sweep_planes(example.regions, example.scene.cameras)
    pixels = np.flatnonzero(sweep.pixel_region == example.leaf)
    pixel = pixels[len(pixels) // 2]
    u, v = sweep.pixel_xy[pixel]
    source = example.photo(SOURCE)
    example.outline(source, example.leaf, ORANGE)
    cv2.circle(source, (round(float(u)), round(float(v))), 7, WHITE, -1)
    tiles = [caption(source, "one of its pixels")]
    on_ray = np.flatnonzero(sweep.pixel == pixel)
    K, R, t = (part[SOURCE].numpy() for part in (cameras.K, cameras.R, cameras.t))
    depths = 1 / sweep.inverse_depth[on_ray]
    points = (np.stack([u, v, 1.0]) @ np.linalg.inv(K).T * depths[:, None] - t) @ R  # world
    seen = cameras.project(torch.from_numpy(points))[0].numpy()
    num_members = (np.isin(sweep.labels[on_ray], np.flatnonzero(example.members.numpy()))).sum(1)
    for view in OTHERS:
        canvas = example.photo(view)
        for region in example.in_view(view):
            example.outline(canvas, region, ORANGE if example.members[region] else WHITE, thickness=1)
        spots = np.rint(seen[view]).astype(int).tolist()
        for spot in spots:
            cv2.circle(canvas, tuple(spot), 4, WHITE, -1)
        cv2.circle(canvas, tuple(spots[num_members.argmax()]), 8, ORANGE, -1)
        tiles.append(caption(canvas, f"view {view}: its hypotheses, dots on the ray"))
    return tiles


def draw_cluster(example: Example) -> list[np.ndarray]:
    """The epipolar map of the leaf's cluster, and the cluster in other views."""
    share = (example.epipolar_map(example.members, SOURCE) * 255).astype(np.uint8)
    heat = cv2.cvtColor(cv2.applyColorMap(share[..., None], cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB)
    example.outline(heat, example.leaf, WHITE, thickness=1)
    tiles = [caption(heat, f"view {SOURCE}: the map of its cluster")]
    ids = torch.where(example.members, example.matching.instance_ids, -1)
    cluster = replace(example.matching.masks, instance_ids=ids)
    for view in OTHERS:
        overlay = draw_overlay(example.photo(view), cluster, view=view)
        tiles.append(caption(overlay, f"view {view}: its cluster"))
    return tiles


def main() -> None:
    example = choose_example()
    rows = [draw_bands(example), draw_hypotheses(example), draw_cluster(example)]
    image = np.concatenate([np.concatenate(row, 1) for row in rows])
    image = cv2.resize(image, None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(DOCS / "matching.jpg"), cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 85])


if __name__ == "__main__":
    main()
