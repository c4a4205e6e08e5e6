"""Every script of `benchmarks/` still finds what it imports from mvseg, and says what it does: nobody runs most of them
for weeks. And skins of cut-out leaves."""

from __future__ import annotations

import importlib
import inspect
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.skins import COLUMNS, GAMMA, ROWS, list_skins, unroll_leaf

ROOT = Path(__file__).parents[1]
SCRIPTS = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for path in (ROOT / "benchmarks").rglob("*.py")
    if path.stem not in ("__init__", "__main__")
)
HEIGHT, WIDTH = 240, 320


def tilted_leaf(angle: float) -> tuple[np.ndarray, np.ndarray]:
    """An elliptical leaf of half axes 100 and 40 px, its red channel rising along it and its green one across it."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    dx, dy = x - WIDTH / 2, y - HEIGHT / 2
    along = (dx * math.cos(angle) + dy * math.sin(angle)) / 100
    across = (dy * math.cos(angle) - dx * math.sin(angle)) / 40
    mask = along**2 + across**2 <= 1
    half_width = np.sqrt(np.clip(1 - along**2, 0.01, None))
    rgb = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    rgb[..., 0] = np.clip(127.5 * (1 + along), 0, 255)
    rgb[..., 1] = np.clip(127.5 * (1 + across / half_width), 0, 255)
    return rgb * mask[..., None], mask


@pytest.mark.parametrize("angle", [0.0, 0.6, 2.0])
def test_a_leaf_unrolls_to_its_length_and_width_whatever_its_direction(angle: float) -> None:
    skin = unroll_leaf(*tilted_leaf(angle))
    assert skin.shape == (ROWS, COLUMNS, 3)
    red, green = skin[..., 0] ** (1 / GAMMA), skin[..., 1] ** (1 / GAMMA)
    rows, columns = slice(ROWS // 8, -ROWS // 8), slice(4, -4)
    along, across = np.linspace(0, 1, ROWS)[:, None], np.linspace(0.03, 0.97, COLUMNS)
    for found, wanted in ((red, along), (green, across)):
        wanted = np.broadcast_to(wanted, found.shape)
        error = min(np.abs(found - turned)[rows, columns].max() for turned in (wanted, 1 - wanted))
        assert error < 0.05  # which end comes first, and which side, is not known


def test_a_folder_of_cut_out_leaves_is_asked_for(tmp_path: Path) -> None:
    rgb, mask = tilted_leaf(0.3)
    cv2.imwrite(str(tmp_path / "a.png"), np.dstack([rgb[..., ::-1], mask * np.uint8(255)]))
    assert np.allclose(list_skins(tmp_path)[0], unroll_leaf(rgb, mask))
    cv2.imwrite(str(tmp_path / "b.png"), rgb)
    with pytest.raises(SystemExit, match="expected PNG files of 8 bits with an alpha channel"):
        list_skins(tmp_path)


def test_they_are_imported_and_print_their_help(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert len(SCRIPTS) > 40
    for name in SCRIPTS:
        script = importlib.import_module(name)
        assert script.__doc__, name
        main = getattr(script, "main", None)
        if main is None or inspect.signature(main).parameters or "ArgumentParser(" not in inspect.getsource(script):
            continue
        monkeypatch.setattr("sys.argv", [name, "--help"])
        with pytest.raises(SystemExit) as stopped:
            main()
        assert stopped.value.code == 0, name
        assert capsys.readouterr().out.startswith("usage:"), name
