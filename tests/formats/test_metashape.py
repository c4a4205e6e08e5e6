"""Metashape's XML: pixels by the equations of its manual, written out here on their own."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mvseg.errors import InputError
from mvseg.formats.lens import photo_from_pinhole
from mvseg.formats.metashape import read_metashape
from mvseg.formats.scene_folder import load_scene
from scene_folders import HEIGHT, WIDTH, arc_pose, write_image
from warned import warns_of

CALIBRATION = {"f": 150.0, "cx": 1.25, "cy": -2.5, "b1": 3.0}
CALIBRATION |= {"k1": -0.1, "k2": 0.02, "k3": 0.003, "p1": 0.001, "p2": 0.004}
WORLD_R, WORLD_T, SCALE = Rotation.from_euler("xyz", [0.3, -0.2, 1.1]).as_matrix(), np.array([4.0, 5, 6]), 0.02
POINTS = np.random.default_rng(1).uniform(-8, 8, (10, 3))  # of the chunk

# The form of Metashape 2.0's export, cut to what tells cameras; <reference> and <covariance> stand for the rest.
DOCUMENT = """<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0">
  <chunk label="Chunk 1" enabled="true">
    <sensors next_id="1">
      <sensor id="0" label="ILCE-7M3, 50mm" type="frame">
        <resolution width="128" height="96"/>
        <property name="pixel_width" value="0.006"/>
        <bands><band label="Red"/></bands>
        <data_type>uint8</data_type>
        <calibration type="frame" class="initial"><resolution width="128" height="96"/><f>99</f></calibration>
        <calibration type="frame" class="adjusted"><resolution width="128" height="96"/>{calibration}</calibration>
        <covariance><params>f cx cy</params><coeffs>1 0 0 0 1 0 0 0 1</coeffs></covariance>
      </sensor>
    </sensors>
    <components next_id="1" active_id="0"><component id="0" label="Component 1">{transform}</component></components>
    <cameras next_id="5" next_group_id="1"><group id="0" label="round" type="folder">
{cameras}      <camera id="9" sensor_id="0" label="IMG_9"><orientation>1</orientation></camera>
    </group></cameras>
    <reference>LOCAL_CS</reference>
  </chunk>
</document>
"""
TRANSFORM = "<transform><rotation>{}</rotation><translation>{}</translation><scale>{}</scale></transform>"


def text(numbers: np.ndarray) -> str:
    return " ".join(repr(float(number)) for number in numbers.ravel())


def write(folder: Path, *, translation: np.ndarray = WORLD_T, replace: tuple[str, str] = ("", "")) -> Path:
    cameras = ""
    for view in range(4):
        R, t = arc_pose(view, 4)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = R.T, -R.T @ t
        cameras += f'      <camera id="{view}" sensor_id="0" component_id="0" label="IMG_{view}">'
        cameras += f"<transform>{text(pose)}</transform></camera>\n"
    calibration = "".join(f"<{name}>{value!r}</{name}>" for name, value in CALIBRATION.items())
    transform = TRANSFORM.format(text(WORLD_R), text(translation), SCALE)
    content = DOCUMENT.format(calibration=calibration, transform=transform, cameras=cameras)
    assert replace[0] in content
    (folder / "cameras.xml").write_text(content.replace(*replace) if replace[0] else content)
    return folder / "cameras.xml"


def manual_px(points: np.ndarray) -> np.ndarray:
    """Points of the camera to pixels."""
    c = {"k4": 0.0, "b2": 0.0} | CALIBRATION
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r2 = x * x + y * y
    radial = 1 + c["k1"] * r2 + c["k2"] * r2**2 + c["k3"] * r2**3 + c["k4"] * r2**4
    x_bent = x * radial + c["p1"] * (r2 + 2 * x * x) + 2 * c["p2"] * x * y
    y_bent = y * radial + c["p2"] * (r2 + 2 * y * y) + 2 * c["p1"] * x * y
    u = WIDTH * 0.5 + c["cx"] + x_bent * c["f"] + x_bent * c["b1"] + y_bent * c["b2"]
    return np.stack((u, HEIGHT * 0.5 + c["cy"] + y_bent * c["f"]), 1)


def test_pixels_are_those_of_the_manual(tmp_path: Path) -> None:
    for view in range(4):
        write_image(tmp_path / "images" / f"IMG_{view}.JPG", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    write(tmp_path)
    with warns_of("cameras_not_aligned"):
        scene = load_scene(tmp_path)
    assert [view.path.name for view in scene.views] == [f"IMG_{view}.JPG" for view in range(4)]
    assert [view.name for view in scene.views] == [f"IMG_{view}" for view in range(4)]
    assert (scene.unit, scene.source) == ("m", tmp_path / "cameras.xml")
    world = SCALE * POINTS @ WORLD_R.T + WORLD_T
    px, depth = scene.cameras.project(torch.from_numpy(world))
    for view in range(4):
        R, t = arc_pose(view, 4)
        found = photo_from_pinhole(scene.views[view].lens, scene.cameras.K[view].numpy(), px[view].numpy())
        np.testing.assert_allclose(found, manual_px(POINTS @ R.T + t), atol=1e-7)
        np.testing.assert_allclose(depth[view], SCALE * (POINTS @ R.T + t)[:, 2], atol=1e-9)


@pytest.mark.filterwarnings("ignore:.*not aligned:mvseg.errors.InputWarning")
def test_worlds(tmp_path: Path) -> None:
    whole = TRANSFORM.format(text(WORLD_R), text(WORLD_T), SCALE)
    scene = read_metashape(write(tmp_path, replace=(whole, "")))
    assert scene.unit == ""
    np.testing.assert_allclose(scene.cameras.t[2], arc_pose(2, 4)[1], atol=1e-9)
    with warns_of("geocentric"):
        scene = read_metashape(write(tmp_path, translation=np.array([0.0, 0, 6.37e6])))
    assert float(scene.cameras.centers.abs().max()) < 60 * SCALE + 1e-9
    with_component = read_metashape(write(tmp_path)).cameras
    content = (tmp_path / "cameras.xml").read_text()  # before components, the chunk itself had the transform
    content = re.sub("<components.*</components>", whole, content).replace(' component_id="0"', "")
    (tmp_path / "cameras.xml").write_text(content)
    assert torch.equal(read_metashape(tmp_path / "cameras.xml").cameras.t, with_component.t)


@pytest.mark.filterwarnings("ignore:.*not aligned:mvseg.errors.InputWarning")
def test_a_slave_of_a_rig_stands_where_its_master_and_its_offset_say(tmp_path: Path) -> None:
    (R_master, t_master), (R, t) = arc_pose(0, 4), arc_pose(1, 4)
    rotation, location = R_master @ R.T, R_master @ (R_master.T @ t_master - R.T @ t)  # master_from_slave
    offset = f"<rotation>{text(rotation)}</rotation><location>{text(location)}</location>"
    whole = TRANSFORM.format(text(WORLD_R), text(WORLD_T), SCALE)
    path = write(tmp_path)
    expected = read_metashape(write(tmp_path, replace=(whole, ""))).cameras
    content = path.read_text()
    slave = content[content.index('<sensor id="0"') : content.index("</sensor>")] + "</sensor>"
    slave = slave.replace('id="0"', 'id="1" master_id="0"').replace("<property", f"{offset}<property")
    content = content.replace("</sensors>", f"{slave}</sensors>")
    camera = r'<camera id="1" sensor_id="1" master_id="0"\1/>'
    content = re.sub(r'<camera id="1" sensor_id="0"([^>]*)>.*', camera, content)
    path.write_text(content)
    found = read_metashape(path).cameras
    np.testing.assert_allclose(found.R, expected.R, atol=1e-9)
    np.testing.assert_allclose(found.t, expected.t, atol=1e-6)
    path.write_text(content.replace('label="Component 1"></component>', f'label="Component 1">{whole}</component>'))
    with warns_of("slaves_left_out"):
        assert [view.name for view in read_metashape(path).views] == ["IMG_0", "IMG_2", "IMG_3"]


BAD = [
    (("<f>150.0</f>", "<f>zero</f>"), "camera IMG_0: 'zero' is not 1 finite numbers"),
    (("<f>150.0</f>", "<f>150.0</f><k4>0.1</k4>"), "camera IMG_0: its sensor has k4 = 0.1, expected 0"),
    (("<f>150.0</f>", "<f>150.0</f><b2>0.1</b2>"), r"camera IMG_0: K has skew together"),
    (('type="frame">\n', 'type="fisheye">\n'), "camera IMG_0: its sensor is of the type fisheye, expected frame"),
    (('sensor_id="0"', 'sensor_id="7"'), "camera IMG_0: its sensor is not in the file"),
    (("<scale>0.02</scale>", "<scale>-1</scale>"), "the scale of the chunk is -1, expected a positive number"),
    (("</chunk>", "</chunk><chunk/>"), "holds 2 chunks, expected the cameras of one chunk"),
    (('id="0" sensor_id="0" component_id="0"', 'id="0" sensor_id="0" component_id="1"'), "the cameras belong to 2"),
    (("<document", "<!DOCTYPE a [<!ENTITY b 'c'>]><document"), "declares a document type, which Metashape does not"),
    (("</document>", ""), "not a whole XML file"),
    (("IMG_1", "IMG_0"), "views 0 and 1 have the same name 'IMG_0'"),
    (('label="IMG_0"', 'label="../../IMG_0"'), "view 0 .*: the file name leads out of the scene folder"),
]


@pytest.mark.filterwarnings("ignore:.*not aligned:mvseg.errors.InputWarning")
@pytest.mark.parametrize(("replace", "message"), BAD)
def test_bad_files_are_named(replace: tuple[str, str], message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=rf"cameras.xml: {message}"):
        read_metashape(write(tmp_path, replace=replace))


@pytest.mark.filterwarnings("ignore:.*not aligned:mvseg.errors.InputWarning")
def test_a_project_of_photoscan(tmp_path: Path) -> None:
    """Its doc.xml holds its chunks in <chunks>, and the photos once more, in <frames>."""
    expected = read_metashape(write(tmp_path)).cameras
    content = (tmp_path / "cameras.xml").read_text()
    frames = '<frames><frame id="0"><cameras><camera camera_id="0"/></cameras></frame></frames>'
    project = content.replace("<chunk ", '<chunks next_id="1" active_id="0"><chunk id="0" ')
    project = project.replace("</chunk>", f"{frames}</chunk></chunks>")
    path = tmp_path / "doc.xml"
    path.write_text(project)
    (tmp_path / "cameras.xml").unlink()
    with warns_of("cameras_not_aligned"):
        scene = load_scene(tmp_path)
    assert torch.equal(scene.cameras.t, expected.t)
    path.write_text(project.replace("</chunks>", "<chunk/></chunks>"))
    with pytest.raises(InputError, match=r"doc.xml: holds 2 chunks, expected the cameras of one chunk"):
        load_scene(tmp_path)
    path.write_text(project.replace("<f>150.0</f>", "<fx>150.0</fx><fy>150.0</fy>"))
    with pytest.raises(InputError, match=r"doc.xml: camera IMG_0: its calibration has no f \(old PhotoScan writes fx"):
        load_scene(tmp_path)


FOREIGN = [
    [{"id": 0, "img_name": "IMG_0", "width": 128, "height": 96, "position": [0, 0, 0], "rotation": [[1, 0, 0]] * 3}],
    {"cameras": {"cam_0": {"K": [[1, 0, 0]] * 3}}},
]


@pytest.mark.filterwarnings("ignore:.*not aligned:mvseg.errors.InputWarning")
@pytest.mark.parametrize("foreign", FOREIGN)
def test_another_programs_cameras_json_hides_nothing(foreign: object, tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / "cameras.json").write_text(json.dumps(foreign))
    with warns_of("rig_not_used"):
        assert load_scene(tmp_path).source == tmp_path / "cameras.xml"
    (tmp_path / "cameras.xml").unlink()
    with pytest.raises(InputError, match=r"cameras.json: (format: Field required|Input should be a valid dictionary$)"):
        load_scene(tmp_path)


def test_a_rig_file_that_is_broken_is_still_the_scenes(tmp_path: Path) -> None:
    write(tmp_path)
    for text_of_rig, reason in (("{", "not a whole JSON file"), ('{"views": []}', "format: Field required")):
        (tmp_path / "cameras.json").write_text(text_of_rig)
        with pytest.raises(InputError, match=rf"cameras.json: {reason}"):
            load_scene(tmp_path)


def test_other_xml_files_are_no_cameras(tmp_path: Path) -> None:
    (tmp_path / "annotation.xml").write_text("<annotation/>")
    with pytest.raises(InputError, match=r"no cameras, expected .*; found annotation.xml"):
        load_scene(tmp_path)
