"""Cuts by expected IoU against trying every cut, and the expectation against drawn masks."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mvseg.detectors.mask_cut import CUT, decide_masks, expect_iou


def soft_masks(count: int, pixels: int = 40, seed: int = 0) -> torch.Tensor:
    """Probabilities from nearly empty to nearly full, no two alike."""
    generator = torch.Generator().manual_seed(seed)
    uniform = torch.rand((count, pixels), generator=generator, dtype=torch.float64)
    return uniform ** torch.linspace(0.3, 6, count)[:, None]


def best_cut(p: np.ndarray) -> tuple[set[int], float]:
    """The pixels inside at the best of all cuts, and the expected IoU: the definition, one cut after another."""
    found = []
    for cut in p:
        inside = p >= cut
        found.append((p[inside].sum() / (inside.sum() + p[~inside].sum()), inside))
    value, inside = max(found, key=lambda one: one[0])
    return set(np.nonzero(inside)[0].tolist()), float(value)


def test_equals_trying_every_cut() -> None:
    masks = soft_masks(30)
    cuts, expected = expect_iou(masks)
    for p, cut, value in zip(masks.numpy(), cuts.tolist(), expected.tolist(), strict=True):
        inside, best = best_cut(p)
        assert set(np.nonzero(p > cut)[0].tolist()) == inside
        assert value == pytest.approx(best, abs=1e-12)
    assert (cuts < 0.55).all()  # half the Dice score of the expectations, up to the gap between two pixels


def test_expectation_is_the_mean_iou_of_drawn_masks() -> None:
    """The ratio of expectations stands for the expectation of the ratio: within 0.01 for 400 pixels."""
    masks = soft_masks(4, 400)
    cuts, expected = expect_iou(masks)
    drawn = torch.rand((2000, *masks.shape), generator=torch.Generator().manual_seed(1), dtype=torch.float64) < masks
    inside = masks > cuts[:, None]
    iou = (drawn & inside).sum(2) / (drawn | inside).sum(2)
    torch.testing.assert_close(iou.double().mean(0), expected, atol=0.01, rtol=0)


def test_sure_masks_stay_as_they_are() -> None:
    sure = (soft_masks(5) > 0.4).double()
    cuts, expected = expect_iou(sure)
    assert torch.equal(sure > cuts[:, None], sure > CUT)
    torch.testing.assert_close(expected, torch.ones(5, dtype=torch.float64))


def test_order_of_pixels_and_of_masks_does_not_matter() -> None:
    masks, generator = soft_masks(12), torch.Generator().manual_seed(2)
    pixels, order = torch.randperm(masks.shape[1], generator=generator), torch.randperm(12, generator=generator)
    cuts, expected = expect_iou(masks)
    shuffled = expect_iou(masks[order][:, pixels])
    torch.testing.assert_close(shuffled, (cuts[order], expected[order]))


def test_thin_mask_that_never_reaches_a_half_is_kept() -> None:
    probabilities = torch.full((1, 1, 8, 8), 0.02)
    probabilities[..., 3, :] = 0.45
    found = {"masks": probabilities, "scores": torch.tensor([0.9]), "labels": torch.tensor([1])}
    decided = decide_masks(found)
    assert (decided["masks"] > CUT)[0, 0].nonzero()[:, 0].tolist() == [3] * 8
    expected = 8 * 0.45 / (8 + 56 * 0.02)
    assert decided["scores"].item() == pytest.approx(0.9 * expected, abs=1e-6)
    assert decided["labels"] is found["labels"]
    assert torch.equal(found["masks"], probabilities)  # the input is left alone


def test_deciding_twice_moves_no_pixel() -> None:
    """The masks of a decision are cut at 0.5 whatever is done with them: larger stays larger, 0 and 1 stay."""
    masks = soft_masks(6, 64).reshape(6, 1, 8, 8).float()
    cuts, _ = expect_iou(masks.flatten(1))
    decided = decide_masks({"masks": masks, "scores": torch.ones(6)})["masks"]
    assert torch.equal(decided > CUT, masks > cuts[:, None, None, None])
    assert torch.equal(decided.flatten(1).argsort(1), masks.flatten(1).argsort(1))
    extremes = decide_masks({"masks": torch.tensor([[[[0.0, 1.0]]]]), "scores": torch.ones(1)})["masks"]
    torch.testing.assert_close(extremes, torch.tensor([[[[0.0, 1.0]]]]), atol=1e-4, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32])
def test_no_detections_and_empty_masks(dtype: torch.dtype) -> None:
    nothing = decide_masks({"masks": torch.zeros((0, 1, 28, 28), dtype=dtype), "scores": torch.zeros(0)})
    assert nothing["masks"].shape == (0, 1, 28, 28)
    empty = decide_masks({"masks": torch.zeros((2, 1, 4, 4), dtype=dtype), "scores": torch.ones(2)})
    assert empty["scores"].tolist() == [0, 0]
    assert not (empty["masks"] > CUT).any()
    assert not empty["masks"].isnan().any()
    assert empty["masks"].dtype == dtype
