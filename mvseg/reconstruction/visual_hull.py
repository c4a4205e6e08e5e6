"""The space that most masks of an instance allow, as cells of an octree: the visual hull, coarsely.

A cube is halved again and again; cells of which too few masks can show any point are dropped. Cells are judged by the
balls around them, so nothing is lost, however thin.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from mvseg.reconstruction.numbers import VOXELS
from mvseg.scene import nearest_point


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells of a cube: cell (a, b, c) reaches from corner + size * (a, b, c) to corner + size * (a + 1, b + 1, c + 1).
    `indices` are (P, 3) int64, `corner` (3,) float64, of the cube, in the world."""

    indices: Tensor
    corner: Tensor
    size: float

    def __len__(self) -> int:
        return len(self.indices)

    @property
    def centers(self) -> Tensor:
        """(P, 3) float64."""
        return self.corner + self.size * (self.indices.double() + 0.5)

    @property
    def box(self) -> tuple[Tensor, Tensor]:
        """Lowest and highest corner (3,) of at least one cell."""
        low, high = self.indices.amin(0).double(), self.indices.amax(0).double() + 1
        return self.corner + self.size * low, self.corner + self.size * high

    def divide(self, parts: int) -> Cells:
        """Each side in so many parts."""
        within = torch.cartesian_prod(*[torch.arange(parts)] * 3).reshape(-1, 3).to(self.indices)
        return Cells((parts * self.indices[:, None] + within).flatten(0, 1), self.corner, self.size / parts)


@dataclass(frozen=True, eq=False)
class Silhouettes:
    """S masks of one instance, one in a view, each with at least one pixel.

    Attributes:
        masks: S times (h, w) bool, of any sizes.
        px_from_world: (S, 3, 4) float64, to the pixels of each.
    """

    masks: tuple[Tensor, ...]
    px_from_world: Tensor

    def __len__(self) -> int:
        return len(self.masks)

    @cached_property
    def centers(self) -> Tensor:
        """(S, 3) of the cameras."""
        return -torch.linalg.solve(self.px_from_world[:, :, :3], self.px_from_world[:, :, 3:])[..., 0]

    @cached_property
    def middle(self) -> Tensor:
        """(3,) the point nearest to the rays through the middles of the masks; of parallel rays, one of many."""
        middles = torch.stack([mask.nonzero().double().mean(0).flip(0) + 0.5 for mask in self.masks])
        px = torch.nn.functional.pad(middles, (0, 1), value=1.0)
        return nearest_point(self.centers, torch.linalg.solve(self.px_from_world[:, :, :3], px[..., None])[..., 0])

    @cached_property
    def distances(self) -> Tensor:
        """(S,) of the cameras from the middle."""
        return torch.linalg.vector_norm(self.centers - self.middle, dim=1)

    @cached_property
    def cube(self) -> Cells:
        """One cell about the middle, that reaches twice as far as the farthest camera."""
        reach = 2 * self.distances.max().clamp(min=1e-9)
        return Cells(torch.zeros(1, 3).to(self.middle.device, torch.int64), self.middle - reach, 2 * float(reach))

    @cached_property
    def focal(self) -> Tensor:
        """(S,) the larger focal length, pixels."""
        rows = self.px_from_world[:, :, :3]
        axis = rows[:, 2:]
        return torch.linalg.vector_norm(rows[:, :2] - (rows[:, :2] @ axis.mT) * axis, dim=2).amax(1)

    @cached_property
    def _slant(self) -> Tensor:
        """(S,) the largest distance from the camera per unit of depth, over the rays of the mask's frame."""
        corners = [[(x, y, 1.0) for x in (0, mask.shape[1]) for y in (0, mask.shape[0])] for mask in self.masks]
        rays = torch.linalg.solve(self.px_from_world[:, :, :3], torch.tensor(corners).to(self.px_from_world).mT)
        return torch.linalg.vector_norm(rays, dim=1).amax(1)

    @cached_property
    def _integrals(self) -> tuple[Tensor, Tensor, Tensor]:
        """Integral images of all masks in one row; first place (S, 1) and columns and rows (S, 1, 2) of each."""
        sums = [torch.nn.functional.pad(mask.int().cumsum(0).cumsum(1), (1, 0, 1, 0)).flatten() for mask in self.masks]
        first = torch.tensor([0, *(len(each) for each in sums[:-1])]).cumsum(0)
        sides = torch.tensor([(mask.shape[1], mask.shape[0]) for mask in self.masks])
        return torch.cat(sums), first[:, None].to(sums[0].device), sides[:, None].to(sums[0].device)

    def may_meet(self, points: Tensor, radius: float) -> Tensor:
        """(S, P) bool: can a mask meet the projection of a ball about a point (P, 3)? The projection is replaced by a
        square of pixels that contains it, so the answer errs only towards True."""
        cam = points @ self.px_from_world[:, :, :3].mT + self.px_from_world[:, None, :, 3]
        depth, distance = cam[..., 2], torch.linalg.vector_norm(points - self.centers[:, None], dim=2)
        # |u' - u| <= f r sqrt(1 + (X / Z)^2) / (Z - r), and distance / depth is the root, or more.
        is_ahead = depth > radius
        ahead = depth.where(is_ahead, 2 * radius)
        px = cam[..., :2] / ahead[..., None]
        margin = (radius * self.focal[:, None] / (ahead - radius) * distance / ahead)[..., None]
        sums, first, sides = self._integrals
        low = (px - margin).floor().clamp(min=0).minimum(sides).long()
        high = ((px + margin).floor() + 1).clamp(min=0).minimum(sides).long()
        top, bottom = (first + edge[..., 1] * (sides[..., 0] + 1) for edge in (low, high))
        left, right = low[..., 0], high[..., 0]
        count = sums[bottom + right] - sums[top + right] - sums[bottom + left] + sums[top + left]
        # What reaches behind a camera has no bounded image. A point of the mask in it has a depth below 2 r, thus
        # lies within 2 r slant of the camera, and the ball's center within r of that.
        beside = (depth > -radius) & (distance <= radius * (1 + 2 * self._slant[:, None]))
        return torch.where(is_ahead, count > 0, beside)


def halve_cells(silhouettes: Silhouettes, threshold: float) -> Iterator[Cells]:
    """The cube of the silhouettes in ever smaller cells, without end: those whose points more than this share of the
    masks may show. Masks of nearly parallel views may share an unbounded space, which ends at the cube."""
    cells = silhouettes.cube
    while True:
        cells = cells.divide(2)
        radius, step = cells.size * 0.75**0.5, max(1, VOXELS.at_once // len(silhouettes))
        votes = [silhouettes.may_meet(part, radius).sum(0) for part in cells.centers.split(step)]
        is_left = torch.cat(votes) > threshold * len(silhouettes) + 1e-6
        cells = Cells(cells.indices[is_left], cells.corner, cells.size)
        yield cells
