"""A torchvision Mask R-CNN that sees all views of a scene at once (Sec. 3.2)."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor
from torchvision.models.detection import MaskRCNN
from torchvision.models.detection.generalized_rcnn import GeneralizedRCNN

from mvseg.config import RunConfig
from mvseg.detection.config import DetectConfig
from mvseg.detection.numbers import DETECTION
from mvseg.detection.proposals import Proposer, check_image
from mvseg.detectors.folded_norms import fold_norms
from mvseg.errors import InputError, warn
from mvseg.formats.photos import Photos
from mvseg.masks import Masks
from mvseg.matching.config import MatchConfig
from mvseg.matching.match import find_disagreement
from mvseg.matching.result import Matching
from mvseg.pipeline.find_in_photos import find_in_photos
from mvseg.pipeline.finish import complete_masks
from mvseg.pipeline.open_scene import Opened
from mvseg.scene import Cameras, Scene, View


class MultiViewMaskRCNN(GeneralizedRCNN):  # type: ignore[misc]  # torchvision carries no types
    """Wraps any torchvision Mask R-CNN: same modules, same state dict, and ids across views when given the cameras.

    In train mode, and in eval mode without cameras, it is the detector it wraps. With cameras, in eval mode:

    1. Each view's proposals pass the box and mask heads and NMS with a large threshold (`proposal_iou`, the paper:
       0.7): an excessive set of masks. Each mask is cut where its expected IoU is largest, and its score multiplied by
       that (`detectors/mask_cut.py`); what then scores less than the detector's `roi_heads.score_thresh` is
       discarded. Boxes whose masks touch their sides grow, and are masked again (`grow_boxes`).
    2. Match first: what plain NMS at `cluster_iou` keeps of it is matched across views. Objects of different
       classes are never matched.
    3. Alternate `num_iterations` times: every mask of the excessive set takes the id of the instance whose epipolar map
       it resembles most (Eq. 5); NMS with a small threshold (`cluster_iou`, 0.3) inside each instance; match the
       survivors again. Masks that resemble no map form one more group.
    4. Where match scores are probabilities (unless `match` selects "one-per-view" or "symnmf"): a box that overlaps a
       better one stays only if the other views show it to be another instance (`backed_by_views`); match what is left.
    5. With `verify`, the same stages follow as in `mvseg infer` (`find_in_photos`): the detector looks at several
       sizes, and again at the parts that show the plant; the views choose leaves and masks from everything that it
       proposes. The leaves are those of `mvseg infer --learn off`.

    Departures from the paper: the paper matches the excessive set itself at first, and estimates |k| anew each time;
    here, where `match` selects "symnmf", |k| is that of the first match. The duplicates in the other sets inflate the
    number of masks per view, from which the search range of |k| follows; that splits leaves, and the pieces then
    shelter duplicates from NMS. The other methods of matching need no |k|.

    Args:
        detector: a torchvision Mask R-CNN (any builder, any backbone, or `MaskRCNN` itself). Its modules are shared,
            not copied.
        num_iterations: rounds of assignment and NMS; 0 only matches what plain NMS keeps.
        proposal_iou: NMS threshold of the excessive set.
        cluster_iou: NMS threshold inside a cluster, and of the set that is matched first.
        proposals_per_view: size of the excessive set; the best scores are kept.
        match: how regions are matched; a given number of instances applies to each class.
        verify: let the views choose from the excessive set (step 5).

    Raises:
        InputError: the detector has no mask head.
    """

    def __init__(
        self,
        detector: MaskRCNN,
        *,
        num_iterations: int = 1,
        proposal_iou: float = 0.7,
        cluster_iou: float = 0.3,
        proposals_per_view: int = DETECTION.most_proposals,
        match: MatchConfig = MatchConfig(),
        verify: bool = False,
    ) -> None:
        if not (isinstance(detector, GeneralizedRCNN) and detector.roi_heads.has_mask()):
            raise InputError(f"{type(detector).__name__} has no mask head, expected a torchvision Mask R-CNN")
        super().__init__(detector.backbone, detector.rpn, detector.roi_heads, detector.transform)
        self.verify = verify
        self.proposer = Proposer(
            self,
            num_iterations=num_iterations,
            proposal_iou=proposal_iou,
            cluster_iou=cluster_iou,
            proposals_per_view=proposals_per_view,
            match=match,
        )
        self.train(detector.training)

    def forward(
        self,
        images: list[Tensor],
        targets: list[dict[str, Tensor]] | None = None,
        *,
        cameras: Cameras | None = None,
    ) -> dict[str, Tensor] | list[dict[str, Tensor]]:
        """Detect, and match across views.

        Args:
            images: V tensors (3, H, W) in [0, 1], all of one scene when cameras are given; sizes may differ.
            targets: in train mode, as torchvision's detectors take them.
            cameras: the V undistorted cameras of the images; ignored in train mode.

        Returns:
            In train mode the detector's losses. In eval mode V dicts with `boxes`, `labels`, `scores`, `masks`
            (probabilities, to be cut at 0.5); with cameras also `instance_ids` (int64, the same number for the same
            instance in every view, -1 = matched to nothing) and `match_scores` (float32 in [0, 1], see `Matching`).
            With `verify`, masks are 0 or 1, and match scores say how likely each mask shows its instance.

        Raises:
            InputError: fewer than two images, not one camera per image, an image of another size than its camera, or
                one of integers; in train mode, a label that is none of the detector's classes.
        """
        if self.training or cameras is None:
            if targets is not None and hasattr(self.roi_heads.box_predictor, "cls_score"):  # torchvision's own head
                _check_labels(targets, int(self.roi_heads.box_predictor.cls_score.out_features) - 1)
            return super().forward(images, targets)
        for view, image in enumerate(images):
            check_image(image, f"image {view}")
        sizes = [[image.shape[-1], image.shape[-2]] for image in images]
        _check_cameras(cameras, sizes)
        if self.verify:
            return _result_dicts(self.find_regions(images, cameras).masks, sizes=sizes, device=images[0].device)
        detections = [self.proposer.propose(image) for image in images]
        return self._collect(detections, sizes, masks=self._match(detections, cameras).masks)

    def find_regions(self, images: Iterable[Tensor], cameras: Cameras) -> Matching:
        """As `forward` with cameras in eval mode, for large scenes: one image in memory at a time (with
        `verify`, the others as bytes), masks as crops.

        Args:
            images: V tensors (3, H, W) in [0, 1] on the detector's device, e.g. from a generator.

        Returns:
            The D detections that are kept, matched, on the CPU, ordered by view and by falling score (with `verify`:
            by view and instance).

        Raises:
            InputError: as `forward`.
        """
        detections, sizes, photos = [], [], []
        for image in images:
            if self.verify:
                check_image(image, "an image")
                photos.append((255 * image.clamp(0, 1)).round().byte().permute(1, 2, 0).cpu().numpy())
            else:
                detections.append({key: value.cpu() for key, value in self.proposer.propose(image).items()})
            sizes.append([image.shape[-1], image.shape[-2]])
        _check_cameras(cameras, sizes)
        if not self.verify:
            return self._match(detections, cameras)
        least = max(DETECTION.sure_score, self.roi_heads.score_thresh)
        config = RunConfig(detect=DetectConfig(min_score=least), match=self.proposer.match)
        views = tuple(View(f"image {view}", Path(f"image {view}")) for view in range(len(sizes)))
        scene = Scene(name="images", views=views, cameras=cameras.to("cpu"), unit="", up=None)
        proposer = replace(self.proposer, detector=fold_norms(copy.deepcopy(self)))
        opened = Opened(scene, Photos(scene, dict(enumerate(photos))), config, proposer=proposer)
        plant = complete_masks(find_in_photos(opened))
        if plant.disagreement is not None:
            warn(plant.disagreement)
        return plant.matching

    def _match(self, detections: list[dict[str, Tensor]], cameras: Cameras) -> Matching:
        matching = self.proposer.match_detections(detections, cameras)
        if (disagreement := find_disagreement(matching, is_detected=True)) is not None:
            warn(disagreement)
        return matching

    @torch.no_grad()
    def _collect(
        self, detections: list[dict[str, Tensor]], sizes: list[list[int]], *, masks: Masks
    ) -> list[dict[str, Tensor]]:
        results, start = [], 0
        for view, (proposals, (width, height)) in enumerate(zip(detections, sizes, strict=True)):
            here = masks.select(masks.view_index == view)
            places = here.regions.labels - start
            kept = {key: proposals[key][places] for key in ("boxes", "labels", "scores", "masks")}
            frame_width, frame_height = proposals["frame"].tolist()
            (result,) = self.transform.postprocess([kept], [(frame_height, frame_width)], [(height, width)])
            results.append(result | {"instance_ids": here.instance_ids, "match_scores": here.match_scores})
            start += len(proposals["boxes"])
        return results


def _result_dicts(masks: Masks, *, sizes: list[list[int]], device: torch.device) -> list[dict[str, Tensor]]:
    results = []
    for view, (width, height) in enumerate(sizes):
        in_view = masks.select(masks.view_index == view)
        in_view = in_view.select(in_view.detection_scores.argsort(descending=True, stable=True))
        frames = [in_view.regions.mask(index, width, height) for index in range(len(in_view))]
        empty = torch.zeros((0, height, width))
        result = {
            "boxes": in_view.regions.boxes.float(),
            "labels": in_view.classes,
            "scores": in_view.detection_scores,
            "masks": (torch.stack(frames).float() if frames else empty)[:, None],
            "instance_ids": in_view.instance_ids,
            "match_scores": in_view.match_scores,
        }
        results.append({key: value.to(device) for key, value in result.items()})
    return results


def _check_labels(targets: Sequence[dict[str, Tensor]], most: int) -> None:
    for view, target in enumerate(targets):
        labels = target["labels"]
        if len(labels) and not 1 <= int(labels.min()) <= int(labels.max()) <= most:
            found = f"{int(labels.min())} to {int(labels.max())}"
            raise InputError(f"target {view} has labels from {found}, expected 1 to {most}, the detector's classes")


def _check_cameras(cameras: Cameras, sizes: list[list[int]]) -> None:
    if not isinstance(cameras, Cameras):
        raise InputError(f"cameras is a {type(cameras).__name__}, expected Cameras (of a scene: scene.cameras)")
    if len(sizes) < 2 or len(sizes) != len(cameras):
        raise InputError(f"{len(sizes)} images with {len(cameras)} cameras, expected one per image, two or more")
    for view, (size, expected) in enumerate(zip(sizes, cameras.sizes.tolist(), strict=True)):
        if size != expected:
            raise InputError(f"image {view} is {size[0]} x {size[1]}, its camera says {expected[0]} x {expected[1]}")
