"""Makes docs/matching.jpg: one leaf, its bands, its rows and its cluster. `python docs/matching_picture.py`"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

from mvseg import epipolar_map, load_masks, load_scene, match_regions
from mvseg.demo import demo_scene
from mvseg.formats.photos import read_photo
from mvseg.matching.nview.label_rows import row_table
from mvseg.results.overlay import draw_overlay

DOCS = Path(__file__).parent
SOURCE, OTHERS = 1, (3, 5, 7)
ORANGE, WHITE, BLUE = (255, 140, 0), (255, 255, 255), (60, 120, 255)


def outline(image: np.ndarray, mask: torch.Tensor, color: tuple[int, int, int], thickness: int = 2) -> None:
    """Draw the border of a (H, W) bool mask into an RGB image."""
    borders, _ = cv2.findContours(mask.numpy().astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(image, borders, -1, color, thickness)


def caption(image: np.ndarray, text: str) -> np.ndarray:
    image[-32:] //= 3
    cv2.putText(image, text, (12, image.shape[0] - 10), cv2.FONT_HERSHEY_SIMPLEX, 0.7, WHITE, 1, cv2.LINE_AA)
    return image


def main() -> None:
    scene = load_scene(demo_scene())
    regions, cameras = load_masks(scene, demo_scene() / "masks"), scene.cameras
    matching = match_regions(regions, cameras)
    table = row_table(regions, cameras)
    width, height = cameras.sizes[SOURCE].tolist()
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    xy = torch.stack((columns, rows), -1).reshape(-1, 2) + 0.5
    here = (regions.view_index == SOURCE).nonzero()[:, 0]
    leaf = int(here[regions.areas[here].argsort()[len(here) // 2]])  # one of middling size
    members = matching.instance_ids == matching.instance_ids[leaf]

    photos = {view: read_photo(scene, view) for view in (SOURCE, *OTHERS)}
    bands = [photos[SOURCE].copy()]
    outline(bands[0], regions.mask(leaf, width, height), ORANGE)
    rays = [bands[0].copy()]
    caption(bands[0], f"view {SOURCE}: one mask")
    pixels = np.flatnonzero(table.pixel_region == leaf)
    pixel = pixels[len(pixels) // 2]
    u, v = table.pixel_xy[pixel]
    cv2.circle(rays[0], (round(float(u)), round(float(v))), 7, WHITE, -1)
    caption(rays[0], "one of its pixels")
    on_ray = np.flatnonzero(table.pixel == pixel)
    K, R, t = (x[SOURCE].numpy() for x in (cameras.K, cameras.R, cameras.t))
    agree = (np.isin(table.labels[on_ray], np.flatnonzero(members.numpy()))).sum(1)
    for view in OTHERS:
        canvas = photos[view].copy()
        band = epipolar_map(regions.select(torch.tensor([leaf])), cameras, view=view, xy=xy).reshape(height, width) > 0
        canvas[band] = 0.5 * canvas[band] + 0.5 * np.array(BLUE)
        for other in ((regions.view_index == view).nonzero()[:, 0]).tolist():
            color = ORANGE if members[other] else WHITE
            outline(canvas, regions.mask(other, width, height), color, 2 if members[other] else 1)
        bands.append(caption(canvas, f"view {view}: its band, and all masks"))

        canvas = photos[view].copy()
        for other in ((regions.view_index == view).nonzero()[:, 0]).tolist():
            outline(canvas, regions.mask(other, width, height), ORANGE if members[other] else WHITE, 1)
        depths = 1 / table.inverse_depth[on_ray]
        points = (np.stack([u, v, 1.0]) @ np.linalg.inv(K).T * depths[:, None] - t) @ R  # world
        seen = (points @ cameras.R[view].numpy().T + cameras.t[view].numpy()) @ cameras.K[view].numpy().T
        spots = np.rint(seen[:, :2] / seen[:, 2:]).astype(int)
        for spot in spots.tolist():
            cv2.circle(canvas, tuple(spot), 4, WHITE, -1)
        cv2.circle(canvas, tuple(spots[agree.argmax()].tolist()), 8, ORANGE, -1)
        rays.append(caption(canvas, f"view {view}: its rows, dots on the ray"))

    cluster = epipolar_map(regions.select(members), cameras, view=SOURCE, xy=xy).reshape(height, width, 1).numpy()
    heat = cv2.cvtColor(cv2.applyColorMap((cluster * 255).astype(np.uint8), cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB)
    outline(heat, regions.mask(leaf, width, height), WHITE, 1)
    last = [caption(heat, f"view {SOURCE}: the map of its cluster")]
    only = replace(matching, instance_ids=torch.where(members, matching.instance_ids, -1))
    for view in OTHERS:
        last.append(caption(draw_overlay(photos[view], regions, only, view=view), f"view {view}: its cluster"))
    image = np.concatenate([np.concatenate(row, 1) for row in (bands, rays, last)])
    image = cv2.resize(image, None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(DOCS / "matching.jpg"), cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 85])


if __name__ == "__main__":
    main()
