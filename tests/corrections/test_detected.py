"""Edits of what a detector found, from the masks that a person sees to the leaves that the views choose after them."""

from __future__ import annotations

import io
import zipfile
import zlib
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from blade_scene import as_regions
from found_masks import FoundMasks, open_photos, see_masks
from mvseg.corrections.corrected import APPLIED
from mvseg.corrections.file import Confirm, Corrections, Edit, Link, Reject
from mvseg.findings.finding import Finding
from mvseg.masks import Masks, Origin
from mvseg.matching.result import Matching, MatchReport
from mvseg.pipeline.apply_edits import apply_edits
from mvseg.pipeline.before_edits import pack_plant, unpack_plant
from mvseg.pipeline.find_in_photos import find_in_photos
from mvseg.pipeline.plant import SOURCES, Plant
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.reconstruction.surface.surface_cache import Approach
from mvseg.scene import Cameras, Scene, View
from mvseg.verification import choose as choosing
from three_leaves import CAMERAS, LEAVES, true_maps

REGIONS, IDS = as_regions(true_maps())
WEAK = 3  # the leaf whose masks score too low to be matched at first
PROPOSALS = Masks.of(
    replace(REGIONS, labels=torch.arange(len(REGIONS))),
    detection_scores=torch.where(IDS == WEAK, 0.25, 0.8),
    origin=Origin.DETECTED,
)
MATCHED = replace(PROPOSALS, instance_ids=IDS, match_scores=torch.full((len(IDS),), 0.9))
VIEWS = tuple(View(f"v{view}", Path(f"v{view}.png")) for view in range(len(CAMERAS)))
SCENE = Scene(name="plant", views=VIEWS, cameras=CAMERAS, unit="mm", up=None)


# What a detector would have found: the sure masks are those of two leaves.
FOUND = FoundMasks(Matching(MATCHED.select(IDS != WEAK), MatchReport("nview")), PROPOSALS, more=MATCHED)


def fit(masks: Masks, _: Cameras, __: object, true: torch.Tensor = IDS) -> dict[int, LeafSurface]:
    ids = masks.instance_ids
    instances = ids[ids > 0].unique().tolist()
    return {each: LEAVES[int(true[masks.regions.labels[ids == each]].mode().values)] for each in instances}


def at(leaf: int, view: int) -> tuple[float, float]:
    """A point of a leaf in a photo."""
    row = int(((leaf == IDS) & (REGIONS.view_index == view)).nonzero()[0, 0])
    y, x = np.argwhere(REGIONS.crop(row).numpy())[0] + REGIONS.boxes[row, [1, 0]].numpy()
    return float(x) + 0.5, float(y) + 0.5


def run(*edits: Edit) -> Plant:
    plant = find_in_photos(open_photos(SCENE))
    return apply_edits(plant, Corrections(edits)) if edits else plant


@pytest.fixture(autouse=True)
def known_surfaces(monkeypatch: pytest.MonkeyPatch) -> None:
    see_masks(monkeypatch, FOUND)
    monkeypatch.setattr(choosing, "fit_roughly", fit)
    monkeypatch.setattr("mvseg.verification.picture.count_colors", lambda *_: pytest.fail("no photo is needed"))


def as_painted(state: Plant) -> list[np.ndarray]:
    """V maps of which leaf every pixel shows: the true number."""
    masks = state.masks
    leaves = IDS[masks.regions.labels] * (masks.instance_ids > 0)
    return [masks.regions.label_map(view, leaves, tuple(CAMERAS.sizes[view].tolist())).numpy() for view in range(6)]


def test_what_was_known_before_edits_comes_back_and_nothing_but_data_is_read(monkeypatch: Any) -> None:
    monkeypatch.setattr("mvseg.pipeline.before_edits.MOST_BYTES", most := 2**22)
    opened, reject = open_photos(SCENE), Corrections((Reject(view="v0", at=at(WEAK, 0), everywhere=True),))
    approach = Approach(LEAVES[1].views, LEAVES[1].coefficients, LEAVES[1].offsets_px, spread=0.5)
    opened.cache.update({"name": LEAVES[1], "one": approach, "other": None, "edge": REGIONS.crop(0)})
    content = pack_plant(find_in_photos(opened), ["odd"])
    assert content is not None
    found = unpack_plant(content, open_photos(SCENE))
    assert found is not None
    plant, said = found
    cache = plant.opened.cache
    assert torch.equal(cache["edge"], REGIONS.crop(0))
    assert torch.equal(cache["name"].covariance, LEAVES[1].covariance)
    again = cache["one"]
    assert again is not None
    assert again.spread == 0.5
    assert torch.equal(again.coefficients, approach.coefficients)
    assert cache["other"] is None
    before = run()
    assert said == ["odd"]
    assert plant.instances.probabilities == before.instances.probabilities
    assert plant.image_size == before.image_size  # the detector learns from there
    assert torch.equal(plant.boxes, before.boxes)
    assert [each.chance for each in plant.rejected] == [each.chance for each in before.rejected]
    for state, other in ((plant, before), (apply_edits(plant, reject), apply_edits(before, reject))):
        np.testing.assert_array_equal(as_painted(state), as_painted(other))
    fewer = open_photos(SCENE.select(torch.arange(5)))
    assert unpack_plant(content, fewer) is None
    code = io.BytesIO()
    torch.save({"views": opened.names, "plant": run}, code)
    bomb = zlib.compress(bytes(most + 1) + content)
    packed_twice = io.BytesIO()
    with zipfile.ZipFile(packed_twice, "w", zipfile.ZIP_DEFLATED) as inner, inner.open("archive/data.pkl", "w") as file:
        file.write(bytes(most + 1))
    bombs = bomb, zlib.compress(packed_twice.getvalue())
    for broken in (*bombs, b"", content[:-9], zlib.compress(b"text"), zlib.compress(code.getvalue())):
        assert unpack_plant(broken, opened) is None


def test_an_edit_is_about_the_mask_that_is_seen_whatever_it_scores() -> None:
    """Every mask of the weak leaf is shown, though none was matched at first; and it is gone as a whole."""
    before = run()
    assert set(np.unique(as_painted(before))) == {0, 1, 2, WEAK}
    state = run(Reject(view="v0", at=at(WEAK, 0), everywhere=True))
    assert [each.fate for each in state.edits] == [APPLIED]
    assert set(np.unique(as_painted(state))) == {0, 1, 2}
    for one, other in zip(as_painted(before), as_painted(state), strict=True):
        assert np.array_equal(np.where(one == WEAK, 0, one), other)


@pytest.mark.filterwarnings("ignore:correction 1")
def test_an_answer_that_changes_nothing_changes_nothing() -> None:
    before, after = run(), run(Reject(view="v0", at=(1.0, 1.0)))
    assert before.instances.probabilities == after.instances.probabilities
    assert torch.equal(before.masks.instance_ids, after.masks.instance_ids)
    assert torch.equal(before.masks.regions.crops, after.masks.regions.crops)


def test_edits_that_say_what_is_seen_match_nothing_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """The masks that they name are certain now; all else is as it was, also the numbers of the leaves."""
    before = run()
    monkeypatch.setattr("mvseg.pipeline.apply_edits.match_masks", lambda *_, **__: pytest.fail("matched anew"))
    same = Link(op="same", at=(("v1", *at(WEAK, 1)), ("v3", *at(WEAK, 3))))
    said = Confirm(view="v0", at=at(2, 0)), same
    after = run(*said)
    assert torch.equal(before.masks.regions.labels, after.masks.regions.labels)
    assert torch.equal(before.masks.instance_ids, after.masks.instance_ids)
    named = after.masks.is_linked | (after.masks.origin == Origin.CONFIRMED)
    assert int(named.sum()) == 3
    assert after.masks.match_scores[named].tolist() == [1, 1, 1]
    certain = {leaf for leaf, chance in after.instances.probabilities.items() if chance == 1}
    assert certain == set(after.masks.instance_ids[named].tolist())
    odd = replace(find_in_photos(open_photos(SCENE)), disagreement=Finding("detector_unsure", values={"share": 0.5}))
    assert apply_edits(odd, Corrections(said)).disagreement == odd.disagreement
    less, alone = (run(*more, Reject(view="v4", at=at(1, 4))) for more in (said, ()))
    assert less.instances.starts.keys() == alone.instances.starts.keys() == before.instances.starts.keys()
    assert torch.equal(less.masks.regions.labels, alone.masks.regions.labels)
    for view, (one, other) in enumerate(zip(as_painted(before), as_painted(less), strict=True)):
        np.testing.assert_array_equal(np.where((one == 1) & (view == 4), 0, one), other)


def test_sources_have_no_order_and_one_that_is_left_out_leaves_its_candidates_out(monkeypatch: Any) -> None:
    expected = run()
    monkeypatch.setattr("mvseg.pipeline.plant.SOURCES", dict(reversed(SOURCES.items())))
    assert run().keys == expected.keys
    assert torch.equal(run().masks.instance_ids, expected.masks.instance_ids)
    monkeypatch.setattr("mvseg.pipeline.plant.SOURCES", {"matched": SOURCES["matched"]})
    assert set(np.unique(as_painted(run()))) == {0, 1, 2}  # no sure mask shows the weak leaf


@pytest.mark.parametrize("leaf", [1, 2])
def test_two_masks_that_a_person_keeps_apart_never_have_one_id(monkeypatch: pytest.MonkeyPatch, leaf: int) -> None:
    """Although a candidate from before the edit holds both, and they are all that it has."""
    stays = (leaf != IDS) | torch.isin(REGIONS.view_index, torch.tensor([0, 3]))
    few = MATCHED.select(stays)
    ids, rows = IDS[stays], torch.arange(int(stays.sum()))
    few = replace(few, regions=replace(few.regions, labels=rows), proposal=rows)
    see_masks(monkeypatch, FoundMasks(Matching(few.select(ids != WEAK), MatchReport("nview")), few, more=few))
    monkeypatch.setattr(choosing, "fit_roughly", partial(fit, true=ids))
    together, apart = run(), run(Link(op="different", at=(("v0", *at(leaf, 0)), ("v3", *at(leaf, 3)))))
    assert [each.fate for each in apart.edits] == [APPLIED]
    for state, most in ((together, 2), (apart, 1)):
        of_leaf = state.masks.instance_ids[ids[state.masks.regions.labels] == leaf]
        counts = of_leaf[of_leaf > 0].bincount()
        assert int(counts.max() if len(counts) else 0) <= most
        assert state is apart or int(counts.max()) == 2
