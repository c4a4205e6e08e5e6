"""Stems on the page: lines in the photos, and the nodes of the diagram."""

from __future__ import annotations

from typing import Any

import numpy as np

from mvseg.formats.text_file import short_number
from mvseg.results.report.pictures import UNITS, Picture
from mvseg.results.result import Result
from mvseg.results.stem_shapes import StemPart, stem_parts


def parts_of(result: Result) -> list[StemPart]:
    """The stems and petioles of a result; none without traits."""
    stems = () if result.traits is None else result.traits.stems
    return [part for stem in stems for part in stem_parts(stem)]


def draw_lines(result: Result, view: int, picture: Picture) -> list[dict[str, Any]]:
    """Stems and petioles in one photo: paths of SVG in the units of its picture, and the leaf of a petiole."""
    width, height = result.scene.cameras.sizes[view].tolist()
    px_from_world = result.scene.cameras.px_from_world[view].cpu().numpy()
    corner = np.array(picture.box[:2]) * (width, height)
    scale = UNITS / ((picture.box[2] - picture.box[0]) * width)
    lines = []
    for part in parts_of(result):
        cam = part.points @ px_from_world[:, :3].T + px_from_world[:, 3]
        if (cam[:, 2] > 0).all():
            places = np.round((cam[:, :2] / cam[:, 2:] - corner) * scale).astype(int).tolist()
            path = "M" + "L".join(f"{x} {y}" for x, y in places)
            line = {"path": path, "isGuessed": part.is_guessed}
            lines.append(line if part.leaf is None else line | {"leaf": part.leaf})
    return lines


def describe_stems(result: Result) -> list[dict[str, Any]]:
    """One entry per stem: its source, the phyllotaxis that it suggests, and its nodes, upwards."""
    stems = []
    for stem in () if result.traits is None else result.traits.stems:
        suggested = stem.phyllotaxis
        nodes = [
            {"leaf": node.leaf, "node": node.number, "azimuth": short_number(node.node_azimuth.value)}
            | {"height": short_number(node.height.value), "sd": short_number(node.height.sd)}
            for node in stem.nodes
        ]
        phyllotaxis = {"angle": short_number(suggested.angle), "probability": short_number(suggested.probability)}
        about = {"number": stem.number, "source": stem.source, "nodes": nodes, "name": suggested.name}
        stems.append(about | phyllotaxis | {"chance": short_number(stem.probability)})
    return stems
