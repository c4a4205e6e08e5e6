from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from benchmarks.baselines import sparse
from benchmarks.baselines.sparse import (
    Keypoints,
    find_keypoints,
    keypoint_graph,
    keypoint_owners,
    match_keypoints,
    match_sparse,
)
from leafy_scene import LeafyScene
from mvseg.errors import InputError
from mvseg.evaluation.id_metrics import matching_metrics
from mvseg.formats.photos import read_photo
from mvseg.matching.config import MatchConfig
from mvseg.regions import regions_from_label_maps
from mvseg.scene import Scene, View
from reference import match_keypoints_reference
from synthetic import arc_positions, cameras_at


def test_finds_the_leaves_of_an_easy_scene(leafy: LeafyScene) -> None:
    found = match_sparse(leafy.regions, leafy.scene)
    metrics = matching_metrics(found.instance_ids, leafy.regions.labels)
    assert metrics.s_match >= 0.9
    assert metrics.ari >= 0.8
    assert found.report.method in ("sparse (akaze)", "sparse (sift)")


def test_the_papers_detector_is_used_where_opencv_has_it(leafy: LeafyScene, monkeypatch: pytest.MonkeyPatch) -> None:
    """ORB replaces AKAZE here: its descriptors are bits as well, and every OpenCV has it."""
    for name in ("AKAZE_create", "xfeatures2d"):
        monkeypatch.delattr(cv2, name, raising=False)
    assert sparse.keypoint_detector()[1] == "sift"
    monkeypatch.setattr(cv2, "xfeatures2d", SimpleNamespace(AKAZE_create=lambda: cv2.ORB.create(1000)), raising=False)
    found = match_sparse(leafy.regions, leafy.scene, MatchConfig(num_instances=4))
    assert found.report.method == "sparse (akaze)"
    assert found.num_instances <= 4
    assert matching_metrics(found.instance_ids, leafy.regions.labels).s_match >= 0.7


@pytest.mark.parametrize("is_binary", [False, True])
def test_matches_are_those_of_the_slow_twin(is_binary: bool) -> None:
    rng = np.random.default_rng(0)
    first = rng.integers(0, 2 if is_binary else 256, (40, 64)).astype(np.float32)
    second = rng.integers(0, 2 if is_binary else 256, (50, 64)).astype(np.float32)
    second[10:30] = first[:20]
    second[15:30, :20] = rng.integers(0, 2 if is_binary else 256, (15, 20))
    second[40] = second[10]  # seen twice: no clear match
    pairs = match_keypoints(*(Keypoints(torch.zeros(len(x), 2), torch.from_numpy(x)) for x in (first, second)))
    assert set(map(tuple, pairs.tolist())) == match_keypoints_reference(first, second, sparse.MAX_RATIO)
    assert 10 < len(pairs) <= 20


def test_keypoints_count_from_pixel_corners() -> None:
    """A bright disc about the pixel position (60.5, 40.5), in the middle of the pixel (60, 40)."""
    photo = np.full((96, 128, 3), 20, np.uint8)
    cv2.circle(photo, (60, 40), 6, (250, 250, 250), -1)
    xy = find_keypoints(cv2.GaussianBlur(photo, (0, 0), 1), cv2.SIFT.create(enable_precise_upscale=True)).xy
    assert (xy - torch.tensor([60.5, 40.5])).abs().amax(1).min() < 0.2


def test_edges_lead_to_the_region_with_most_shared_keypoints() -> None:
    """Two views of 64 x 32 pixels: region 0 (left) and 1 (right) in view 0, region 2 (left) and 3 (right) in view 1."""
    labels = np.zeros((32, 64), np.int64)
    labels[:, :30], labels[:, 34:] = 1, 2
    regions = regions_from_label_maps([labels, labels])
    cameras = cameras_at(arc_positions(2), width=64, height=32)
    # Keypoint k of one view is keypoint k of the other; columns in both views, 32 = between the regions.
    columns = torch.tensor([[5, 5], [6, 6], [7, 40], [40, 41], [41, 8], [42, 9], [32, 9], [32, 32]]).double()
    descriptors = torch.from_numpy(np.random.default_rng(0).integers(0, 256, (len(columns), 64)).astype(np.float32))
    keypoints = [Keypoints(torch.stack((x, torch.full_like(x, 3)), 1), descriptors) for x in columns.T]
    owners = keypoint_owners(regions, keypoints[0], view=0, size=[64, 32])
    assert owners.tolist() == [0, 0, 0, 1, 1, 1, -1, -1]
    # 0 and 1 share two with 2 and one with 3, which has no better partner.
    assert keypoint_graph(regions, cameras, keypoints).edges.tolist() == [[0, 2], [0, 3], [1, 2], [1, 3]]
    fewer = [Keypoints(points.xy[:3], points.descriptors[:3]) for points in keypoints]
    assert keypoint_graph(regions, cameras, fewer).edges.tolist() == [[0, 2], [0, 3]]


def test_order_of_regions_changes_nothing(leafy: LeafyScene) -> None:
    order = torch.randperm(len(leafy.regions), generator=torch.Generator().manual_seed(0))
    keypoints = [find_keypoints(read_photo(leafy.scene, view), cv2.ORB.create(500)) for view in range(10)]
    plain = keypoint_graph(leafy.regions, leafy.scene.cameras, keypoints).edges
    shuffled = order[keypoint_graph(leafy.regions.select(order), leafy.scene.cameras, keypoints).edges]
    assert set(map(tuple, shuffled.sort(1).values.tolist())) == set(map(tuple, plain.tolist()))
    assert len(plain) > 40


def test_photos_without_texture_match_nothing(tmp_path: Path) -> None:
    labels = np.zeros((48, 64), np.int64)
    labels[10:30, 10:30] = 1
    views = tuple(View(str(view), tmp_path / f"{view}.png") for view in range(3))
    for view in views:
        assert cv2.imwrite(str(view.path), np.full((48, 64, 3), 90, np.uint8))
    scene = Scene("grey", views, cameras_at(arc_positions(3), width=64, height=48))
    found = match_sparse(regions_from_label_maps([labels] * 3), scene)
    assert found.instance_ids.tolist() == [-1, -1, -1]
    assert found.num_instances == 0


def test_missing_photo_and_wrong_numbers_of_views_are_refused(leafy: LeafyScene, tmp_path: Path) -> None:
    cameras, views = leafy.scene.cameras, leafy.scene.views
    with pytest.raises(InputError, match="regions of 10 views with 9 cameras"):
        match_sparse(leafy.regions, Scene("short", views[:9], cameras[list(range(9))]))
    gone = Scene("gone", (View("000", tmp_path / "000.png"), *views[1:]), cameras)
    with pytest.raises(InputError, match=r"000\.png: the image of view 0 is missing"):
        match_sparse(leafy.regions, gone)
