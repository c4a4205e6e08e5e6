"""The executable paper: the slow twin of every fast path, written as the paper says it, with lines drawn by OpenCV."""

from __future__ import annotations

from itertools import combinations, pairwise

import cv2
import numpy as np
import torch
from torch import Tensor
from torchvision.ops import box_iou

from mvseg.matching.links import Links
from mvseg.reconstruction.surface.mask_stack import MaskStack
from mvseg.regions import Regions
from mvseg.scene import Cameras


def fundamental_reference(cameras: Cameras, i: int, j: int) -> np.ndarray:
    """F_ji with x_j^T F_ji x_i = 0, from the relative pose."""
    j_from_i = cameras.R[j] @ cameras.R[i].T
    shift = (cameras.t[j] - j_from_i @ cameras.t[i]).tolist()
    cross = np.array([[0, -shift[2], shift[1]], [shift[2], 0, -shift[0]], [-shift[1], shift[0], 0]])
    K_i, K_j = cameras.K[i].numpy(), cameras.K[j].numpy()
    return np.linalg.inv(K_j).T @ cross @ j_from_i.numpy() @ np.linalg.inv(K_i)


def draw_line_reference(line: np.ndarray, width: int, height: int) -> np.ndarray:
    """(height, width) bool: one epipolar line a u + b v + c = 0, drawn two pixels thick over the whole image."""
    a, b, c = line
    canvas = np.zeros((height, width), np.uint8)
    if abs(b) > abs(a):
        ends = [(u, -(c + a * u) / b) for u in (0.0, float(width))]
    else:
        ends = [(-(c + b * v) / a, v) for v in (0.0, float(height))]
    if max(abs(x) for end in ends for x in end) > 1e6:  # the line passes far outside the image
        return canvas > 0
    first, second = [(round((u - 0.5) * 256), round((v - 0.5) * 256)) for u, v in ends]
    cv2.line(canvas, first, second, 1, thickness=2, shift=8)
    return canvas > 0


def draw_points_reference(regions: Regions, index: int, num_points: int, generator: np.random.Generator) -> np.ndarray:
    """(num_points, 2) random pixel centres of one region."""
    pixels = regions.crop(index).nonzero().numpy()[:, ::-1] + 0.5 + regions.boxes[index, :2].numpy()
    return pixels[generator.integers(len(pixels), size=num_points)]


def affinity_reference(
    regions: Regions, cameras: Cameras, num_points: int = 200, seed: int = 0, senders: list[int] | None = None
) -> Tensor:
    """(D, D) directed weights of Eq. 3: w[n, m] from the band of n to the region m; 0 within a view.

    Every line is drawn two pixels thick, and counted against the full-frame mask of every region.
    """
    generator = np.random.default_rng(seed)
    sizes = cameras.sizes.tolist()
    masks = [regions.mask(m, *sizes[int(regions.view_index[m])]).numpy() for m in range(len(regions))]
    weights = torch.zeros(len(regions), len(regions))
    for n in range(len(regions)) if senders is None else senders:
        i = int(regions.view_index[n])
        points = draw_points_reference(regions, n, num_points, generator)
        homogeneous = np.concatenate([points, np.ones((num_points, 1))], 1)
        for j in range(len(cameras)):
            if j == i:
                continue
            targets = [m for m in range(len(regions)) if int(regions.view_index[m]) == j]
            band = np.zeros(sizes[j][::-1], bool)
            passing = dict.fromkeys(targets, 0)
            for line in homogeneous @ fundamental_reference(cameras, i, j).T:
                drawn = draw_line_reference(line, *sizes[j])
                band |= drawn
                for m in targets:
                    passing[m] += int(drawn[masks[m]].any())
            for m in targets:
                weights[n, m] = (band & masks[m]).sum() / masks[m].sum() * passing[m] / num_points
    return weights


def epipolar_map_reference(members: Regions, cameras: Cameras, view: int) -> np.ndarray:
    """(H, W) Eq. 4: the mean of the bands of the members in other views, from all of their pixels."""
    width, height = cameras.sizes[view].tolist()
    total, count = np.zeros((height, width)), 0
    for n in range(len(members)):
        i = int(members.view_index[n])
        if i == view:
            continue
        pixels = members.crop(n).nonzero().numpy()[:, ::-1] + 0.5 + members.boxes[n, :2].numpy()
        band = np.zeros((height, width), bool)
        for line in np.concatenate([pixels, np.ones((len(pixels), 1))], 1) @ fundamental_reference(cameras, i, view).T:
            band |= draw_line_reference(line, width, height)
        total += band
        count += 1
    return total / max(count, 1)


def ruzicka_reference(first: np.ndarray, second: np.ndarray) -> float:
    """Eq. 5 of two maps."""
    return float(np.minimum(first, second).sum() / max(np.maximum(first, second).sum(), 1e-12))


def factorise_reference(W: np.ndarray, H: np.ndarray, num_iterations: int) -> np.ndarray:
    """SymNMF from a start H (D, k): the multiplicative update, element by element."""
    for _ in range(num_iterations):
        above, below = W @ H, H @ (H.T @ H)
        H = np.array(
            [
                [H[n, c] * (0.5 + 0.5 * above[n, c] / max(below[n, c], 1e-12)) for c in range(H.shape[1])]
                for n in range(H.shape[0])
            ]
        )
    return H


def link_average_reference(W: np.ndarray, views: np.ndarray, stop: float, links: Links | None = None) -> np.ndarray:
    """(D,) average linkage that never joins two regions of one view, nor what links keep apart: nodes of a few regions,
    and the mean weights between them, computed afresh at each step."""
    node = (links or Links.of()).components(len(W))
    clusters = [np.flatnonzero(node == n).tolist() for n in range(node.max() + 1)]
    apart = set() if links is None else {frozenset((int(node[a]), int(node[b]))) for a, b in links.cannot.tolist()}
    while True:
        options = [
            (float(W[np.ix_(a, b)].mean()), a, b)
            for a, b in combinations(clusters, 2)
            if not set(views[a]) & set(views[b])
            and not any(frozenset((int(node[n]), int(node[m]))) in apart for n in a for m in b)
        ]
        best = max(options, key=lambda option: option[0], default=(0.0, [], []))
        if best[0] < stop or best[0] <= 0:
            break
        clusters = [c for c in clusters if c is not best[1] and c is not best[2]] + [best[1] + best[2]]
    ids = np.empty(len(W), np.int64)
    for index, cluster in enumerate(clusters):
        ids[cluster] = index
    return ids


def cluster_aware_nms_reference(boxes: Tensor, scores: Tensor, groups: Tensor, iou_threshold: float) -> list[int]:
    """Greedy suppression, one pair at a time; pairs of different groups are left alone."""
    kept: list[int] = []
    for candidate in scores.argsort(descending=True, stable=True).tolist():
        for winner in kept:
            if (groups[winner] != groups[candidate]).any():
                continue
            x1, y1 = torch.maximum(boxes[winner, :2], boxes[candidate, :2]).tolist()
            x2, y2 = torch.minimum(boxes[winner, 2:], boxes[candidate, 2:]).tolist()
            common = max(0.0, x2 - x1) * max(0.0, y2 - y1)
            areas = [float((box[2] - box[0]) * (box[3] - box[1])) for box in (boxes[winner], boxes[candidate])]
            if common / (sum(areas) - common) > iou_threshold:
                break
        else:
            kept.append(candidate)
    return kept


def backed_by_views_reference(
    boxes: Tensor, groups: Tensor, ids: Tensor, scores: Tensor, iou_threshold: float, min_score: float
) -> list[bool]:
    """Best box first; one is discarded when a box that stays overlaps it, unless it is surely another instance."""
    stays: list[int] = []
    for box in range(len(boxes)):
        rivals = [rival for rival in stays if (groups[rival] == groups[box]).all()]
        overlapping = [rival for rival in rivals if float(box_iou(boxes[[rival]], boxes[[box]])) > iou_threshold]
        is_sure = ids[box] > 0 and scores[box] >= min_score
        if all(is_sure and ids[rival] != ids[box] for rival in overlapping):
            stays.append(box)
    return [box in stays for box in range(len(boxes))]


def back_project_reference(members: Regions, cameras: Cameras, points: Tensor) -> Tensor:
    """(P,) Eq. 6 at world points: share of the views in which some mask of the instance contains the point."""
    pixels, depth = cameras.project(points)
    votes = torch.zeros(len(points))
    views = members.view_index.unique().tolist()
    for view in views:
        width, height = cameras.sizes[view].tolist()
        seen = torch.zeros(len(points), dtype=torch.bool)
        for n in (members.view_index == view).nonzero()[:, 0].tolist():
            mask = members.mask(n, width, height)
            for p, (u, v) in enumerate(pixels[view].tolist()):
                if depth[view, p] > 0 and 0 <= u < width and 0 <= v < height:
                    seen[p] |= mask[int(v), int(u)]
        votes += seen
    return votes / len(views)


def seen_share_reference(members: Regions, everything: Regions, cameras: Cameras, points: Tensor) -> Tensor:
    """(P,) of the instance's views that show it at a point or show no region there, the share that show it."""
    pixels, depth = cameras.project(points)
    shown, empty = torch.zeros(len(points)), torch.zeros(len(points))
    for view in members.view_index.unique().tolist():
        width, height = cameras.sizes[view].tolist()
        masks = [
            torch.stack([r.mask(n, width, height) for n in (r.view_index == view).nonzero()[:, 0].tolist()]).any(0)
            for r in (members, everything)
        ]
        for p, (u, v) in enumerate(pixels[view].tolist()):
            if depth[view, p] > 0 and 0 <= u < width and 0 <= v < height:
                shown[p] += masks[0][int(v), int(u)]
                empty[p] += ~masks[1][int(v), int(u)]
    return shown / (shown + empty)


def leaf_metrics_reference(
    masks: list[tuple[int, np.ndarray]], ids: list[int], truth: list[np.ndarray]
) -> dict[str, float]:
    """Precision and recall of masks, pair F1 over all true masks and MV-PQ, from sets of pixels.

    `masks` are (view, (H, W) bool); -1 = no id; in `truth`, 0 = nothing, 65535 = ignore.
    """

    def pixels(view: int, mask: np.ndarray) -> set[tuple[int, int, int]]:
        return {(view, int(row), int(column)) for row, column in zip(*mask.nonzero(), strict=True)}

    def judge(found: dict, true: dict) -> tuple[dict, list]:
        """Estimated segment -> (true segment, IoU), and the estimated segments that are false."""
        right = {}
        for name, segment in true.items():
            plain = {key: part - ignored for key, part in found.items()}
            iou = {key: len(part & segment) / len(part | segment) for key, part in plain.items()}
            best = max(iou, key=lambda key: iou[key], default=None)
            if best is not None and iou[best] > 0.5:
                right[best] = (name, iou[best])
        mostly_ignored = [key for key, part in found.items() if len(part & ignored) > len(part) / 2]
        return right, [key for key in found if key not in right and key not in mostly_ignored]

    def divide(part: float, whole: float) -> float:
        return part / whole if whole else 1.0

    ignored = set().union(*(pixels(view, labels == 65535) for view, labels in enumerate(truth)))
    true_masks = {
        (view, label): pixels(view, labels == label)
        for view, labels in enumerate(truth)
        for label in set(labels.ravel().tolist()) - {0, 65535}
    }
    leaves: dict[int, set] = {}
    for (_, label), segment in true_masks.items():
        leaves[label] = leaves.get(label, set()) | segment
    mask_pixels = {index: pixels(*mask) for index, mask in enumerate(masks)}
    names = [number if number >= 0 else -1 - index for index, number in enumerate(ids)]
    instances: dict[int, set] = {}
    for index, name in enumerate(names):
        instances[name] = instances.get(name, set()) | mask_pixels[index]
    right, false = judge(mask_pixels, true_masks)
    whole, wrong = judge(instances, leaves)
    pairs = [pair for pair in combinations([*right, *false], 2) if names[pair[0]] == names[pair[1]]]
    agreeing = [(n, m) for n, m in pairs if n in right and m in right and right[n][0][1] == right[m][0][1]]
    true_pairs = [pair for pair in combinations(true_masks, 2) if pair[0][1] == pair[1][1]]
    return {
        "mask_precision": divide(len(right), len(right) + len(false)),
        "mask_recall": divide(len(right), len(true_masks)),
        "all_pair_precision": divide(len(agreeing), len(pairs)),
        "all_pair_recall": divide(len(agreeing), len(true_pairs)),
        "all_pair_f1": divide(2 * len(agreeing), len(pairs) + len(true_pairs)),
        "mv_pq": divide(
            sum(iou for _, iou in whole.values()), len(whole) + len(wrong) / 2 + (len(leaves) - len(whole)) / 2
        ),
        "num_right": len(whole),
        "num_false": len(wrong),
        "num_missed": len(leaves) - len(whole),
    }


def nearest_edge_reference(masks: MaskStack, view: int, px: np.ndarray, *, normal: np.ndarray, reach: float) -> float:
    """How far along a normal the nearest edge from inside to outside is, step by step; NaN for none in reach."""
    num_steps = 2 * int(np.ceil(reach))
    steps = [reach * (2 * number / num_steps - 1) for number in range(num_steps + 1)]
    value = [masks.interpolate(masks.blurred, np.array([view]), (px + at * normal)[None, None]).item() for at in steps]
    nearest = np.nan
    for (here, low), (after, high) in pairwise(zip(value, steps, strict=True)):
        if here >= 0.5 > after:
            place = low + (high - low) * (here - 0.5) / (here - after)
            nearest = place if np.isnan(nearest) or abs(place) < abs(nearest) else nearest
    return nearest


def soft_affinity_reference(
    rows: list[list[int]], ray_of_row: list[int], region_of_ray: list[int], *, num_regions: int, sharpness: list[float]
) -> np.ndarray:
    """(D, D) affinity by expectation maximisation, row by row and pair by pair; -1 = no region there, -2 = outside."""
    rays = range(len(region_of_ray))
    on_ray = [[row for row, ray in zip(rows, ray_of_row, strict=True) if ray == number] for number in rays]
    weights = [[{m: 1.0 for row in on_ray[ray] for m in row if m >= 0}] for ray in rays]  # at first, all that is shown
    affinity = np.zeros((num_regions, num_regions))
    for beta in [None, *sharpness]:
        if beta is not None:
            for ray in rays:
                scores = [_row_score(affinity, row, region_of_ray[ray]) for row in on_ray[ray]]
                beliefs = np.exp(beta * (np.array(scores) - max(scores, default=0)))
                beliefs /= max(beliefs.sum(), 1e-12)
                weights[ray] = [
                    {m: belief for m in row if m >= 0} for row, belief in zip(on_ray[ray], beliefs, strict=True)
                ]
        mass = np.zeros((num_regions, num_regions))
        for ray in rays:
            for of_row in weights[ray]:
                for m, weight in of_row.items():
                    mass[region_of_ray[ray], m] += weight
        mass /= np.maximum(np.bincount(region_of_ray, minlength=num_regions), 1)[:, None]
        affinity = (mass + mass.T) / 2
    return affinity


def _row_score(affinity: np.ndarray, row: list[int], own: int) -> float:
    """Mean affinity between all regions of a row and the ray's own, less 0.7 for the share of views without one."""
    inside = [label for label in row if label >= -1]
    named = [own, *(label for label in inside if label >= 0)]
    pairs = sum(affinity[first, second] for first, second in combinations(named, 2))
    return 2 * pairs / (len(inside) * (len(inside) + 1)) - 0.7 * inside.count(-1) / len(inside)


def spread_pixels_reference(mask: np.ndarray, most: int) -> np.ndarray:
    """(n, 2) at most `most` pixel centres of a mask, evenly spread over its pixels in reading order."""
    pixels = np.argwhere(mask)[:, ::-1] + 0.5
    taken = min(len(pixels), most)
    return pixels[[((2 * rank + 1) * len(pixels)) // (2 * taken) for rank in range(taken)]]


def thinned_pixels_reference(mask: np.ndarray, most: int) -> np.ndarray:
    """(n, 2) the pixel centres of a mask on a square lattice from the image's corner on; all if none is on it."""
    pixels = np.argwhere(mask)[:, ::-1]
    step = max(1, int(np.ceil(np.sqrt(len(pixels) / most))))
    on_lattice = pixels[(pixels % step == 0).all(1)]
    return (on_lattice if len(on_lattice) else pixels) + 0.5
