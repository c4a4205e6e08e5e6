from __future__ import annotations

import numpy as np
import pytest
import torch

from blade_scene import EllipticBlade, as_regions, blade_masks, ring_cameras
from mvseg.reconstruction.config import ReconstructConfig
from mvseg.reconstruction.shapes import best_shape, reconstruct_voxels
from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.reconstruction.voxels import VoxelGrid, reconstruct_instances
from mvseg.regions import Regions
from mvseg.scene import Cameras
from warned import warns_of

CAMERAS = ring_cameras(4)
COARSE = ReconstructConfig(voxel_budget=2000)


@pytest.fixture(scope="module")
def two_blades() -> tuple[Regions, torch.Tensor]:
    """The same blade as instance 1 and, mirrored in every picture, as instance 2, which is thus nowhere in space."""
    maps = []
    for view, mask in enumerate(blade_masks(EllipticBlade(half_length=0.6), CAMERAS)):
        labels = mask.astype(np.int64)
        labels[:20, :20] = 2 if view == 0 else 0
        labels[-20:, -20:] = 2 if view == 1 else 0
        maps.append(labels)
    return as_regions(maps)


def test_instances_without_a_credible_surface_get_voxels(two_blades: tuple[Regions, torch.Tensor]) -> None:
    """The voxels that voxels alone would give: other instances hide as before."""
    surfaces = {n: LeafSurface.none(torch.arange(6 - 2 * n), "test", "for the test") for n in (1, 2)}
    with warns_of("no_shape"):
        voxels = reconstruct_voxels(*two_blades, CAMERAS, config=COARSE, surfaces=surfaces)
    with warns_of("no_shape"):
        expected = reconstruct_instances(*two_blades, CAMERAS, config=COARSE)
    assert voxels.keys() == expected.keys() == {1}
    assert torch.equal(voxels[1].votes, expected[1].votes)
    assert isinstance(best_shape(1, surfaces, voxels), VoxelGrid)
    assert best_shape(2, surfaces, voxels) is None


@pytest.mark.parametrize("shape", ["surface", "both", "voxels"])
def test_what_is_made_is_what_was_asked_for(shape: str) -> None:
    masks = as_regions(blade_masks(EllipticBlade(), CAMERAS))
    config = ReconstructConfig(shape=shape, voxel_budget=2000)  # type: ignore[arg-type]
    surfaces = None if shape == "voxels" else fit_surfaces(*masks, CAMERAS)
    voxels = reconstruct_voxels(*masks, CAMERAS, config=config, surfaces=surfaces)
    assert voxels.keys() == (set() if shape == "surface" else {1})
    assert isinstance(best_shape(1, surfaces, voxels), VoxelGrid if shape == "voxels" else LeafSurface)


def test_results_have_no_crumbs_and_the_rule_of_the_paper_keeps_them() -> None:
    """A speck beside the blade, in the masks of all views at the same place in space."""
    speck = EllipticBlade(half_length=0.05, half_width=0.05)
    blade = blade_masks(EllipticBlade(half_length=0.7), CAMERAS)
    masks = as_regions([near | far for near, far in zip(blade, speck_masks(speck), strict=True)])
    config = ReconstructConfig(shape="voxels", voxel_budget=60_000)
    plain = reconstruct_instances(*masks, CAMERAS, config=config)[1]
    voxels = reconstruct_voxels(*masks, CAMERAS, config=config)
    assert (plain.num_pieces, voxels[1].num_pieces) == (2, 1)
    assert 0 < plain.volume - voxels[1].volume < 0.02 * plain.volume


def speck_masks(speck: EllipticBlade) -> list[np.ndarray]:
    """As if it lay at x = 1.2: the cameras are moved the other way."""
    shift = torch.tensor([1.2, 0.0, 0.0]).double()
    moved = Cameras(K=CAMERAS.K, R=CAMERAS.R, t=CAMERAS.t + CAMERAS.R @ shift, sizes=CAMERAS.sizes)
    return blade_masks(speck, moved)
