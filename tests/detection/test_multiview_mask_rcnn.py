from __future__ import annotations

from dataclasses import replace
from functools import cache

import pytest
import torch
from torchvision.models.detection import MaskRCNN, fasterrcnn_mobilenet_v3_large_320_fpn
from torchvision.models.detection.roi_heads import paste_masks_in_image
from torchvision.ops import box_iou

from mvseg.demo import demo_scene
from mvseg.detection.loop import match_proposals
from mvseg.detection.nms import cluster_aware_nms
from mvseg.detection.proposals import gather_proposals
from mvseg.detectors.mask_cut import decide_masks
from mvseg.detectors.zoo import load_detector
from mvseg.errors import InputError
from mvseg.formats.photos import load_photos
from mvseg.formats.scene_folder import load_scene
from mvseg.masks import Masks
from mvseg.matching.match import find_disagreement
from mvseg.matching.result import Matching
from mvseg.pipeline.find_in_photos import find_in_photos
from mvseg.pipeline.finish import complete_masks
from mvseg.pipeline.mask_rcnn import MultiViewMaskRCNN
from mvseg.pipeline.open_scene import open_scene
from mvseg.regions import regions_from_label_maps
from mvseg.scene import Cameras
from simulated_proposals import simulate_proposals
from synthetic import BallScene, arc_positions, ball_scene, cameras_at
from tiny_training import build_tiny

# what an untrained detector finds in noise does not agree across views
pytestmark = pytest.mark.filterwarnings("ignore::mvseg.errors.InputWarning")


def tiny_detector() -> MaskRCNN:
    """It answers in milliseconds, and calls almost everything an object."""
    detector = build_tiny(3).eval()
    detector.transform.min_size, detector.transform.max_size = (96,), 128
    detector.roi_heads.detections_per_img = 12
    return detector


def some_images(count: int = 3, width: int = 160, height: int = 120) -> list[torch.Tensor]:
    return list(torch.rand(count, 3, height, width, generator=torch.Generator().manual_seed(1)))


def small_cameras(count: int = 3):
    return cameras_at(arc_positions(count), focal=200.0, width=160, height=120)


def test_without_cameras_it_is_the_detector_it_wraps() -> None:
    detector = tiny_detector()
    wrapped = MultiViewMaskRCNN(detector)
    assert list(wrapped.state_dict()) == list(detector.state_dict())
    images = some_images()
    with torch.no_grad():
        expected, results = detector(images), wrapped(images)
    assert len(expected[0]["boxes"]) > 0
    for plain, ours in zip(expected, results, strict=True):
        assert plain.keys() == ours.keys()
        assert all(torch.equal(plain[key], ours[key]) for key in plain)
    MultiViewMaskRCNN(tiny_detector()).load_state_dict(detector.state_dict())


def test_a_label_beyond_the_classes_is_refused() -> None:
    mask = torch.zeros(1, 120, 160, dtype=torch.uint8)
    mask[:, 20:60, 20:60] = 1
    box = torch.tensor([[20.0, 20, 60, 60]])
    targets = [{"boxes": box, "labels": torch.tensor([label]), "masks": mask} for label in (2, 7)]
    with pytest.raises(InputError, match="target 1 has labels from 7 to 7, expected 1 to 2"):
        MultiViewMaskRCNN(tiny_detector()).train()(some_images(2), targets)


def test_losses_in_train_mode_are_untouched_even_with_cameras() -> None:
    detector = tiny_detector().train()
    wrapped = MultiViewMaskRCNN(detector)
    assert wrapped.training
    images = some_images(2)
    target = {
        "boxes": torch.tensor([[20.0, 20, 90, 80]]),
        "labels": torch.tensor([1]),
        "masks": torch.ones(1, 120, 160, dtype=torch.uint8),
    }
    losses = []
    for model, arguments in ((detector, {}), (wrapped, {}), (wrapped, {"cameras": small_cameras(2)})):
        torch.manual_seed(5)
        losses.append(model(images, [target, target], **arguments))
    assert losses[0].keys() == losses[1].keys() == losses[2].keys()
    assert all(losses[0][key] == losses[1][key] == losses[2][key] for key in losses[0])
    sum(losses[2].values()).backward()
    assert detector.backbone[0].weight.grad.abs().sum() > 0


def test_with_cameras_the_usual_dicts_and_ids() -> None:
    wrapped = MultiViewMaskRCNN(tiny_detector())
    results = wrapped(some_images(), cameras=small_cameras())
    assert len(results) == 3
    for result in results:
        count = len(result["boxes"])
        assert result["masks"].shape == (count, 1, 120, 160)
        assert result["instance_ids"].dtype == torch.int64
        assert result["match_scores"].dtype == torch.float32
        assert {len(value) for value in result.values()} == {count}
        assert count <= 20
        assert (result["scores"].diff() <= 0).all()
        assert not result["boxes"].requires_grad
    assert max(int(result["instance_ids"].max()) for result in results) >= 1
    classes: dict[int, set[int]] = {}
    for result in results:
        for instance, label in zip(result["instance_ids"].tolist(), result["labels"].tolist(), strict=True):
            classes.setdefault(instance, set()).add(label)
    assert all(len(labels) == 1 for instance, labels in classes.items() if instance > 0)


def test_masks_are_cut_and_low_scores_discarded(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    def watch(raw: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        seen.append(raw)
        return decide_masks(raw)

    monkeypatch.setattr("mvseg.detectors.run.decide_masks", watch)
    detector = tiny_detector()
    detector.roi_heads.score_thresh = 0.16
    masks = MultiViewMaskRCNN(detector, num_iterations=0).find_regions(some_images(), small_cameras()).masks
    decided = [decide_masks(raw)["scores"] for raw in seen]
    assert sum(int((scores < 0.16).sum()) for scores in decided) > 0
    allowed = torch.cat([scores[scores >= 0.16] for scores in decided])
    assert len(masks) > 0
    assert torch.isin(masks.detection_scores, allowed).all()


def test_boxes_that_the_other_views_do_not_confirm_are_discarded(monkeypatch: pytest.MonkeyPatch) -> None:
    wrapped, images, cameras = MultiViewMaskRCNN(tiny_detector()), some_images(2), small_cameras(2)

    def refuse_first(boxes: torch.Tensor, *others: torch.Tensor, **options: object) -> torch.Tensor:
        return torch.arange(len(boxes)) > 0

    monkeypatch.setattr("mvseg.detection.loop.backed_by_views", refuse_first)
    after = wrapped.find_regions(images, cameras)
    monkeypatch.setattr("mvseg.detection.loop.backed_by_views", lambda boxes, *_, **__: torch.ones(len(boxes)) > 0)
    assert len(after) == len(wrapped.find_regions(images, cameras)) - 1


def test_boxes_of_the_excessive_set_overlap_no_more_than_its_threshold() -> None:
    overlaps = []
    for iou in (0.1, 0.7):
        wrapped = MultiViewMaskRCNN(tiny_detector(), proposal_iou=iou, cluster_iou=1.0, num_iterations=0)
        results = wrapped(some_images(), cameras=small_cameras())
        overlaps.append(0.0)
        for result in results:
            is_rival = (result["labels"][:, None] == result["labels"]).fill_diagonal_(False)
            overlaps.append(max(overlaps.pop(), float((box_iou(result["boxes"], result["boxes"]) * is_rival).max())))
    assert overlaps[0] <= 0.1 + 1e-6 < 0.5 < overlaps[1] <= 0.7 + 1e-6


def test_wrong_arguments_are_named() -> None:
    wrapped = MultiViewMaskRCNN(tiny_detector())
    with pytest.raises(InputError, match="2 images with 3 cameras"):
        wrapped(some_images(2), cameras=small_cameras(3))
    with pytest.raises(InputError, match="image 0 is 150 x 120, its camera says 160 x 120"):
        wrapped(some_images(3, width=150), cameras=small_cameras(3))
    integers = [(255 * image).to(torch.uint8) for image in some_images(3)]
    with pytest.raises(InputError, match=r"image 0 is uint8, expected floats in \[0, 1\]: image.float\(\) / 255"):
        wrapped(integers, cameras=small_cameras(3))
    with pytest.raises(InputError, match="the image is uint8"):
        wrapped.proposer.propose(integers[0])
    with pytest.raises(InputError, match="expected one per image, two or more"):
        wrapped(some_images(1), cameras=small_cameras(2)[:1])
    with pytest.raises(InputError, match=r"expected Cameras \(of a scene"):
        wrapped(some_images(3), cameras="cameras.json")
    boxes_only = fasterrcnn_mobilenet_v3_large_320_fpn(weights=None, weights_backbone=None)
    with pytest.raises(InputError, match="no mask head"):
        MultiViewMaskRCNN(boxes_only)


def test_crops_hold_exactly_what_torchvision_pastes() -> None:
    generator = torch.Generator().manual_seed(0)
    corner = torch.rand(12, 2, generator=generator) * 60 - 3
    boxes = torch.cat((corner, corner + 5 + 40 * torch.rand(12, 2, generator=generator)), 1)
    boxes = boxes.clamp(min=torch.zeros(4), max=torch.tensor([80.0, 60, 80, 60]))
    masks = torch.rand(12, 1, 28, 28, generator=generator)
    detections = {"boxes": boxes, "masks": masks, "scores": torch.rand(12), "labels": torch.ones(12, dtype=torch.int64)}
    proposals, placed = gather_proposals([detections | {"frame": torch.tensor([80, 60])}], [[160, 120]])
    torch.testing.assert_close(placed, boxes * 2)
    pasted = paste_masks_in_image(masks, placed, (120, 160))[:, 0] > 0.5
    for number in range(12):
        assert torch.equal(proposals.regions.mask(number, 160, 120), pasted[number])


@cache
def crowded_scene() -> tuple[BallScene, Masks, torch.Tensor]:
    scene = ball_scene(14, 6, seed=3, radius=0.5, spread=1.3)
    proposals, labels = simulate_proposals(scene.label_maps, seed=0)
    excess = plain_nms(proposals, 0.7)
    chosen = proposals.select(excess)
    return scene, replace(chosen, regions=replace(chosen.regions, labels=torch.arange(len(excess)))), labels[excess]


@cache
def crowded_matching() -> Matching:
    scene, proposals, _ = crowded_scene()
    return match_proposals(proposals, scene.cameras, num_iterations=1)


def plain_nms(proposals: Masks, iou: float) -> torch.Tensor:
    boxes, scores = proposals.regions.boxes.float(), proposals.detection_scores
    return cluster_aware_nms(boxes, scores, proposals.view_index, iou)


def places(proposals: Masks, matching: Matching) -> torch.Tensor:
    """(S,) int64, which of the proposals were kept."""
    assert torch.equal(proposals.detection_scores[matching.masks.regions.labels], matching.masks.detection_scores)
    return matching.masks.regions.labels


def test_cluster_aware_nms_finds_more_than_plain_nms_does() -> None:
    """Balls count as found when a kept proposal was made from them; crowded ones share half of their box."""
    scene, proposals, labels = crowded_scene()
    truth = regions_from_label_maps(scene.label_maps)
    overlap = box_iou(truth.boxes.float(), truth.boxes.float()).fill_diagonal_(0)
    overlap[truth.view_index[:, None] != truth.view_index] = 0
    crowded = [
        (view, label)
        for view, label, most in zip(
            truth.view_index.tolist(), truth.labels.tolist(), overlap.max(1).values.tolist(), strict=True
        )
        if most > 0.4
    ]
    assert len(crowded) >= 6

    def recall(keep: torch.Tensor) -> float:
        kept = set(zip(proposals.regions.view_index[keep].tolist(), labels[keep].tolist(), strict=True))
        return sum(pair in kept for pair in crowded) / len(crowded)

    plain = plain_nms(proposals, 0.3)
    matching = crowded_matching()
    keep = places(proposals, matching)
    assert recall(keep) > recall(plain)
    assert len(keep) < 1.35 * len(truth)
    assert len(matching.instance_ids) == len(keep)


def test_iterating_is_deterministic_and_zero_iterations_only_match() -> None:
    scene, proposals, _ = crowded_scene()
    first, second = crowded_matching(), match_proposals(proposals, scene.cameras)  # one iteration is the default
    assert torch.equal(first.masks.regions.labels, second.masks.regions.labels)
    assert torch.equal(first.instance_ids, second.instance_ids)
    keep = places(proposals, match_proposals(proposals, scene.cameras, num_iterations=0))
    assert torch.equal(keep, plain_nms(proposals, 0.3))


def test_what_stays_says_that_views_disagree_and_no_earlier_matching_warns() -> None:
    scene = ball_scene(6, 5, seed=7)
    proposals, _ = simulate_proposals(scene.label_maps, seed=0)
    order = [2, 0, 4, 1, 3]
    cameras = Cameras(K=scene.cameras.K, R=scene.cameras.R[order], t=scene.cameras.t[order], sizes=scene.cameras.sizes)
    matching = match_proposals(proposals, cameras, num_iterations=2)
    names = ["a", "b", "c", "d", "e"]
    disagreement = find_disagreement(matching, names, is_detected=True)
    assert disagreement is not None
    assert disagreement.code == "detector_unsure"


def test_classes_are_matched_apart_and_their_matchings_joined() -> None:
    """True masks of balls, the even ones of another class."""
    scene = ball_scene(6, 8, seed=3)
    regions = scene.regions
    classes = torch.where(regions.labels % 2 == 1, 1, 2)
    order = torch.randperm(len(regions), generator=torch.Generator().manual_seed(0))
    proposals = Masks.of(regions, detection_scores=torch.rand(len(regions)), classes=classes).select(order)
    matching = match_proposals(proposals, scene.cameras, num_iterations=0, cluster_iou=0.99)
    assert matching.support is not None
    assert len(matching.support) == matching.num_instances == 6
    assert matching.report.residual_px == 1
    for instance in range(1, 7):
        assert len(matching.masks.classes[matching.instance_ids == instance].unique()) == 1


def test_detections_per_view_are_limited() -> None:
    scene, proposals, _ = crowded_scene()
    kept = match_proposals(proposals, scene.cameras, num_iterations=1, detections_per_view=5).masks
    assert kept.regions.num_per_view.max() == 5


@pytest.mark.slow
def test_both_doors_find_the_same_leaves() -> None:
    expected = complete_masks(find_in_photos(open_scene(demo_scene()))).masks
    scene, wrapped = load_scene(demo_scene()), MultiViewMaskRCNN(load_detector("leaf-lite"), verify=True)
    masks = wrapped.find_regions(load_photos(scene), scene.cameras).masks
    for name in ("view_index", "instance_ids", "match_scores"):
        assert torch.equal(getattr(masks, name), getattr(expected, name))
    assert torch.equal(masks.regions.crops, expected.regions.crops)
    assert wrapped.state_dict().keys() == load_detector("leaf-lite").state_dict().keys()


def test_regions_are_those_of_forward_in_order_and_without_empty_masks() -> None:
    wrapped, images, cameras = MultiViewMaskRCNN(tiny_detector(), proposals_per_view=15), some_images(), small_cameras()
    masks = wrapped.find_regions(iter(images), cameras).masks
    results = wrapped(images, cameras=cameras)
    views = masks.view_index
    assert torch.equal(views, views.sort().values)
    assert (masks.regions.areas > 0).all()
    for view, result in enumerate(results):
        here = views == view
        assert torch.equal(masks.detection_scores[here], result["scores"])
        assert torch.equal(masks.instance_ids[here], result["instance_ids"])
        assert torch.equal(masks.match_scores[here], result["match_scores"])
        assert (result["scores"].diff() <= 0).all()
        for number, mask in zip(here.nonzero()[:, 0].tolist(), result["masks"][:, 0], strict=True):
            assert torch.equal(masks.regions.mask(number, 160, 120), mask > 0.5)
    with pytest.raises(InputError, match="2 images with 3 cameras"):
        wrapped.find_regions(iter(images[:2]), cameras)
