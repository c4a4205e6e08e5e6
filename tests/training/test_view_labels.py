"""Labels from what the views chose: which masks are learned, which pixels are neither leaf nor background."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from mvseg.crop import Crop
from mvseg.masks import Masks, Origin
from mvseg.regions import stack_regions
from mvseg.training.view_labels import ViewLabels, are_labels, label_views

SIZE, GREEN = 60, (30, 160, 40)


def squares(lefts: list[int], views: list[int], *, top: int = 10) -> Masks:
    """Squares of 10 px."""
    crops = [Crop((left, top, left + 10, top + 10), torch.ones(10, 10, dtype=torch.bool)) for left in lefts]
    return Masks.of(stack_regions([(view, crop, 0) for view, crop in zip(views, crops, strict=True)], 2))


def chosen(ids: list[int], scores: list[float], origins: list[Origin]) -> Masks:
    """A square for each in view 0."""
    masks = squares([10 * each for each in range(len(ids))], [0] * len(ids))
    columns = dict(instance_ids=torch.tensor(ids), match_scores=torch.tensor(scores), origin=torch.tensor(origins))
    return replace(masks, **columns)


@pytest.mark.parametrize(
    ("instance", "q", "chance", "origin", "expected"),
    [
        (1, 0.5, 0.5, Origin.DETECTED, True),
        (1, 0.49, 0.9, Origin.DETECTED, False),
        (1, 0.9, 0.49, Origin.DETECTED, False),
        (1, 0.9, None, Origin.GIVEN, True),  # nobody asked whether it is a leaf
        (-1, 0.9, None, Origin.DETECTED, False),
        (1, 0.9, 0.9, Origin.OTHER_VIEWS, False),
        (-1, 0.0, None, Origin.CORRECTED, True),
        (1, 0.1, 0.1, Origin.CONFIRMED, True),
    ],
)
def test_what_a_label_is(instance: int, q: float, chance: float | None, origin: Origin, expected: bool) -> None:
    masks = chosen([instance], [q], [origin])
    assert are_labels(masks, {} if chance is None else {1: chance}).tolist() == [expected]


@pytest.fixture
def photo() -> np.ndarray:
    """Leaves in columns 0 to 19, and one that nobody found in columns 30 to 39, on grey."""
    photo = np.full((SIZE, SIZE, 3), 120, np.uint8)
    photo[10:20, :20] = photo[10:20, 30:40] = GREEN
    return photo


@pytest.fixture
def labels(photo: np.ndarray) -> ViewLabels:
    """Of two leaves, in view 0 one that is sure and one that is not; another proposal on grey."""
    masks = chosen([1, 2], [0.9, 0.9], [Origin.DETECTED] * 2)
    return label_views(masks, squares([45], [0]), lambda _: photo, probabilities={1: 0.9, 2: 0.3})


def test_doubtful_masks_and_leaf_colours_are_ignored_and_labels_are_not(labels: ViewLabels, photo: np.ndarray) -> None:
    whole = labels.in_photo(0, photo, (0, 0, SIZE, SIZE), size=(SIZE, SIZE))
    assert torch.equal(whole.photo, torch.from_numpy(photo).permute(2, 0, 1))
    assert whole.classes.tolist() == [1]
    assert whole.layers[0, 15].nonzero()[:, 0].tolist() == list(range(10))
    assert whole.ignore[15].nonzero()[:, 0].tolist() == [*range(10, 20), *range(30, 40), *range(45, 55)]
    assert not whole.ignore[:10].any()
    other = labels.in_photo(1, photo, (0, 0, SIZE, SIZE), size=(SIZE, SIZE))
    assert len(other.classes) == 0
    assert other.ignore[15].nonzero()[:, 0].tolist() == [*range(20), *range(30, 40)]


def test_a_part_of_the_photo_at_another_size(labels: ViewLabels, photo: np.ndarray) -> None:
    part = labels.in_photo(0, photo, (4, 10, 24, 30), size=(10, 10))
    assert part.photo.shape == (3, 10, 10)
    assert part.layers[0, 2].nonzero()[:, 0].tolist() == [0, 1, 2]  # columns 4 to 9
    assert part.ignore[2, 3:8].all()
    assert not part.ignore[6:].any()
    assert len(labels.in_photo(0, photo, (20, 0, 60, 60), size=(60, 40)).classes) == 0


def test_few_leaves_are_too_few(photo: np.ndarray) -> None:
    nothing = squares([], [])

    def count(ids: list[int], origins: list[Origin]) -> tuple[int, bool]:
        labels = label_views(chosen(ids, [0.9] * len(ids), origins), nothing, lambda _: photo, probabilities={})
        return labels.num_leaves, labels.are_enough

    assert count([], []) == (0, False)
    assert count([1, 1, 2], [Origin.DETECTED] * 3) == (2, False)
    assert count([1, 2, -1], [Origin.DETECTED, Origin.DETECTED, Origin.CORRECTED]) == (3, True)
