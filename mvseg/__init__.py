"""The same instance, with the same id, in every calibrated view and in 3D.

    from mvseg import load_masks, load_scene, match_regions   # my own masks and cameras -> ids
    from mvseg import MultiViewMaskRCNN                        # images and cameras -> boxes, masks, scores, ids

Names are imported when they are first used, so that `import mvseg` and `mvseg --help` are quick.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from mvseg.affinity import Affinity as Affinity
    from mvseg.affinity import region_affinity as region_affinity
    from mvseg.clustering import cluster_affinity as cluster_affinity
    from mvseg.config import DetectConfig as DetectConfig
    from mvseg.config import MatchConfig as MatchConfig
    from mvseg.config import ReconstructConfig as ReconstructConfig
    from mvseg.detectors.zoo import load_detector as load_detector
    from mvseg.epipolar import epipolar_map as epipolar_map
    from mvseg.errors import InputError as InputError
    from mvseg.errors import InputWarning as InputWarning
    from mvseg.formats.folder import load_masks as load_masks
    from mvseg.formats.folder import load_scene as load_scene
    from mvseg.formats.photos import load_photos as load_photos
    from mvseg.matching import Matching as Matching
    from mvseg.matching import match_regions as match_regions
    from mvseg.matching import split_merged as split_merged
    from mvseg.metrics import matching_metrics as matching_metrics
    from mvseg.metrics import shape_distance as shape_distance
    from mvseg.multiview import MultiViewMaskRCNN as MultiViewMaskRCNN
    from mvseg.nms import EpipolarAssignment as EpipolarAssignment
    from mvseg.nms import cluster_aware_nms as cluster_aware_nms
    from mvseg.pipeline import run_scene as run_scene
    from mvseg.reconstruction import reconstruct_instances as reconstruct_instances
    from mvseg.regions import Regions as Regions
    from mvseg.regions import regions_from_label_maps as regions_from_label_maps
    from mvseg.scene import Cameras as Cameras
    from mvseg.scene import Scene as Scene

# The public names, by stage.
_HOME = {
    "scene": ("Cameras", "Scene"),
    "regions": ("Regions", "regions_from_label_maps"),
    "formats.folder": ("load_masks", "load_scene"),
    "formats.photos": ("load_photos",),
    "epipolar": ("epipolar_map",),
    "affinity": ("Affinity", "region_affinity"),
    "clustering": ("cluster_affinity",),
    "matching": ("Matching", "match_regions", "split_merged"),
    "nms": ("EpipolarAssignment", "cluster_aware_nms"),
    "multiview": ("MultiViewMaskRCNN",),
    "detectors.zoo": ("load_detector",),
    "reconstruction": ("reconstruct_instances",),
    "metrics": ("matching_metrics", "shape_distance"),
    "pipeline": ("run_scene",),
    "config": ("DetectConfig", "MatchConfig", "ReconstructConfig"),
    "errors": ("InputError", "InputWarning"),
}
__all__ = ["__version__", *(name for names in _HOME.values() for name in names)]


def __getattr__(name: str) -> Any:
    for module, names in _HOME.items():
        if name in names:
            return getattr(import_module(f"mvseg.{module}"), name)
    raise AttributeError(f"module 'mvseg' has no attribute '{name}'")
