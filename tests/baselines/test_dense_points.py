from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
import torch
import trimesh
from scipy.spatial import cKDTree

from benchmarks.baselines.dense_points import (
    DensePoints,
    Workspace,
    depth_normals,
    fuse_depths,
    patch_match_points,
    read_dense_points,
    read_small_photos,
    sgbm_points,
    write_map,
)
from benchmarks.baselines.mvs import match_mvs
from leafy_scene import LeafyScene
from mvseg.errors import InputError
from mvseg.evaluation.id_metrics import matching_metrics
from mvseg.formats.photos import read_photo
from mvseg.scene import Scene
from synthetic import moved


@pytest.fixture(scope="module")
def photos(leafy: LeafyScene) -> list[np.ndarray]:
    return [read_photo(leafy.scene, view) for view in range(10)]


def true_depths(leafy: LeafyScene) -> list[np.ndarray]:
    """Of the leaves alone: their surfaces are known as meshes."""
    maps = [leafy.regions.label_map(view, leafy.regions.labels, (320, 320)).numpy() for view in range(10)]
    return [np.where(labels > 0, depth, 0).astype(np.float32) for labels, depth in zip(maps, leafy.depths, strict=True)]


def distance_to(points: torch.Tensor, targets: torch.Tensor) -> np.ndarray:
    """(Q,) from each target to the nearest point."""
    return np.asarray(cKDTree(points.numpy()).query(targets.numpy())[0])


@pytest.mark.slow
def test_sgbm_finds_surfaces_and_matches_the_leaves(leafy: LeafyScene) -> None:
    """On an easy scene, so that its failures on a hard one are the method's."""
    points = sgbm_points(leafy.scene)
    assert points.backend == "sgbm"
    unit = float(torch.linalg.vector_norm(leafy.scene.cameras.t, dim=1).mean())  # distance from the plant, about
    assert np.quantile(distance_to(points.positions, leafy.vertices), 0.9) < 0.01 * unit
    matching = match_mvs(leafy.regions, leafy.scene, points)
    metrics = matching_metrics(matching.instance_ids, leafy.regions.labels)
    assert metrics.s_match >= 0.95
    assert metrics.ari >= 0.9
    assert matching.report.method == "mvs (sgbm)"


def test_true_depths_are_fused_to_the_surface_wherever_the_world_is(
    leafy: LeafyScene, photos: list[np.ndarray]
) -> None:
    cameras, depths = leafy.scene.cameras, true_depths(leafy)
    here = fuse_depths(photos, depths, cameras)
    leaf_size = float((leafy.vertices.amax(0) - leafy.vertices.amin(0)).max())
    surface = leafy.vertices
    assert np.quantile(distance_to(surface, here), 0.99) < 0.03 * leaf_size
    shift = torch.tensor([4e6, -2e6, 1e6]).double()
    away = moved(cameras, 1000.0, torch.eye(3).double(), shift)
    there = fuse_depths(photos, [1000 * depth for depth in depths], away)
    assert len(there) == pytest.approx(len(here), rel=0.02)
    assert np.quantile(distance_to(surface, (there - shift) / 1000), 0.99) < 0.03 * leaf_size


def test_no_depths_no_points(leafy: LeafyScene, photos: list[np.ndarray]) -> None:
    blank = [np.zeros(photo.shape[:2], np.float32) for photo in photos]
    assert fuse_depths(photos, blank, leafy.scene.cameras).shape == (0, 3)
    apart = Scene("apart", leafy.scene.views[:1] + leafy.scene.views[9:], leafy.scene.cameras[[0, 9]])
    none = sgbm_points(apart)  # 45 degrees of azimuth
    assert none.positions.shape == (0, 3)
    assert none.positions.dtype == torch.float64


def test_patch_match_without_cuda_is_refused(leafy: LeafyScene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pycolmap, "has_cuda", False)
    with pytest.raises(InputError, match="needs a pycolmap with CUDA"):
        patch_match_points(leafy.scene)


def test_patch_match_gets_a_whole_workspace(leafy: LeafyScene, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the true depths in place of those that a graphics card would find."""
    depths, cameras = true_depths(leafy), leafy.scene.cameras

    def write_true_maps(folder: str, options: pycolmap.PatchMatchOptions) -> None:
        workspace = Workspace(Path(folder), cameras)
        lines = (workspace.folder / "stereo" / "patch-match.cfg").read_text().splitlines()
        assert lines[0] == "00000.png"
        assert lines[1].split(", ")[:2] == ["00001.png", "00002.png"]
        assert len(lines) == 20
        for view, depth in enumerate(depths):
            depths_there = depth[depth > 0] / workspace.unit
            assert options.depth_min < depths_there.min() < depths_there.max() < options.depth_max
            assert cv2.imread(str(workspace.folder / "images" / workspace.image_name(view))).shape == (320, 320, 3)
            write_map(workspace.map_path("depth", view), (depth / workspace.unit)[None])
            write_map(workspace.map_path("normal", view), depth_normals(depth, cameras.K[view].numpy()))

    monkeypatch.setattr(pycolmap, "has_cuda", True)
    monkeypatch.setattr(pycolmap, "patch_match_stereo", write_true_maps)
    points = patch_match_points(leafy.scene)
    assert points.backend == "patchmatch"
    leaf_size = float((leafy.vertices.amax(0) - leafy.vertices.amin(0)).max())
    assert len(points.positions) > 1000
    assert np.quantile(distance_to(leafy.vertices, points.positions), 0.99) < 0.03 * leaf_size


@pytest.mark.skipif(not pycolmap.has_cuda, reason="PatchMatch needs a pycolmap with CUDA and a graphics card")
def test_patch_match_finds_the_leaves(leafy: LeafyScene) -> None:
    points = patch_match_points(leafy.scene)
    leaf_size = float((leafy.vertices.amax(0) - leafy.vertices.amin(0)).max())
    assert len(points.positions) > 1000
    assert np.quantile(distance_to(leafy.vertices, points.positions), 0.5) < 0.03 * leaf_size


def test_model_of_a_workspace_holds_the_cameras(leafy: LeafyScene, photos: list[np.ndarray], tmp_path: Path) -> None:
    workspace = Workspace(tmp_path, leafy.scene.cameras)
    workspace.write(photos)
    model = pycolmap.Reconstruction(tmp_path / "sparse")
    point = torch.tensor([[0.1, -0.05, 0.2]]).double()
    pixels, _ = leafy.scene.cameras.project(workspace.to_world(point))
    for image in model.images.values():
        view = int(Path(image.name).stem)
        np.testing.assert_allclose(image.project_point(point[0].numpy()), pixels[view, 0].numpy(), atol=1e-6)


def test_points_of_a_file_or_a_workspace_are_read(leafy: LeafyScene, photos: list[np.ndarray], tmp_path: Path) -> None:
    positions = np.array([[0.0, 1.0, 2.0], [3.0, 4.0, 5.5]])
    trimesh.PointCloud(positions).export(tmp_path / "fused.ply")
    for path in (tmp_path, tmp_path / "fused.ply", str(tmp_path / "fused.ply")):
        points = read_dense_points(path)
        assert points.backend == "file"
        np.testing.assert_array_equal(points.positions.numpy(), positions)
    workspace = Workspace(tmp_path / "dense", leafy.scene.cameras)
    workspace.write(photos)
    for view, depth in enumerate(true_depths(leafy)):
        write_map(workspace.map_path("depth", view), (depth / workspace.unit)[None])
        write_map(workspace.map_path("normal", view), depth_normals(depth, leafy.scene.cameras.K[view].numpy()))
    assert len(read_dense_points(workspace.folder).positions) > 1000


def test_files_without_points_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no fused\.ply and no stereo/depth_maps"):
        read_dense_points(tmp_path)
    with pytest.raises(InputError, match=r"none\.ply: the file of dense points is missing"):
        read_dense_points(tmp_path / "none.ply")
    (tmp_path / "broken.ply").write_bytes(b"no ply at all")
    with pytest.raises(InputError, match=r"broken\.ply: cannot be read as a PLY file of points"):
        read_dense_points(tmp_path / "broken.ply")
    (tmp_path / "stereo" / "depth_maps").mkdir(parents=True)
    with pytest.raises(InputError, match="depth maps cannot be fused"):
        read_dense_points(tmp_path)
    with pytest.raises(InputError, match=r"expected finite numbers, \(P, 3\)"):
        DensePoints(torch.full((2, 3), torch.nan), "file")


def test_normals_of_a_plane() -> None:
    K = np.array([[100.0, 0, 20], [0, 100, 15], [0, 0, 1]])
    v, u = np.indices((30, 40)) + 0.5
    rays = np.stack(((u - 20) / 100, (v - 15) / 100, np.ones_like(u)), -1)
    normal = np.array([0.3, -0.4, -0.8])
    depth = (-5 / (rays @ normal)).astype(np.float32)
    depth[12, 12] = 0
    normals = depth_normals(depth, K)
    np.testing.assert_allclose(normals[:, 3, 3], normal / np.linalg.norm(normal), atol=1e-3)
    np.testing.assert_allclose(normals[:, 12, 13], -rays[12, 13] / np.linalg.norm(rays[12, 13]), atol=1e-6)
    assert ((normals * rays.transpose(2, 0, 1)).sum(0) < 0).all()


def test_map_file_is_colmaps(tmp_path: Path) -> None:
    values = np.arange(24, dtype=np.float32).reshape(3, 2, 4)
    write_map(tmp_path / "map.bin", values)
    header, body = (tmp_path / "map.bin").read_bytes().split(b"&", 3)[:3], (tmp_path / "map.bin").read_bytes()[6:]
    assert header == [b"4", b"2", b"3"]
    np.testing.assert_array_equal(np.frombuffer(body, "<f4").reshape(3, 2, 4), values)


def test_large_photos_are_made_smaller_with_their_cameras(leafy: LeafyScene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.baselines.dense_points.MAX_SIDE", 160)
    scene = replace(leafy.scene, views=leafy.scene.views[:2], cameras=leafy.scene.cameras[[0, 1]])
    small, cameras = read_small_photos(scene)
    assert small[0].shape == (160, 160, 3)
    assert cameras.sizes.tolist() == [[160, 160]] * 2
    full, _ = scene.cameras.project(leafy.vertices)
    torch.testing.assert_close(cameras.project(leafy.vertices)[0], full / 2)
