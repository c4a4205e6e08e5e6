"""Region matching: masks and cameras in, instance ids out. Public names are imported when they are first used."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mvseg.system.lazy_names import lazy_names

if TYPE_CHECKING:
    from mvseg.matching.affinity import Affinity as Affinity
    from mvseg.matching.affinity import region_affinity as region_affinity
    from mvseg.matching.config import MatchConfig as MatchConfig
    from mvseg.matching.epipolar import epipolar_map as epipolar_map
    from mvseg.matching.match import match_regions as match_regions
    from mvseg.matching.result import Matching as Matching
    from mvseg.matching.result import MatchReport as MatchReport
    from mvseg.matching.symnmf import cluster_affinity as cluster_affinity

__getattr__, __all__ = lazy_names(__name__, __file__)
