"""The numbers of poses: definitions, technical limits, and thresholds, with what a third less or more does to photos.

They are read for --help, too: this module loads no torch. docs/notes/pose.md says what cameras they give.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class StructureNumbers:
    """Cameras from photos alone."""

    least: int = 3  # limit: min. photos: structure from motion needs as many
    least_share: float = 0.6  # chosen: share of the photos that must register, unless `min_registered` says otherwise
    enough: float = 0.9  # chosen: share of photos below which more features are found; at 1, blur costs minutes
    few_features: int = 300  # chosen: features below which a photo has too little texture
    quick_size: int = 1600  # limit: pixels of the longer side at first; a third more takes twice as long
    quick_most: int = 4096  # limit: features of a photo at first; a third more take half as long again to match
    contrast: float = 0.02  # definition: COLMAP's contrast of a feature; a third less finds more, and more noise
    edge: float = 10.0  # definition: max. ratio of curvatures of a feature: Lowe's and COLMAP's
    ratio: float = 0.8  # definition: max. distance of the best match, in that of the second best: Lowe's
    unit: float = 512.0  # definition: COLMAP's bytes of a descriptor of length 1
    coarse: int = 256  # limit: features that are compared first, in squared time: photos share 20 to 120, or 5
    few: int = 30  # limit: photos of which all pairs are compared, 10 to 20 s of one core; a third more takes double
    overlap: int = 4  # chosen: neighbours on either side that a photo is compared with: they bridge blurred ones
    far: int = 2  # chosen: factor from step to step of neighbours that are further away
    most_alike: int = 6  # chosen: further photos that a photo is compared with; a third more are an eighth more pairs
    # Of the pairs of a plant that so many choose, half have 30 good matches; at 6 a third of them have, at 10 three
    # quarters, but a few good pairs more are missed.
    least_alike: int = 8  # chosen: coarse features that two photos must share to be alike
    pairs_at_once: int = 100  # limit: pairs of a call, which indexes each photo: at 10 it takes several times as long
    zoom_step: float = 1.02  # chosen: ratio of digital zooms from which they are two; they jitter by 0.001
    seed: int = 0  # definition: seed of all random draws
    quality: int = 95  # definition: JPEG quality of photos that are written anew


@dataclass(frozen=True)
class VideoNumbers:
    """Photos from a video; lengths are shares of the picture's longer side."""

    step: float = 0.025  # chosen: motion from photo to photo: 8 degrees round a plant; a third more is 10 degrees
    anew: float = 0.06  # insensitive: motion after which new corners are found; a third less changes nothing
    per_second: float = 15.0  # limit: frames that are looked at; a third fewer leave less choice of sharp ones
    # chosen: pixels of the longer side where corners are followed; at a third fewer, blur shows a tenth less
    small: int = 480
    corners: int = 200  # limit: corners that are followed; a third fewer or more measure a tenth less or more motion
    least_corners: int = 3  # limit: min. corners that are found again, to measure a motion
    least_followed: float = 0.5  # chosen: share of the corners that are still followed, below which new ones are found
    whole: float = 0.95  # chosen: share of the frames that a file states, below which it ended early
    damaged: int = 64  # limit: places in a row without a frame, after which the film is at its end
    window: int = 21  # definition: pixels of OpenCV's window around a corner
    levels: int = 4  # limit: halvings of the picture: motion of up to 160 pixels of `small`


@dataclass(frozen=True)
class WorldNumbers:
    """Scale and axes from what is known of the world."""

    spread: float = 0.05  # chosen: difference of markers' sides, relative to the median, that is doubtful
    misfit: float = 0.05  # chosen: residual of positions, as a share of their spread, above which they hardly fit
    flat: float = 0.02  # chosen: ratio of spreads below which points are on one line, or in one plane
    mirrored: float = 0.5  # chosen: residual of the best reflection, relative to the best similarity
    trials: int = 300  # limit: random triples of points
    outlier: float = 3.0  # chosen: max. residual of an inlier, in that which half of the points do not exceed
    rounding: float = 1e-9  # limit: residual, as a share of the spread of the points, that counts as 0


@dataclass(frozen=True)
class TableNumbers:
    """A turntable from photos of a board on it, and how sure focal lengths are."""

    least_photos: int = 4  # chosen: min. photos of a camera that show the board
    least_corners: int = 6  # limit: min. corners of the board in each of them
    least_turn: float = 10.0  # chosen: min. degrees of all photos together
    flat: float = 0.7  # chosen: cosine between the axis and the normal of a board that lies, more or less
    most_residual: float = 0.005  # chosen: residual in widths of the photo, above which more than the table has moved
    rough: float = 1e-3  # limit: relative change of squared residuals at which the first search ends
    fine: float = 1e-8  # limit: the same of the last one
    starts: tuple[float, ...] = (0.7, 1.4, 2.8)  # definition: focal lengths in longer sides: from phones to telephoto
    noise_px: float = 0.1  # chosen: standard deviation of the corners, until it is measured
    least_noise_px: float = 0.02  # chosen: the same that is believed, at least
    most_sd: float = 0.01  # chosen: standard deviation of a focal length, as a share of it; more shows in heights
    off_middle: float = 0.01  # chosen: sd of principal points of phones, cameras and webcams, in longer sides


@dataclass(frozen=True)
class LensNumbers:
    """Faults of a shared lens, as simulated walks and a real fern show them; noises are shares of that of the shared
    lens. Right photos: spread 0.006 at most, two focal lengths 0.998, own principal points 0.949 (docs/pose.md)."""

    zoomed: float = 0.03  # chosen: spread of focal lengths of single photos; zooms of 1.3 have 0.125, cut photos 0.017
    noise_of_zooms: float = 0.8  # chosen: with lenses of their own; zooms have 0.53, other faults 0.93
    squashed: float = 0.05  # chosen: |log| of a pixel's width over its height
    most_aspect_sd: float = 0.02  # chosen: from which that is not known; level walks have 0.12, others 0.016
    noise_of_squashed: float = 0.98  # chosen: with two focal lengths; squashed photos have 0.80 to 0.94
    noise_of_cut: float = 0.9  # chosen: with a free principal point; cut photos have 0.68
    noise_of_cut_each: float = 0.85  # chosen: with principal points of their own; photos that are cut anew have 0.74
    gain_of_own: float = 0.95  # chosen: the same, in the noise of the best of the others
    noise_of_fisheye: float = 0.8  # chosen: with a fisheye; an action camera has 0.47


STRUCTURE = StructureNumbers()
LENS = LensNumbers()
VIDEO = VideoNumbers()
WORLD = WorldNumbers()
TABLE = TableNumbers()
