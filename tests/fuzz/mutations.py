"""Edits that break a file: of JSON documents, at any place in them; of bytes, anywhere."""

from __future__ import annotations

import copy
import json
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from hypothesis import strategies as st

PNG_START = b"\x89PNG\r\n\x1a\n"
NASTY: list[Any] = [
    None, True, 0, 1, -1, 3, 255, 65_535, 65_536, 1 << 20, 1 << 31, 1 << 63, -(1 << 63) - 1, 10**30, 0.5, 1e-300, 1e20,
    1e300, -1e300, float("nan"), float("inf"), "", "x", "0", "1e400", "\0", "../x", "/", "é\n", "\ud800", "0" * 300,
    "zz", "images/000.png", [], {}, [[]], [1, 2, 3], [0] * 9, [[1, 1, 5, 1, 5, 5]], {"size": [12, 16], "counts": [192]},
    {"size": [12, 16], "counts": "o`" * 40}, [1e300, 1, 2, 3, 4, 5],
]  # fmt: skip

values = st.sampled_from(NASTY) | st.integers(-300, 300) | st.floats() | st.text(max_size=5)
json_edits = st.lists(
    st.tuples(st.integers(0, 10_000), st.sampled_from(["replace", "delete", "repeat", "nest"]), values),
    min_size=1,
    max_size=3,
)
chunks = st.binary(max_size=8) | st.sampled_from([b"\xff" * 8, bytes(8), b"-1", b"nan", b"1e300", b"\xff", b"\n", b" "])
byte_edits = st.lists(
    st.tuples(st.floats(0, 1), st.sampled_from(["insert", "replace", "cut", "repeat"]), chunks), min_size=1, max_size=3
)


def edit_json(document: Any, edits: Sequence[tuple[int, str, Any]]) -> bytes:
    """A document with parts replaced, deleted, repeated or put into a list, as UTF-8."""
    document = {"root": copy.deepcopy(document)}
    for number, kind, value in edits:
        places = list(_places(document))
        owner, key = places[number % len(places)]
        if kind == "delete" and owner is not document:
            del owner[key]
        elif kind == "repeat" and isinstance(owner, list):
            owner.append(copy.deepcopy(owner[key]))
        elif kind == "nest":
            owner[key] = [owner[key]]
        else:
            owner[key] = copy.deepcopy(value)  # a later edit may change it
    return json.dumps(document["root"]).encode()


def _places(owner: Any) -> Iterator[tuple[Any, Any]]:
    for key in owner if isinstance(owner, dict) else range(len(owner)):
        yield owner, key
        if isinstance(owner[key], dict | list):
            yield from _places(owner[key])


def edit_bytes(data: bytes, edits: Sequence[tuple[float, str, bytes]]) -> bytes:
    """A file with parts inserted, replaced, cut off or repeated; a PNG gets right checksums again."""
    is_png = data.startswith(PNG_START)
    for where, kind, chunk in edits:
        at = int(where * len(data))
        change: dict[str, Callable[[], bytes]] = {
            "insert": lambda at=at, chunk=chunk, data=data: data[:at] + chunk + data[at:],
            "replace": lambda at=at, chunk=chunk, data=data: data[:at] + chunk + data[at + len(chunk) :],
            "cut": lambda at=at, data=data: data[:at],
            "repeat": lambda at=at, data=data: data[:at] + data[at // 2 :],
        }
        data = change[kind]()
    return _with_checksums(data) if is_png else data


def _with_checksums(data: bytes) -> bytes:
    at = len(PNG_START)
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        stop = at + 8 + length
        data = data[:stop] + struct.pack(">I", zlib.crc32(data[at + 4 : stop])) + data[stop + 4 :]
        at = stop + 4
    return data
