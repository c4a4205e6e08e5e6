"""The table of sentences, one for each code; and which finding is the cause of which."""

from __future__ import annotations

import tomllib
from pathlib import Path

TABLES: dict[str, dict[str, str]] = tomllib.loads(Path(__file__).with_name("sentences.toml").read_text("utf-8"))
SENTENCES = {code: sentence for table in TABLES.values() for code, sentence in table.items()}
TOPICS = {code: topic for topic, table in TABLES.items() for code in table}

UNSURE_IDS = ("views_disagree", "views_odd", "views_sparse", "view_sparse", "rough_masks")
DISAGREEMENT = (*UNSURE_IDS, "views_odd_detected", "detector_unsure")  # of the views about the masks
BY_MASKS = ("poses_disagree", "view_off", "lines_miss", "separate_worlds")
# {cause and its level: what it explains, and is not told beside it}.
EXPLAINS: dict[tuple[str, str], tuple[str, ...]] = {
    ("one_sided", "warning"): ("leaves_seen_from_one_side", "shape_cut_off"),
    ("no_depth", "warning"): ("leaves_seen_from_one_side", "shape_cut_off", "one_sided"),
    ("same_position", "warning"): ("centres_shared",),
    **{
        (code, "error"): (*BY_MASKS, "low_fit", *DISAGREEMENT)
        for code in ("turned_masks", "letterboxed_masks", "transposed_masks")
    },
    **{(code, "error"): ("low_fit", *DISAGREEMENT) for code in BY_MASKS},
    ("no_leaf_left", "warning"): ("no_masks",),
    ("no_leaves", "warning"): ("nothing_detected", "detector_unsure"),
    ("species_unknown", "warning"): ("detector_unsure", "low_fit_detected", "very_many_proposals"),
}
