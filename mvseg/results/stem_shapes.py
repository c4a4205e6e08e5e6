"""Stems and petioles as they are drawn: tubes in space, lines in photos."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import NDArray

from mvseg.reconstruction.stem.stem_axis import sweep_circle
from mvseg.results.result import Result
from mvseg.traits.nodes import Stem

STEM_COLOR, PETIOLE_COLOR = (126, 104, 66), (170, 176, 120)  # definition: of stems, and of petioles, which are guessed
SURE_STEM = 0.9  # chosen: probability from which a stem is drawn as one line, not dashed
STEM_WIDTH, PETIOLE_WIDTH = 0.012, 0.006  # definition: radius where it is not known, in lengths of the stem


@dataclass(frozen=True, eq=False)
class StemPart:
    """A stem (`leaf` is None), or the petiole of a leaf, along points (P, 3) with radii (P,). `name` is that of its
    node in glTF, `color` RGB, 0 to 255. Petioles, and stems less likely than `SURE_STEM`, are guessed."""

    name: str
    leaf: int | None
    points: NDArray[np.float64]
    radius: NDArray[np.float64]
    color: tuple[int, int, int]
    is_guessed: bool = True

    def mesh(self) -> trimesh.Trimesh:
        return sweep_circle(self.points, self.radius)


def parts_of(result: Result) -> list[StemPart]:
    """The stems and petioles of a result. A single stem that no mask shows goes on to lower leaves without a node."""
    stems = () if result.traits is None else result.traits.stems
    parts = [part for stem in stems for part in stem_parts(stem)]
    surfaces = result.surfaces or {}
    if len(stems) == 1 and stems[0].source != "masks":
        others = sorted(surfaces.keys() - {node.leaf for node in stems[0].nodes})
        parts += continue_below(parts[0], [surfaces[leaf].points().reshape(-1, 3).mean(0).numpy() for leaf in others])
    return parts


def stem_parts(stem: Stem) -> Iterator[StemPart]:
    """A stem to its outer nodes at least, as thick as masks show it, and thin tubes to the blades: guessed petioles."""
    axis, length = stem.axis.reach([node.place for node in stem.nodes]), max(stem.axis.length, 1e-300)
    radius = axis.radius if axis.radius.any() else np.full(len(axis.points), STEM_WIDTH * length)
    yield StemPart(f"stem_{stem.number}", None, axis.points, radius, STEM_COLOR, stem.probability < SURE_STEM)
    for node in stem.nodes:
        ends = np.array([node.place, node.base])
        if np.linalg.norm(ends[1] - ends[0]) > PETIOLE_WIDTH * length:
            width = np.full(2, PETIOLE_WIDTH * length)
            yield StemPart(f"petiole_{node.leaf:03d}", node.leaf, ends, width, PETIOLE_COLOR)


def continue_below(stem: StemPart, middles: Sequence[NDArray[np.float64]]) -> list[StemPart]:
    """The stem straight on from its lower end, guessed, to the lowest middle (3,) of a leaf; [] where none is lower."""
    ahead = stem.points[0] - stem.points[min(3, len(stem.points) - 1)]
    beyond = max([0.0, *((each - stem.points[0]) @ ahead / max(ahead @ ahead, 1e-300) for each in middles)])
    ends = np.array([stem.points[0] + beyond * ahead, stem.points[0]])
    below = replace(stem, name=f"{stem.name}_below", points=ends, radius=stem.radius[[0, 0]], is_guessed=True)
    return [below] if beyond > 0 else []
