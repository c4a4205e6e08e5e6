"""Real plants, read from outside the project; skipped where they are missing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
import torch

from benchmarks.tracking import read_pair
from conftest import true_ids
from mvseg.cli import main
from mvseg.errors import InputWarning
from mvseg.evaluation.id_metrics import matching_metrics
from mvseg.formats.photos import read_photo
from mvseg.formats.scene_folder import load_masks, load_scene
from mvseg.matching.config import MatchConfig
from mvseg.matching.match import match_regions
from mvseg.reconstruction.config import ReconstructConfig
from mvseg.reconstruction.voxels import back_project
from mvseg.regions import Regions
from mvseg.scene import Cameras
from mvseg.tracking.track import track_leaves

pytestmark = pytest.mark.shared_data


@pytest.fixture(scope="module")
def basil(shared_data: Path) -> tuple[Cameras, Regions, torch.Tensor]:
    """Cameras, masks and their true leaves."""
    folder = shared_data / "basil-0729"
    scene = load_scene(folder)
    regions = load_masks(scene, folder / "masks")
    return scene.cameras, regions, true_ids(scene, regions, folder / "truth")


@pytest.mark.parametrize(("method", "least"), [("symnmf", (0.98, 0.96)), ("one-per-view", (1, 1)), ("nview", (1, 1))])
def test_basil_gets_its_leaves(
    method: Any, least: tuple[float, float], basil: tuple[Cameras, Regions, torch.Tensor]
) -> None:
    """Measured: symnmf s_match 0.989, e_k 0, ARI 0.975; the others are right everywhere."""
    cameras, regions, truth = basil
    assert len(regions) == 95
    metrics = matching_metrics(match_regions(regions, cameras, MatchConfig(method=method)).instance_ids, truth)
    assert metrics.e_k == 0
    assert metrics.s_match >= least[0]
    assert metrics.ari >= least[1]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_leaves_of_a_basil_go_on_over_six_days(shared_data: Path, tmp_path: Path) -> None:
    """Of the nine that both dates have, eight go on at least, and no link that is believed in is wrong. Measured: 9."""
    for name in ("basil-pair", "basil-0729"):
        folder = shared_data / name
        assert main(["infer", str(folder), "--masks", str(folder / "masks"), "--out", str(tmp_path / name)]) == 0
    dates, truth = read_pair(shared_data / "basil-pair" / "pair.json", tmp_path)
    shown = {(n, leaf.leaf): true for n in (0, 1) for leaf, true in zip(dates[n].leaves, truth[n], strict=True)}
    rows = [row for row in track_leaves(dates).rows if row.leaf is not None]
    before = {row.track: shown[0, row.leaf] for row in rows if row.date == 0}
    links = [(row.probability, shown[1, row.leaf] == before[row.track])
             for row in rows if row.date == 1 and row.track in before]  # fmt: skip
    assert sum(is_right for _, is_right in links) >= 8
    assert all(is_right for chance, is_right in links if chance > 0.9)


@pytest.mark.slow
def test_maize_is_one_plant_of_its_height(shared_data: Path) -> None:
    folder = shared_data / "maize-plant1"
    scene = load_scene(folder)
    assert scene.unit == "mm"
    with pytest.warns(InputWarning, match="each photo shows one instance"):
        regions = load_masks(scene, folder / "silhouettes")
    assert len(regions) == 12
    matching = match_regions(regions, scene.cameras)
    assert matching.instance_ids.unique().tolist() == [1]
    grid = back_project(regions, scene.cameras, config=ReconstructConfig(voxel_budget=400_000))
    assert grid is not None
    extent = grid.points.amax(0) - grid.points.amin(0)
    assert 1100 < float(extent[2]) < 1300
    assert float(extent[0]) < 1200


def test_fern_loads_projects_and_is_undistorted(shared_data: Path) -> None:
    folder = shared_data / "fern-llff"
    scene = load_scene(folder)
    assert len(scene.views) == 20
    model = pycolmap.Reconstruction(folder / "sparse")
    points = torch.tensor(np.array([point.xyz for point in model.points3D.values()]))
    px, _ = scene.cameras.project(points)
    by_name = {image.name: image for image in model.images.values()}
    order = {number: row for row, number in enumerate(model.points3D)}

    def in_photo(index: int, px: torch.Tensor) -> np.ndarray:
        rays = np.concatenate([px.numpy(), np.ones((len(px), 1))], 1) @ np.linalg.inv(scene.cameras.K[index].numpy()).T
        return np.asarray(scene.views[index].lens.img_from_cam(rays))

    for index in (0, 13):
        seen = [p for p in by_name[scene.views[index].path.name].points2D if p.has_point3D()]
        shown = in_photo(index, px[index][[order[p.point3D_id] for p in seen]])
        assert np.median(np.linalg.norm(shown - np.array([p.xy for p in seen]), axis=1)) < 1.0
        assert read_photo(scene, index).shape == (529, 706, 3)
    moved = np.abs(px[0].numpy() - in_photo(0, px[0])).max(1)
    inside = ((px[0] > 0) & (px[0] < torch.tensor([706, 529]))).all(1).numpy()
    assert 0.5 < moved[inside].max() < 10  # the lens bends by up to some pixels
