"""Agisoft Metashape's cameras in XML (File > Export > Export Cameras).

`transform` of a camera is chunk_from_cam, with +x right, +y down and +z forward; that of the chunk or component
(rotation, translation, scale) leads to the world, in metres. Metashape's manual gives the pixel of a ray (x, y, 1):

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + p1 (r^2 + 2 x^2) + 2 p2 x y
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + p2 (r^2 + 2 y^2) + 2 p1 x y
    u = w / 2 + cx + x' (f + b1) + y' b2,    v = h / 2 + cy + y' f

with the corner of the top-left pixel at (0, 0). p1 and p2 are OpenCV's p2 and p1.

A slave of a rig has no `transform`: it is that of its master times the offset of its sensor, `rotation` and `location`
(master_from_slave; photogrammetrycommunity.github.io, "slave-sensor transform"; not tried in Metashape itself).
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from mvseg.errors import InputError, faults_of, warn
from mvseg.findings.finding import Finding
from mvseg.formats.image_file import MAX_SIDE
from mvseg.formats.lens import opencv_lens
from mvseg.formats.photos import Photo, build_scene, find_photo
from mvseg.formats.text_file import read_bytes
from mvseg.scene import ROTATION_TOLERANCE, Scene

MAX_BYTES = 1 << 26  # limit: bytes of a file
GEOCENTRIC = 1e5  # chosen: metres from the origin, beyond which float32 does not resolve millimetres
CAMERAS = "cameras//camera"  # those in groups, too; not the photos of a project's frames
NAMES = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "p1", "p2")
UNKNOWN_NAMES = ("k4", "p3", "p4")  # numbers of the lens that OpenCV's model does not have


def find_metashape(folder: Path) -> Path | None:
    """The XML file of cameras in a scene folder: the first whose content looks like Metashape's; None if none does."""
    for path in sorted(folder.glob("*.xml")):
        with suppress(OSError), path.open("rb") as file:
            head = file.read(4096)
            if b"<document" in head and b"<chunk" in head:
                return path
    return None


def read_metashape(path: Path) -> Scene:
    """The scene of the cameras of a Metashape chunk, in the order of the file; photos are found by their labels.

    The unit is "m" where the chunk has a transform (markers, scale bars or positions), else unknown. A geocentric
    transform loses its translation. Warns (InputWarning) of that, of cameras that are not aligned, and of slaves of a
    rig that are left out: there, whether the offset is in metres or in units of the chunk is not known.

    Raises:
        InputError: the file is not a complete XML file of Metashape, holds several chunks or components, or a camera
            whose sensor is unknown or not supported (fisheye, spherical, k4, p3, p4, b2 with distortion).
    """
    chunk = _read_chunk(path)
    sensors = {sensor.get("id"): sensor for sensor in chunk.iterfind("sensors/sensor")}
    with faults_of(path):
        world_from_chunk = _find_transform(path, chunk)
    turn, shift, scale = world_from_chunk or (np.eye(3), np.zeros(3), 1.0)
    cameras = {camera.get("id"): camera for camera in chunk.iterfind(CAMERAS)}
    photos, num_left_out, slaves = [], 0, []
    for index, camera in enumerate(chunk.iterfind(CAMERAS)):
        label = camera.get("label") or str(index)
        with faults_of(f"{path}: camera {label}"):
            sensor = sensors.get(camera.get("sensor_id"))
            is_slave = camera.get("master_id") in cameras and camera.find("transform") is None
            chunk_from_master = _read_pose(cameras[camera.get("master_id")] if is_slave else camera)
            offset = _read_offset(sensor) if is_slave else np.eye(4)
            if chunk_from_master is None or camera.get("enabled") in ("0", "false"):
                num_left_out += 1
            elif world_from_chunk is not None and offset[:3, 3].any():
                slaves.append(label)
            else:
                chunk_from_cam = chunk_from_master @ offset
                R, center = turn @ chunk_from_cam[:3, :3], scale * turn @ chunk_from_cam[:3, 3] + shift
                photos.append(_photo(path.parent, label, sensor, R=R, center=center))
    if num_left_out:
        warn(Finding("cameras_not_aligned", str(path), {"count": num_left_out}))
    if slaves:
        warn(Finding("slaves_left_out", str(path), {"count": len(slaves), "slaves": tuple(slaves)}))
    return build_scene(path.parent, photos, unit="" if world_from_chunk is None else "m", source=path)


def _read_chunk(path: Path) -> ElementTree.Element:
    data = read_bytes(path, "the cameras of Metashape alone", most=MAX_BYTES)
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:  # entities can expand without bound
        raise InputError(f"{path}: declares a document type, which Metashape does not")
    try:
        document = ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise InputError(f"{path}: not a whole XML file ({error})") from None
    chunks = document.findall("chunk") or document.findall("chunks/chunk")  # an export, or PhotoScan's project
    if document.tag != "document" or len(chunks) != 1:
        raise InputError(f"{path}: holds {len(chunks)} chunks, expected the cameras of one chunk of Metashape")
    return chunks[0]


def _find_transform(path: Path, chunk: ElementTree.Element) -> tuple[np.ndarray, np.ndarray, float] | None:
    components = chunk.findall("components/component")
    used = {camera.get("component_id") for camera in chunk.iterfind(CAMERAS) if camera.find("transform") is not None}
    if len(used) > 1:
        raise InputError(f"the cameras belong to {len(used)} components, expected one")
    owners = [each for each in components if each.get("id") in used] or [chunk]
    transform = owners[0].find("transform")
    if transform is None or transform.find("scale") is None:
        return None
    R = _numbers(transform.findtext("rotation", "1 0 0 0 1 0 0 0 1"), 9).reshape(3, 3)
    T = _numbers(transform.findtext("translation", "0 0 0"), 3)
    scale = float(_numbers(transform.findtext("scale", "1"), 1)[0])
    if scale <= 0:
        raise InputError(f"the scale of the chunk is {scale:g}, expected a positive number")
    if np.abs(T).max() > GEOCENTRIC:
        warn(Finding("geocentric", str(path), {"distance": float(np.linalg.norm(T))}))
        T = np.zeros(3)
    return R, T, scale


def _read_pose(camera: ElementTree.Element) -> np.ndarray | None:
    text = camera.findtext("transform")
    if text is None:
        return None
    chunk_from_cam = _numbers(text, 16).reshape(4, 4)
    if np.abs(chunk_from_cam[3] - [0, 0, 0, 1]).max() > ROTATION_TOLERANCE:
        raise InputError("the last row of its transform is not 0, 0, 0, 1")
    return chunk_from_cam


def _read_offset(sensor: ElementTree.Element | None) -> np.ndarray:
    """(4, 4) master_from_slave of the sensor of a slave."""
    master_from_slave = np.eye(4)
    if sensor is not None:
        master_from_slave[:3, :3] = _numbers(sensor.findtext("rotation", "1 0 0 0 1 0 0 0 1"), 9).reshape(3, 3)
        master_from_slave[:3, 3] = _numbers(sensor.findtext("location", "0 0 0"), 3)
    return master_from_slave


def _photo(folder: Path, label: str, sensor: ElementTree.Element | None, *, R: np.ndarray, center: np.ndarray) -> Photo:
    if sensor is None:
        raise InputError("its sensor is not in the file")
    width, height, values = _read_sensor(sensor)
    f, cx, cy, b1, b2, k1, k2, k3, p1, p2 = (values[name] for name in NAMES)
    K = np.array([[f + b1, b2, width / 2 + cx], [0, f, height / 2 + cy], [0, 0, 1]])
    lens = opencv_lens(K, [k1, k2, p2, p1, k3], width=width, height=height)
    file = find_photo(folder, f"images/{label}")
    return Photo(file=file, width=width, height=height, K=K, R=R.T, t=-R.T @ center, lens=lens)


def _read_sensor(sensor: ElementTree.Element) -> tuple[int, int, dict[str, float]]:
    kind = sensor.get("type", "frame")
    if kind != "frame":
        raise InputError(f"its sensor is of the type {kind}, expected frame")
    found = {each.get("class"): each for each in sensor.iterfind("calibration")}
    calibration = found.get("adjusted", next(iter(found.values()), None))
    if calibration is None:
        raise InputError("its sensor has no calibration")
    if calibration.find("f") is None:
        raise InputError("its calibration has no f (old PhotoScan writes fx and fy), expected one of Metashape's")
    size = calibration.find("resolution")
    size = sensor.find("resolution") if size is None else size
    if size is None:
        raise InputError("its sensor has no resolution")
    width, height = (_numbers(size.get(side, ""), 1)[0] for side in ("width", "height"))
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise InputError(f"the resolution of its sensor is {width:g} x {height:g}")
    values = {name: float(_numbers(calibration.findtext(name, "0"), 1)[0]) for name in (*NAMES, *UNKNOWN_NAMES)}
    for name in UNKNOWN_NAMES:
        if values[name]:
            advice = f"expected 0: optimise the cameras without {name}"
            raise InputError(f"its sensor has {name} = {values[name]:g}, {advice}")
    return int(width), int(height), values


def _numbers(text: str, count: int) -> np.ndarray:
    try:
        numbers = np.array([float(word) for word in text.split()])
    except ValueError:
        numbers = np.array([np.nan])
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise InputError(f"'{text.strip()[:40]}' is not {count} finite numbers")
    return numbers
