"""A torchvision Mask R-CNN that sees all views of a scene at once (Sec. 3.2)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor
from torchvision.models.detection import MaskRCNN
from torchvision.models.detection.generalized_rcnn import GeneralizedRCNN

from mvseg.detection.config import DetectConfig
from mvseg.detection.find_leaves import Pass, find_leaves
from mvseg.detection.loop import match_proposals
from mvseg.detection.numbers import DETECTION
from mvseg.detection.proposals import gather_proposals
from mvseg.detectors.run import run_heads
from mvseg.errors import InputError, warn
from mvseg.masks import Masks
from mvseg.matching.config import MatchConfig
from mvseg.matching.match import find_disagreement
from mvseg.matching.result import Matching
from mvseg.scene import Cameras
from mvseg.verification.missing_parts import find_missing_parts
from mvseg.verification.snap_edges import snap_masks


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
    5. With `verify`, what is matched of the sure proposals (`sure_score`), and of many more (`more_score`), are
       candidates only, and the views choose leaves and masks from the whole excessive set (`verification.choose`).

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
        proposals_per_view: int = 300,
        match: MatchConfig = MatchConfig(),
        verify: bool = False,
    ) -> None:
        if not (isinstance(detector, GeneralizedRCNN) and detector.roi_heads.has_mask()):
            raise InputError(f"{type(detector).__name__} has no mask head, expected a torchvision Mask R-CNN")
        super().__init__(detector.backbone, detector.rpn, detector.roi_heads, detector.transform)
        self.num_iterations = num_iterations
        self.proposal_iou = proposal_iou
        self.cluster_iou = cluster_iou
        self.proposals_per_view = proposals_per_view
        self.match = match
        self.verify = verify
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
            _check_image(image, f"image {view}")
        sizes = [[image.shape[-1], image.shape[-2]] for image in images]
        _check_cameras(cameras, sizes)
        if self.verify:
            return _result_dicts(self.find_regions(images, cameras).masks, sizes=sizes, device=images[0].device)
        with torch.no_grad():
            detections = [self._propose(image) for image in images]
            matching = _disagreement_of(self.match_detections(detections, cameras))
            return self._collect(detections, sizes, masks=matching.masks)

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
            detections.append(self.detect(image))
            if self.verify:
                photos.append((255 * image.clamp(0, 1)).round().byte().permute(1, 2, 0).cpu().numpy())
            sizes.append([image.shape[-1], image.shape[-2]])
        _check_cameras(cameras, sizes)
        if not self.verify:
            return _disagreement_of(self.match_detections(detections, cameras))
        config = DetectConfig(min_score=max(DETECTION.sure_score, self.roi_heads.score_thresh))
        posed = cameras.to("cpu")
        detected = Pass(self.match_detections, detections, posed, config.min_score)
        leaves = find_leaves(detected, posed, config=config, photos=photos.__getitem__).leaves
        missing = find_missing_parts(leaves.masks, leaves.surfaces, photos.__getitem__, cameras=posed)
        return _disagreement_of(detected.sure).with_masks(snap_masks(leaves.masks, photos.__getitem__, missing=missing))

    @torch.no_grad()
    def detect(self, image: Tensor) -> dict[str, Tensor]:
        """The excessive set of one image (3, H, W) in [0, 1], on the CPU: what `match_detections` takes.

        Raises:
            InputError: an image of integers.
        """
        _check_image(image, "the image")
        return {key: value.cpu() for key, value in self._propose(image).items()}

    @torch.no_grad()
    def match_detections(
        self,
        detections: Sequence[dict[str, Tensor]],
        cameras: Cameras,
        *,
        min_score: float = 0.0,
        residual_px: int | None = None,
    ) -> Matching:
        """Second half of `find_regions`: match the output of `detect` for V images, of proposals that score `min_score`
        or more. `labels` of its regions are rows of the excessive set. `residual_px`: see `match_proposals`."""
        cameras = cameras.to(detections[0]["boxes"].device)
        with torch.autocast(cameras.K.device.type, enabled=False):  # pixel counts need single precision
            proposals, boxes = gather_proposals(detections, cameras.sizes.tolist())
            is_asked = (proposals.regions.areas > 0) & (proposals.detection_scores >= min_score)
            matching = match_proposals(
                proposals.select(is_asked),
                cameras,
                boxes=boxes[is_asked],
                num_iterations=self.num_iterations,
                cluster_iou=self.cluster_iou,
                detections_per_view=self.roi_heads.detections_per_img,
                match=self.match,
                residual_px=residual_px,
            )
        return matching.with_masks(matching.masks.select(matching.masks.view_index.argsort(stable=True)))

    def _propose(self, image: Tensor) -> dict[str, Tensor]:
        """One view's excessive set, as from `run_heads`, without masks that score too low once they are cut."""
        detections = run_heads(
            self,
            image,
            nms_thresh=self.proposal_iou,
            detections_per_img=self.proposals_per_view,
            num_growths=DETECTION.num_growths,
        )
        frame, is_good = detections.pop("frame"), detections["scores"] >= self.roi_heads.score_thresh
        return {key: value[is_good] for key, value in detections.items()} | {"frame": frame}

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


def _disagreement_of(matching: Matching) -> Matching:
    """Return the matching; warn (InputWarning) if the views disagree, see `find_disagreement`."""
    if (disagreement := find_disagreement(matching, is_detected=True)) is not None:
        warn(disagreement)
    return matching


def _result_dicts(masks: Masks, *, sizes: list[list[int]], device: torch.device) -> list[dict[str, Tensor]]:
    """torchvision's result dicts of matched masks, best score first."""
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


def _check_image(image: Tensor, name: str) -> None:
    if not isinstance(image, Tensor):
        raise InputError(f"{name} is a {type(image).__name__}, expected a Tensor: torch.from_numpy(image)")
    if image.ndim != 3 or len(image) != 3:
        raise InputError(f"{name} has shape {tuple(image.shape)}, expected (3, height, width), of red, green and blue")
    if not image.is_floating_point():
        kind = str(image.dtype).removeprefix("torch.")
        raise InputError(f"{name} is {kind}, expected floats in [0, 1]: image.float() / 255")
    if float(image.max()) > DETECTION.brightest:
        raise InputError(f"{name} has values up to {float(image.max()):g}, expected floats in [0, 1]: image / 255")


def _check_cameras(cameras: Cameras, sizes: list[list[int]]) -> None:
    if not isinstance(cameras, Cameras):
        raise InputError(f"cameras is a {type(cameras).__name__}, expected Cameras (of a scene: scene.cameras)")
    if len(sizes) < 2 or len(sizes) != len(cameras):
        raise InputError(f"{len(sizes)} images with {len(cameras)} cameras, expected one per image, two or more")
    for view, (size, expected) in enumerate(zip(sizes, cameras.sizes.tolist(), strict=True)):
        if size != expected:
            raise InputError(f"image {view} is {size[0]} x {size[1]}, its camera says {expected[0]} x {expected[1]}")
