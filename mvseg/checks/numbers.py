"""The numbers of the checks: definitions, technical limits, and thresholds from which a user is told.

Those of poses were chosen on 96 development scenes, 48 simulated plants with true and with degraded masks, with eight
faults in each, so that no sound view was off: docs/notes/check.md.
A unit is one pixel, or more where photos are large: see `Cameras.unit_px`.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class CameraNumbers:
    """Cameras on their own."""

    most_sources: int = 32  # limit: max. cameras whose rays give candidate points
    points_at_once: int = 4096  # limit: candidate points at a time; their number bounds the memory
    all: float = 0.9  # chosen: min. share of the cameras that look at one point, if poses are right
    most: float = 0.6  # chosen: the same, below which another reading of the poses that is right is the better one
    wider: int = 4  # chosen: factor of the angle between cameras from which such a reading is the better one, too
    field_of_view: tuple[float, float] = (2.0, 140.0)  # chosen: degrees along the diagonal, no fisheyes
    off_center: float = 0.2  # chosen: max. distance of a principal point from the middle, as a share of the side
    square: float = 1.2  # chosen: max. quotient of the focal lengths along x and y
    far: float = 8.0  # chosen: max. distance of a camera from the middle of the others, in their median distance
    gap: float = 3.0  # chosen: min. quotient of two lengths of t between which the unit may change
    alike: float = 2.0  # chosen: max. quotient of the distances of two groups of cameras in one unit
    narrow: float = 2.0  # chosen: degrees between the most different rays, below which there is no depth
    wide: float = 75.0  # chosen: degrees between the rays of neighbouring views, above which they share no leaves
    beside: float = 0.3  # chosen: weight, where up is unknown, of cameras beside the plant, to that of upright photos
    overhead: float = 0.25  # chosen: cosine of the elevation from which a camera stands above the plant, on no side


@dataclass(frozen=True)
class AgreementNumbers:
    """Masks of two views fit if they begin and end at the same epipolar lines, better than by chance."""

    num_moves: int = 16  # limit: moves of a view's masks, which show what chance does
    most_partners: int = 20  # limit: views that each view is compared with, about
    most_offset: int = 40  # limit: units that lines may miss by, tried in both directions
    widest: float = 1.5  # limit, radians: part of the pencil that a mask fills; with more it holds the epipole
    sharpness: float = 2.0  # chosen: width of a vote for an offset, in units
    off: float = 0.22  # chosen: share of fitting masks below which a view agrees with none, if lines miss
    offset: float = 1.5  # chosen: units from which lines miss
    most_agree: float = 0.3  # chosen: quantile of the offsets over the other views: noise alone puts some of them at 0
    few_masks: int = 10  # chosen: masks of two views (median), to be sure; of fewer, one faulty mask is too many
    few_views: int = 4  # chosen: views to be sure: of fewer, none is outvoted
    chance: float = 0.06  # chosen: share of the masks that fit where poses and masks have nothing to do with each other
    apart: float = 0.5  # chosen: max. fitting share between two worlds, relative to that within them
    smallest: int = 2  # definition: views of a group; one alone is for `view_agreement`
    # On 65 real plants and dates with sound masks it is 0.47 and more, but for 0.28 on a basil of 30 leaves that hide
    # each other; where the masks of a simulated plant are turned, it is 0.29 and 0.26.
    low: float = 0.4  # chosen: share that fits in the median view, below which a user is told
    turned: int = 2  # chosen: ratio of fits of turned masks and of those as they are: drawn turned


@dataclass(frozen=True)
class PhotoNumbers:
    """Masks and photos on their own, and shapes of the target in photos."""

    tiny_px: int = 30  # chosen: min. pixels of a mask that carries information
    many: float = 0.25  # chosen: share of the masks that are tiny or cut by the border, above which a user is told
    few: float = 0.34  # chosen: masks of a view, in their median number, below which some may be missing
    small_component: float = 0.002  # chosen: component that does not count, relative to its mask's pixels
    beyond: float = 0.1  # chosen: max. reach of stray pixels beyond a mask, as a share of the photo's longer side
    blank: float = 4.0  # chosen: max. standard deviation of grey levels of a photo of nothing
    blank_share: float = 0.03  # chosen: the same of a dark photo, relative to its level; real photos have 0.2
    rounding: float = 1.0  # definition: the same that rounding makes
    dark: int = 30  # chosen: grey level below which 99 % of the pixels of a dark photo are
    stops: float = 1 / 3  # definition: the least step of a camera's dials; larger differences are noted
    burnt: float = 0.7  # chosen: share of white pixels above which a photo is overexposed
    gamma: float = 2.2  # definition: exponent of light in photos: blur mixes light, edges are where it is halfway
    smooth_px: float = 4.0  # chosen: pixels over which light hardly changes, unlike ink and paper at an edge
    least_iou: float = 0.75  # chosen: IoU of a mask with its shape; shapes have 0.93 and more, noise up to 0.72


CAMERAS = CameraNumbers()
AGREEMENT = AgreementNumbers()
IMAGES = PhotoNumbers()
