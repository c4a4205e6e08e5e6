"""HEIC photos, as phones write them: opened by pi_heif, if it is installed (`mvseg[heic]`).

Decoders turn the pixels as the container says (`irot`, ISO/IEC 23008-12); which turn that is, is read here, so that it
can be undone. What EXIF says of the orientation counts for nothing in these files.
"""

from __future__ import annotations

from collections.abc import Iterator
from io import BytesIO
from typing import IO

from PIL.ImageFile import ImageFile

from mvseg.errors import InputError

SUFFIXES = (".heic", ".heif")
BRANDS = (b"heic", b"heix", b"mif1", b"msf1", b"hevc", b"heim")  # of the file, in its bytes 8 to 12
TURN = "turn"  # in an image's info: how the decoder turns it, 1 to 8 as in EXIF
QUARTERS = (1, 8, 3, 6)  # definition: a turn by 0 to 3 quarters, anticlockwise, as in EXIF


def open_heic(file: IO[bytes]) -> ImageFile:
    """The main image of a file, not decoded yet; its `info` has `TURN`. Raises InputError if pi_heif is not installed,
    or the image is mirrored."""
    try:
        from pi_heif import HeifImageFile
    except ImportError:
        convert = "or convert it to JPEG without turning or scaling it"
        raise InputError(f"it is a HEIC file: pip install 'mvseg[heic]' reads it, {convert}") from None
    data = file.read()
    image: ImageFile = HeifImageFile(BytesIO(data))
    image.info[TURN] = find_turn(data)
    return image


def find_turn(data: bytes) -> int:
    """Read how decoders turn the main image of a HEIC file, 1 to 8 as in EXIF. Raises InputError if it is also
    mirrored, or the file does not say what its main image is."""
    meta = _content(data, b"meta")[4:]
    main, properties = _content(meta, b"pitm"), _content(meta, b"iprp")
    wanted = _linked(_content(properties, b"ipma"), int.from_bytes(main[4:]))
    own = [box for number, box in enumerate(_boxes(_content(properties, b"ipco")), start=1) if number in wanted]
    if any(kind == b"imir" for kind, _ in own):
        raise InputError("it is a HEIC file that mirrors its image, expected an image as the camera sees it")
    return QUARTERS[sum(content[0] & 3 for kind, content in own if kind == b"irot") % 4]


def _linked(links: bytes, item: int) -> set[int]:
    id_bytes, link_bytes = (4 if links[0] else 2), (2 if links[3] & 1 else 1)
    items, at = set(), 8
    for _ in range(int.from_bytes(links[4:8])):
        owner, count = int.from_bytes(links[at : at + id_bytes]), links[at + id_bytes]
        start, at = at + id_bytes + 1, at + id_bytes + 1 + count * link_bytes
        if owner == item:  # the upper bit of a number says whether a reader must understand the property
            parts = [links[place : place + link_bytes] for place in range(start, at, link_bytes)]
            items |= {int.from_bytes(part) & (0x7FFF if link_bytes == 2 else 0x7F) for part in parts}
    return items


def _content(data: bytes, kind: bytes) -> bytes:
    for found, content in _boxes(data):
        if found == kind:
            return content
    raise InputError(f"it is a damaged HEIC file, without the part {kind.decode()}")


def _boxes(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Kind and content of the boxes that lie one after the other (ISO/IEC 14496-12)."""
    at = 0
    while at + 8 <= len(data):
        size, kind, head = int.from_bytes(data[at : at + 4]), data[at + 4 : at + 8], 8
        if size == 1:
            size, head = int.from_bytes(data[at + 8 : at + 16]), 16
        stop = len(data) if size == 0 else at + max(size, head)
        yield kind, data[at + head : stop]
        at = stop
