"""The numbers of detection: definitions, technical limits, and what was fitted to development plants.

They are read for --help, too: this module loads no torch. docs/notes/detector.md says how scores and sizes were found.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class DetectionNumbers:
    """Proposals of a detector, in all views at once."""

    size_step: float = 0.5**0.5  # chosen: size of a look, as a share of the one before: half of the pixels
    # Of two muskmelons of three, eight of 20 views find the best size, in a third of the time (docs/notes/detector.md).
    judging_views: int = 8  # chosen: views that choose the size, where there are twice as many or more
    as_good: float = 0.9  # chosen: min. agreed area of the second best size, in the best one; then all views see both
    clear_agreement: float = 0.84  # chosen: agreement from which one smaller size without growth ends the search
    patience: int = 2  # fitted: `python -m benchmarks.sizes SCENE... --cut`; the same below, sizes that do not end it
    brightest: float = 1.5  # limit: pixel value above which photos are not in [0, 1]; resampling may exceed 1
    # Matching at 0.05 and 0.2, too, moves MV-PQ by 0.003.
    sure_score: float = 0.3  # insensitive: min. score of the proposals that are matched first
    more_score: float = 0.1  # chosen: min. score of proposals that are matched for more candidates
    least_score: float = 0.05  # definition: min. score of the whole excessive set: torchvision's threshold
    most_proposals: int = 200  # limit: proposals of a view, the best ones; a fern has up to 190
    num_growths: int = 2  # chosen: how often boxes of proposals grow where their masks touch them, see `grow_boxes`
    mask_pixels: int = 1024  # limit: max. pixels of a proposal's mask that send out epipolar lines
    band_pixels: int = 65_536  # limit: pixels of an image that sample the area of a band, at most about
    plant_views: int = 3  # chosen: min. views of an instance that is part of the plant; all where there are fewer
    plant_margin: float = 0.1  # chosen: margin around the plant, as a share of its box's longer side: missed leaves
    least_gain: float = 1.5  # chosen: run a second pass only if it magnifies the plant by this factor (median photo)


DETECTION = DetectionNumbers()
