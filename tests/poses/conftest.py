"""One run of structure from motion that the tests of this room share: it takes seconds."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from mvseg.formats import markers
from mvseg.formats.board import Family
from mvseg.formats.markers import Seen, find_scene_markers
from mvseg.formats.photos import Photos
from mvseg.poses.config import PoseConfig
from mvseg.poses.mapping import IMAGES, Structure, find_structure, write_structure
from mvseg.poses.photo_files import PhotoFile, copy_photos, list_photos
from mvseg.scene import Cameras, Scene
from room_scene import BOARD, room_cameras, write_room
from watched_stages import watch_stages


@dataclass(frozen=True)
class MappedRoom:
    """Photos of the room, their true cameras (mm, z up), and what structure from motion made of them by these steps."""

    folder: Path
    steps: tuple[str, ...]
    truth: Cameras
    files: list[PhotoFile]
    structure: Structure
    scene: Scene
    markers: dict[Family, Seen]


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> MappedRoom:
    folder = tmp_path_factory.mktemp("room")
    truth = room_cameras()
    source, names = list_photos(write_room(folder / "my photos", truth))
    files = copy_photos(source, names, folder / IMAGES)
    with pytest.MonkeyPatch.context() as patch:
        steps = watch_stages(patch)
        structure = find_structure(folder / IMAGES, files, config=PoseConfig(), work=folder)
        scene = write_structure(structure, folder)
        patch.setattr(markers, "FAMILIES", (BOARD.family,))  # to look for all of them takes seconds
        seen = find_scene_markers(Photos(scene))
    return MappedRoom(folder, tuple(steps), truth, files, structure, scene, seen)
