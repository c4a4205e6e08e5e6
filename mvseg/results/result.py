"""Everything known about one scene after a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from mvseg.findings.finding import Finding
from mvseg.formats.photos import Photos
from mvseg.masks import Masks
from mvseg.matching.result import Matching
from mvseg.regions import Regions
from mvseg.scene import Scene

if TYPE_CHECKING:  # loads trimesh and scikit-image
    from mvseg.corrections.corrected import Fate
    from mvseg.corrections.file import Corrections
    from mvseg.reconstruction.surface.leaf_surface import LeafSurface
    from mvseg.reconstruction.voxels import VoxelGrid
    from mvseg.results.run_record import RunRecord
    from mvseg.traits.measure import Traits
    from mvseg.verification.choose import RejectedCandidate


@dataclass(frozen=True, eq=False)
class Instances:
    """The table of the instances that `Masks` names. (Their support follows from the masks, see `Matching.support`.)

    Attributes:
        probabilities: {instance id: P} of leaves that the views chose.
        starts: {instance id: surface} that they were chosen by, and the final ones are fitted from.
        surfaces: {instance id: surface}, some perhaps not credible (`is_credible`); None if not requested.
        voxels: {instance id: voxels}: of all instances if voxels were requested, otherwise of those without a credible
            surface; None for ids only.
        traits: of the plant and its leaves, once ids are final; None for ids only.
    """

    probabilities: Mapping[int, float] = field(default_factory=dict)
    starts: Mapping[int, LeafSurface] = field(default_factory=dict)
    surfaces: Mapping[int, LeafSurface] | None = None
    voxels: Mapping[int, VoxelGrid] | None = None
    traits: Traits | None = None

    def renumber(self, numbers: Mapping[int, int]) -> Instances:
        """Instance k by the id `numbers[k]`."""

        def rename(values: Mapping[int, Any] | None) -> Any:
            return None if values is None else {numbers[instance]: each for instance, each in values.items()}

        return Instances(*map(rename, (self.probabilities, self.starts, self.surfaces, self.voxels)))


@dataclass(frozen=True)
class Learned:
    """Outcome of teaching the detector by the views, see `mvseg.pipeline.learn`.

    Attributes:
        weights: content of the file of the weights that found the leaves, if they were learned here; else None.
        rounds: that they took.
        agreed_area: pixels, before learning and after each round, see `rate_pass`; () where masks were given.
    """

    weights: bytes | None = None
    rounds: int = 0
    agreed_area: tuple[float, ...] = ()


NOTHING_LEARNED = Learned()


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """Everything known about one scene.

    Attributes:
        scene: the scene with the views that were taken.
        matching: the table of its masks, undistorted, with their ids; and a report on the scene.
        instances: the table of its instances; `surfaces`, `voxels` and `traits` are its columns.
        photos: of the scene; None: they are read when they are needed.
        rejected: candidates that the views did not choose, the most likely leaf first.
        findings: of the run, on its input and the result, the gravest first.
        seconds: {stage: wall time}.
        mask_kind: source of the masks ("COCO", "label images", ...); "" where a detector found them.
        views_left_out: names of the scene's other views, see `RunConfig.views`.
        fates: the outcome of each of them.
        before_edits: the plant before any edit, as `mvseg correct` opens it (`pack_plant`); None: nothing is kept.
        inputs: {path: SHA-256} of the cameras, masks, weights and corrections, as the run read them.
        run: that made a result which was loaded from its folder; None before it was saved.
    """

    scene: Scene
    matching: Matching
    instances: Instances = Instances()
    photos: Photos | None = None
    rejected: tuple[RejectedCandidate, ...] = ()
    findings: tuple[Finding, ...] = ()
    seconds: Mapping[str, float] = field(default_factory=dict)
    mask_kind: str = ""
    views_left_out: tuple[str, ...] = ()
    corrections: Corrections | None = None
    fates: tuple[Fate, ...] = ()
    learned: Learned = NOTHING_LEARNED
    before_edits: bytes | None = None
    inputs: Mapping[str, str] = field(default_factory=dict)
    run: RunRecord | None = None

    def __repr__(self) -> str:
        surfaces = () if self.surfaces is None else self.surfaces.values()
        rows = 0 if self.traits is None else len(self.traits.leaves)
        lines = [
            f"Result of {self.scene!r}",
            f"  masks: {self.masks!r}",
            f"  instances: {self.matching.num_instances}, {sum(each.exists for each in surfaces)} with a surface",
            f"  traits: {rows} leaves" if self.traits is not None else "  traits: not measured",
        ]
        return "\n".join(lines)

    @property
    def masks(self) -> Masks:
        """The table of masks."""
        return self.matching.masks

    @property
    def regions(self) -> Regions:
        """D masks, undistorted."""
        return self.masks.regions

    @property
    def surfaces(self) -> Mapping[int, LeafSurface] | None:
        return self.instances.surfaces

    @property
    def voxels(self) -> Mapping[int, VoxelGrid] | None:
        return self.instances.voxels

    @property
    def traits(self) -> Traits | None:
        return self.instances.traits
