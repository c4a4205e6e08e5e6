"""The same instance, with the same id, in every calibrated view and in 3D.

    from mvseg import load_masks, load_scene, match_regions   # my own masks and cameras -> ids
    from mvseg import MultiViewMaskRCNN                        # images and cameras -> boxes, masks, scores, ids

Names are imported when they are first used, so that `import mvseg` and `mvseg --help` are quick.
"""

from __future__ import annotations

from mvseg.system.lazy_names import lazy_names

TYPE_CHECKING = False  # type checkers take it for true; to import `typing` takes longer than all of this
if TYPE_CHECKING:
    from mvseg._version import __version__ as __version__
    from mvseg.checks.check_scene import Check as Check
    from mvseg.checks.check_scene import check_scene as check_scene
    from mvseg.config import RunConfig as RunConfig
    from mvseg.corrections.file import Corrections as Corrections
    from mvseg.corrections.file import load_corrections as load_corrections
    from mvseg.corrections.track_links import LeafLink as LeafLink
    from mvseg.demo import demo_scene as demo_scene
    from mvseg.detection.assignment import EpipolarAssignment as EpipolarAssignment
    from mvseg.detection.config import DetectConfig as DetectConfig
    from mvseg.detection.nms import cluster_aware_nms as cluster_aware_nms
    from mvseg.detectors.zoo import load_detector as load_detector
    from mvseg.errors import InputError as InputError
    from mvseg.errors import InputWarning as InputWarning
    from mvseg.evaluation.id_metrics import matching_metrics as matching_metrics
    from mvseg.evaluation.shape_distance import shape_distance as shape_distance
    from mvseg.findings.finding import Finding as Finding
    from mvseg.formats.masks.arrays import regions_from_masks as regions_from_masks
    from mvseg.formats.masks.arrays import with_instance_ids as with_instance_ids
    from mvseg.formats.photos import load_photos as load_photos
    from mvseg.formats.scene_folder import load_masks as load_masks
    from mvseg.formats.scene_folder import load_scene as load_scene
    from mvseg.masks import Masks as Masks
    from mvseg.masks import Origin as Origin
    from mvseg.matching.affinity import Affinity as Affinity
    from mvseg.matching.affinity import region_affinity as region_affinity
    from mvseg.matching.config import MatchConfig as MatchConfig
    from mvseg.matching.epipolar import epipolar_map as epipolar_map
    from mvseg.matching.match import match_regions as match_regions
    from mvseg.matching.result import Matching as Matching
    from mvseg.matching.result import MatchReport as MatchReport
    from mvseg.matching.symnmf import cluster_affinity as cluster_affinity
    from mvseg.pipeline.mask_rcnn import MultiViewMaskRCNN as MultiViewMaskRCNN
    from mvseg.pipeline.run_scene import run_scene as run_scene
    from mvseg.reconstruction.config import ReconstructConfig as ReconstructConfig
    from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces as fit_surfaces
    from mvseg.reconstruction.surface.leaf_surface import LeafSurface as LeafSurface
    from mvseg.reconstruction.voxels import reconstruct_instances as reconstruct_instances
    from mvseg.regions import Regions as Regions
    from mvseg.regions import regions_from_label_maps as regions_from_label_maps
    from mvseg.results.read import load_result as load_result
    from mvseg.scene import Cameras as Cameras
    from mvseg.scene import Scene as Scene
    from mvseg.system.running import running as running
    from mvseg.tracking.track import Tracks as Tracks
    from mvseg.tracking.track import track_leaves as track_leaves
    from mvseg.traits.config import TraitsConfig as TraitsConfig
    from mvseg.traits.measure import Traits as Traits
    from mvseg.traits.measure import measure_plant as measure_plant

__getattr__, __all__ = lazy_names(__name__, __file__)
