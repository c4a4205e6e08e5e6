"""Scale and axes of the rendered room, of which everything is known: the board's squares are 40 mm, its markers 30."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mvseg.errors import InputError
from mvseg.formats.lens import photo_from_pinhole
from mvseg.poses import known_world
from mvseg.poses.alignment import fit_similarity
from mvseg.poses.config import WorldFacts
from mvseg.poses.known_world import place
from room_scene import BOARD, BOARD_AT
from warned import warns_of

NAMES = [f"{view}.png" for view in range(7)]


@pytest.fixture(autouse=True)
def known_markers(room, monkeypatch: pytest.MonkeyPatch) -> None:
    """To find them takes a second, of which one is enough."""
    monkeypatch.setattr(known_world, "find_scene_markers", lambda scene: room.markers)


def write_positions(path: Path, centers: np.ndarray, names=NAMES) -> Path:
    rows = [",".join([name, *map(str, xyz)]) for name, xyz in zip(names, centers, strict=False)]
    path.write_text("\n".join(["photo,x,y,z", *rows]) + "\n")
    return path


def true_scale(room) -> float:
    return fit_similarity(room.scene.cameras.centers.numpy(), room.truth.centers.numpy()).scale


def test_a_board_gives_scale_and_axes(room) -> None:
    placement = place(room.scene, WorldFacts(board=BOARD, unit="mm"))
    assert placement.similarity.scale == pytest.approx(true_scale(room), rel=0.01)
    centers = placement.similarity * room.scene.cameras.centers.numpy() + BOARD_AT
    assert np.abs(centers - room.truth.centers.numpy()).max() < 8  # mm at 600 mm: the photos are small
    assert (placement.up, placement.unit) == ((0.0, 0.0, 1.0), "mm")
    assert 10 <= int(placement.source.split()[0]) <= 12
    assert placement.residual < 0.5
    assert f"scale from {placement.source}, residual 0." in placement.describe()


def test_markers_and_distances_of_a_known_size_give_the_scale(room) -> None:
    placement = place(room.scene, WorldFacts(marker=BOARD.marker, unit="mm"))
    assert placement.similarity.scale == pytest.approx(true_scale(room), rel=0.01)
    assert int(placement.source.split()[0]) >= 8
    markers = place(room.scene, WorldFacts(distance=("marker:0", "marker:1", 2 * BOARD.square)))  # in one row
    assert markers.similarity.scale == pytest.approx(true_scale(room), rel=0.01)
    centers = room.truth.centers.numpy()
    apart = float(np.linalg.norm(centers[0] - centers[6]))
    photos = place(room.scene, WorldFacts(distance=("0.png", "6", apart)))
    assert photos.similarity.scale == pytest.approx(true_scale(room), rel=0.01)


def test_the_distance_of_two_spots_gives_the_scale(room) -> None:
    """Two spots, each clicked in photos with lens distortion: here the corners of a marker on the board."""
    seen = room.markers[BOARD.family]
    names = []
    for corner in (0, 2):
        places = []
        for view, px in seen[3, corner][:3]:
            lens, K = room.scene.views[view].lens, room.scene.cameras.K[view].numpy()
            x, y = px if lens is None else photo_from_pinhole(lens, K, px[None])[0]
            places.append(f"{view}.png:{x:.2f},{y:.2f}")
        names.append("+".join(places))
    placement = place(room.scene, WorldFacts(distance=(*names, BOARD.marker * 2**0.5), unit="mm"))
    assert placement.similarity.scale == pytest.approx(true_scale(room), rel=0.02)
    for wrong, message in [
        ("0.png:10,10", "0.png:10,10 is not one point, expected the same spot in two photos"),
        ("0.png:10,10+1.png:470,350", "is not one point"),
        ("0.png:10,1000+1.png:10,10", "0.png:10,1000 is outside of its 480 x 360 pixels"),
        ("0.png:10,10+9.png:10,10", "9.png is neither a registered photo nor a marker"),
    ]:
        with pytest.raises(InputError, match=message):
            place(room.scene, WorldFacts(distance=(wrong, names[0], 3.0)))


def test_positions_that_were_left_out_are_predicted(room, tmp_path: Path) -> None:
    centers = room.truth.centers.numpy()
    some = [0, 2, 3, 5, 6]
    path = write_positions(tmp_path / "log.csv", centers[some], [NAMES[view] for view in some])
    placement = place(room.scene, WorldFacts(positions=path, unit="mm"))
    found = placement.similarity * room.scene.cameras.centers.numpy()
    assert np.abs(found - centers)[[1, 4]].max() < 2  # mm
    assert placement.source.startswith("5 positions")
    assert placement.left_out == ()


def test_a_wrong_position_is_left_out_and_named(room, tmp_path: Path) -> None:
    centers = room.truth.centers.numpy().copy()
    centers[4] += 200
    placement = place(room.scene, WorldFacts(positions=write_positions(tmp_path / "log.csv", centers)))
    assert placement.left_out == ("4.png",)
    assert placement.similarity.scale == pytest.approx(true_scale(room), rel=0.01)


def test_positions_of_other_photos_are_warned_of(room, tmp_path: Path) -> None:
    path = write_positions(tmp_path / "log.csv", np.random.default_rng(1).normal(size=(7, 3)))
    with warns_of("positions_misfit"):
        place(room.scene, WorldFacts(positions=path))


def test_positions_on_a_line_give_the_scale_only(room, tmp_path: Path) -> None:
    line = np.outer(np.arange(7), [10.0, 0, 0])
    centers = room.scene.cameras.centers.new_tensor(line / 5)
    cameras = replace(room.scene.cameras, t=-(room.scene.cameras.R @ centers[:, :, None])[:, :, 0])
    path = write_positions(tmp_path / "log.csv", line)
    with warns_of("positions_on_a_line"):
        placement = place(replace(room.scene, cameras=cameras), WorldFacts(positions=path))
    assert placement.similarity.scale == pytest.approx(5)
    np.testing.assert_array_equal(placement.similarity.rotation.matrix(), np.eye(3))


def test_positions_on_a_line_must_fit_the_cameras(room, tmp_path: Path) -> None:
    """Degrees of latitude and longitude beside metres of height; and a rail with the names of other photos."""
    degrees = np.column_stack([np.linspace(8.65, 8.6501, 7), np.linspace(49.9, 49.9001, 7), np.linspace(119, 121, 7)])
    path = write_positions(tmp_path / "gps.csv", degrees)
    with pytest.raises(InputError, match="do not \\(x and y hardly vary: are they degrees, of latitude and longitude"):
        place(room.scene, WorldFacts(positions=path))
    line = np.outer(np.arange(7.0) ** 2, [10.0, 0, 0])
    centers = room.scene.cameras.centers.new_tensor(line[[3, 4, 5, 6, 0, 1, 2]])
    cameras = replace(room.scene.cameras, t=-(room.scene.cameras.R @ centers[:, :, None])[:, :, 0])
    with warns_of("positions_misfit", "positions_on_a_line"):
        place(replace(room.scene, cameras=cameras), WorldFacts(positions=write_positions(tmp_path / "rail.csv", line)))


def test_left_handed_positions_are_refused(room, tmp_path: Path) -> None:
    path = write_positions(tmp_path / "log.csv", room.truth.centers.numpy() * [1, -1, 1])
    with pytest.raises(InputError, match="points are mirrored"):
        place(room.scene, WorldFacts(positions=path))


@pytest.mark.parametrize(
    ("known", "message"),
    [
        ({"distance": ("0.png", "nowhere.png", 3.0)}, "nowhere.png is neither a registered photo"),
        ({"distance": ("marker:0", "marker:99", 3.0)}, "marker:99 is not seen whole in two photos, found marker:0"),
        ({"distance": ("marker:x", "marker:0", 3.0)}, "marker:x is not seen whole"),
        ({"distance": ("1.png", "1.png", 3.0)}, "are at one place"),
        ({"board": replace(BOARD, family="4X4_1000")}, r"0 corners of the board.*is it 5 x 4 of 4X4_1000"),
    ],
)
def test_what_is_not_in_the_photos_is_named(room, known, message: str) -> None:
    with pytest.raises(InputError, match=message):
        place(room.scene, WorldFacts(**known))


def test_positions_of_nothing(room, tmp_path: Path) -> None:
    path = write_positions(tmp_path / "log.csv", np.eye(3), ["a.png", "b.png", "c.png"])
    with pytest.raises(InputError, match=r"0 of its photos are registered \(a.png, b.png, c.png\)"):
        place(room.scene, WorldFacts(positions=path))
    placement = place(room.scene, WorldFacts())
    np.testing.assert_array_equal(placement.similarity.matrix(), np.eye(4)[:3])
    assert "arbitrary units" in placement.describe()
