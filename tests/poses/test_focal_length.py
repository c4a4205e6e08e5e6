"""How sure focal lengths are: of a rendered room whose camera is known."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from mvseg.poses.cancellable import quiet_colmap
from mvseg.poses.focal_length import FocalLength, _with_own_lenses, find_zooms, focal_lengths, least_sure, zoom_finding
from room_scene import FOCAL


@pytest.mark.slow
def test_the_focal_length_of_a_room_is_as_sure_as_it_says(room) -> None:
    (found,) = focal_lengths(room.structure.model, is_given=False)
    assert found.deviation is not None
    assert abs(found.px - FOCAL) < 3 * found.deviation
    assert found.deviation < 0.01 * FOCAL
    assert focal_lengths(room.structure.model, is_given=True) == [FocalLength(found.px, None)]


def seen_by_one_lens(*, zoom: float) -> pycolmap.Reconstruction:
    """Eight photos of a cloud of points, every other one zoomed in, as an adjustment with one lens leaves them."""
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=8)
    options.num_points3D, options.camera_model_id = 150, pycolmap.CameraModelId.SIMPLE_RADIAL
    options.camera_params = [900.0, 512.0, 384.0, 0.0]
    pycolmap.set_random_seed(1)
    model = pycolmap.synthesize_dataset(options)
    rng = np.random.default_rng(0)
    for number, image in model.images.items():
        for point in image.points2D:
            shown = point.xy + rng.normal(0, 0.3, 2)
            point.xy = (512, 384) + (shown - (512, 384)) * (zoom if number % 2 else 1.0)
    with quiet_colmap():
        pycolmap.bundle_adjustment(model, pycolmap.BundleAdjustmentOptions(print_summary=False))
    model.update_point_3d_errors()
    return model


def test_two_zooms_that_are_to_share_a_lens_are_said() -> None:
    lengths = find_zooms(seen_by_one_lens(zoom=1.3))
    assert lengths is not None
    assert lengths[::2].mean() / lengths[1::2].mean() == pytest.approx(1.3, rel=0.02)
    finding = zoom_finding(lengths, 1000.0)
    assert (finding.code, finding.values["low"], finding.values["high"]) == ("zooms", lengths.min(), lengths.max())
    one = seen_by_one_lens(zoom=1.0)
    assert find_zooms(one) is None
    assert find_zooms(_with_own_lenses(one)) is None  # they have


def test_what_is_not_sure_is_said() -> None:
    sure, unsure, given = FocalLength(800.0, 8.0), FocalLength(700.0, 7.1), FocalLength(900.0, None)
    code = "focal_length_unsure"
    assert sure.doubts(code) == given.doubts(code) == []
    assert str(unsure.doubts(code)[0]).startswith("focal length 700 +- 7.1 px (1.0%): ")
    assert least_sure([sure, unsure, given]) == unsure
