"""How sure focal lengths are: of a rendered room whose camera is known."""

from __future__ import annotations

import pytest

from mvseg.poses.focal_length import FocalLength, focal_lengths, least_sure
from room_scene import FOCAL


@pytest.mark.slow
def test_the_focal_length_of_a_room_is_as_sure_as_it_says(room) -> None:
    (found,) = focal_lengths(room.structure.model, is_given=False)
    assert found.deviation is not None
    assert abs(found.px - FOCAL) < 3 * found.deviation
    assert found.deviation < 0.01 * FOCAL
    assert focal_lengths(room.structure.model, is_given=True) == [FocalLength(found.px, None)]


def test_what_is_not_sure_is_said() -> None:
    sure, unsure, given = FocalLength(800.0, 8.0), FocalLength(700.0, 7.1), FocalLength(900.0, None)
    code = "focal_length_unsure"
    assert sure.doubts(code) == given.doubts(code) == []
    assert str(unsure.doubts(code)[0]).startswith("focal length 700 +- 7.1 px (1.0%): ")
    assert least_sure([sure, unsure, given]) == unsure
