"""From the colours of photos to the colours of things: a linear correction by a card of known colours.

    y = M x        x, y: linear light (sRGB values without their gamma) of a pixel, and of the same under daylight

M (3, 3) is fitted to the 24 patches by least squares. Each patch counts by 1 / (its own light + 0.05), because eyes,
and the residual, see shares of light and no sums. Patches that the photo shows overexposed do not count.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mvseg.errors import InputError, InputWarning
from mvseg.formats.color_card import find_patches, read_card_file
from mvseg.formats.photos import read_photo
from mvseg.scene import Scene
from mvseg.traits.config import ColorCard, ColorCorrection

Floats = NDArray[np.float64]
Fit = tuple[tuple[float, ...], float]  # M, row by row, and the mean Delta E of the corrected patches

# sRGB values of the patches under D65 as X-Rite publishes them, row by row from the brown one.
PUBLISHED = np.array(
    [
        (115, 82, 68), (194, 150, 130), (98, 122, 157), (87, 108, 67), (133, 128, 177), (103, 189, 170),
        (214, 126, 44), (80, 91, 166), (193, 90, 99), (94, 60, 108), (157, 188, 64), (224, 163, 46),
        (56, 61, 150), (70, 148, 73), (175, 54, 60), (231, 199, 31), (187, 86, 149), (8, 133, 161),
        (243, 243, 242), (200, 200, 200), (160, 160, 160), (122, 122, 121), (85, 85, 85), (52, 52, 52),
    ],
    dtype=float,
)  # fmt: skip
BURNT = 250  # sRGB value of a channel from which a patch is overexposed
FEWEST = 12  # patches that a fit needs
NO_CARD = 10.0  # mean Delta E from which what was found is no card, or its light no one light


def read_color_card(source: str | Path) -> ColorCard:
    """What `--color_card` says: "find", a photo of a card, or a card file (see `formats.color_card`).

    Raises:
        InputError: see `read_card_file`; or what is there is no card under one light.
    """
    if str(source) == "find":
        return "find"
    path = Path(source)
    return tuple(
        fit_best(patches, views=entry.views, photo=path.parent / entry.photo) for entry, patches in read_card_file(path)
    )


def correct_views(scene: Scene, card: ColorCard | None) -> list[ColorCorrection | None]:
    """The correction of each view of a scene, None for a view without one.

    With "find", the first photo of each camera (views of the same K, lens and size) that shows a card stands for all of
    its photos. Warns (InputWarning) of views without a card.

    Raises:
        InputError: a photo is broken; see `find_patches`.
    """
    if card is None or not any(view.path.is_file() for view in scene.views):
        return [None] * len(scene.views)
    names = [view.name for view in scene.views]
    if card == "find":
        found = _find_cards(scene)
    else:
        found = [next((each for each in card if fnmatchcase(name, each.views)), None) for name in names]
    without = [name for name, correction in zip(names, found, strict=True) if correction is None]
    if without:
        rest = "have no part in the colours" if any(found) else "colours are uncorrected"
        message = f"{len(without)} of {len(names)} views have no colour card, the first is {without[0]}: {rest}"
        warnings.warn(f"{scene.name}: {message}", InputWarning, stacklevel=2)
    return found


def _find_cards(scene: Scene) -> list[ColorCorrection | None]:
    """One entry per view, the same for all views of a camera."""
    by_camera: dict[str, list[int]] = {}
    for index, each in enumerate(scene.views):
        lens = None if each.lens is None else list(each.lens.params)
        camera = [scene.cameras.K[index].tolist(), scene.cameras.sizes[index].tolist(), lens]
        by_camera.setdefault(str(camera), []).append(index)
    found: list[ColorCorrection | None] = [None] * len(scene.views)
    for views in by_camera.values():
        names = [scene.views[index].name for index in views]
        for index, name in zip(views, names, strict=True):
            fit = _best_fit(find_patches(read_photo(scene, index)))
            if fit is not None and fit[1] < NO_CARD:
                correction = ColorCorrection(", ".join(names), *fit, photo=name)
                found = [correction if view in views else other for view, other in enumerate(found)]
                break
    return found


def correct_colors(correction: ColorCorrection, pixels: NDArray) -> Floats:
    """(..., 3) sRGB values from 0 to 1 of pixels (..., 3) from 0 to 255."""
    return from_linear(to_linear(pixels / 255) @ np.reshape(correction.matrix, (3, 3)).T)


def fit_best(candidates: Sequence[Floats], *, views: str, photo: Path) -> ColorCorrection:
    """The correction by that of several sets of patches (24, 3) which fits best.

    Raises:
        InputError: none of them is a card, or the photo is overexposed.
    """
    fit = _best_fit(candidates)
    if fit is None:
        what = f"its colour card is overexposed, expected {FEWEST} patches or more below {BURNT}"
        raise InputError(f"{photo}: {what}")
    matrix, delta_e = fit
    if not delta_e < NO_CARD:
        what = f"its colour card differs by Delta E {delta_e:.0f} from the published colours after the correction"
        raise InputError(f"{photo}: {what}, expected less than {NO_CARD:g}: is it the card, are the corners in order?")
    return ColorCorrection(views, matrix, delta_e, photo.name)


def _best_fit(candidates: Iterable[Floats]) -> Fit | None:
    fits = [fit for fit in map(_fit, candidates) if fit is not None]
    return min(fits, key=lambda fit: fit[1], default=None)


def _fit(patches: Floats) -> Fit | None:
    """M and the mean Delta E of patches (24, 3), sRGB values from 0 to 255; None where too many are overexposed."""
    from skimage.color import deltaE_ciede2000, rgb2lab  # slow to load

    is_sound = (patches < BURNT).all(1)
    if is_sound.sum() < FEWEST:
        return None
    shown, true = to_linear(patches[is_sound] / 255), to_linear(PUBLISHED[is_sound] / 255)
    weights = 1 / (true.mean(1, keepdims=True) + 0.05)
    solved, *_ = np.linalg.lstsq(weights * shown, weights * true, rcond=None)
    corrected = from_linear(shown @ solved)
    distances = deltaE_ciede2000(rgb2lab(corrected), rgb2lab(PUBLISHED[is_sound] / 255))
    return tuple(float(number) for number in solved.T.ravel()), float(distances.mean())


def to_linear(srgb: Floats) -> Floats:
    """Linear light of sRGB values, both from 0 to 1."""
    return np.asarray(np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4), float)


def from_linear(light: Floats) -> Floats:
    """sRGB values, from 0 to 1, of linear light; what lies outside is cut off."""
    light = np.clip(light, 0, 1)
    return np.asarray(np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055), float)
