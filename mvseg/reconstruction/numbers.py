"""The numbers of reconstruction: definitions, technical limits, and what was fitted to development plants.

`python -m benchmarks.thirds --cache DIR --room reconstruction` prints what a third less or more of each changes; the
table is in docs/notes/surfaces.md. A share is relative to the noun in its sentence; "masks" are those of one leaf.
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class RayNumbers:
    """Directions of cameras, and points where rays meet."""

    most_error: float = 0.003  # chosen: miss of a point, in widths of the photo, from which a view is left out
    least_angle: float = math.radians(1.0)  # chosen: min. angle between two rays that make a point
    same: float = math.radians(1.0)  # limit: angle between directions below which they crowd each other no more
    repeated: float = math.radians(0.25)  # chosen: angle below which views are of one place, as those of a burst
    parallel: float = math.radians(2.0)  # chosen: RMS of axes' angles to their mean, where they meet in no point
    tie: float = 1e-6  # limit: difference of equal sums, lengths or distances, as a share; the first one is taken


@dataclass(frozen=True)
class VoxelNumbers:
    """Grids of voxels."""

    search_cells: int = 24  # limit: cells along the box of an instance, at which the search for it ends
    shrinks: float = 0.8  # chosen: volume of the box after halving the cells, over that before, that ends the search
    max_cells: int = 100_000  # limit: cells in all, at which it ends
    max_voxels: int = 200_000_000  # limit: voxels of a grid
    crumb: float = 0.02  # chosen: size of a piece below which it is a crumb, as a share of the largest piece's voxels
    slab: int = 2_000_000  # limit: voxels of a slab that votes are counted in at once
    at_once: int = 8_000_000  # limit: balls and masks that are compared at once


@dataclass(frozen=True)
class HullNumbers:
    """The hull of a leaf, from which starts are made."""

    shown_share: float = 0.5  # chosen: share of the masks above which a voxel that is in them is occupied
    seen_share: float = 0.8  # chosen: min. fraction of unoccluded views that contain a voxel; else it is removed
    cell_px: float = 6.0  # limit: side of a cell in the photos, below which the search ends
    most_cells: int = 10_000  # limit: cells, at which it ends
    num_voxels: int = 20_000  # limit: voxels that are looked at in these cells, about


@dataclass(frozen=True)
class StackNumbers:
    """Masks of a leaf as they are compared."""

    blur_px: float = 0.8  # chosen: Gaussian that blurs masks, so that their edges are smooth functions of the position
    margin: int = 24  # limit: pixels of a crop around its mask
    large_px: float = 60.0  # limit: root of the median area of masks that are not made smaller
    long_px: int = 400  # limit: longest side of a mask that is not made smaller
    edge_samples: int = 40  # limit: samples of the edge of a mask, about


@dataclass(frozen=True)
class StartNumbers:
    """Rough patches to start a fit from, and the axes that they are given in."""

    most_points: int = 1000  # limit: voxels that are used; enough for nine windows
    num_windows: int = 9  # limit: windows along the leaf, whose middles the midrib of a start goes through
    window: float = 0.75  # chosen: reach of a window that the directions of the sides come from, in windows
    fewest: int = 4  # limit: voxels that a window needs; with fewer, the nearest ones stand in
    nearest: int = 8  # limit: so many of them
    trimmed: float = 0.005  # chosen: share of the voxels at either end of a leaf that its length leaves out
    widest: float = 0.93  # chosen: quantile of the distances from the midrib that is half the width
    smooth: float = 0.3  # chosen: weight of second differences of a start's coefficients
    neighbours: int = 8  # limit: others that a voxel is joined to, where the way along a leaf is looked for
    elongated: float = 2.0  # chosen: ratio of the two largest deviations of a leaf, from which its axis may be a curve
    bent: float = 1.35  # chosen: or of the way along it to the straight one: graphs make detours of a tenth
    turns_deg: tuple[float, ...] = (0.0, 90.0, 45.0, 135.0)  # chosen: angles about the midrib of the starts' sides
    # Masks of a pixel have flat hulls, or hulls of a few voxels.
    thinnest: float = 0.01  # limit: min. width of a start in its lengths, and length in deviations of the cloud
    flat: float = 1e-3  # chosen: part of a direction out of the cameras' plane, up to which a leaf lies in it


@dataclass(frozen=True)
class PriorNumbers:
    """Standard deviations of the prior: bend, sway and speed in leaf lengths, the rest in half-widths."""

    bend_sd: float = 0.06  # chosen: third differences of m
    sway_sd: float = 0.1  # chosen: times length / width: turns of the midrib within the blade, piece to piece
    speed_sd: float = 0.05  # chosen: differences of the speed along a piece of the midrib from one length in all
    side_sd: float = 1.0  # chosen: second differences of Q
    normal_sd: float = 0.35  # chosen: R and S along the normal
    fold_step_sd: float = 0.2  # chosen: differences of R
    shear_sd: float = 0.15  # chosen: Q along the midrib, and R and S within the blade
    num_pieces: int = 10  # chosen: pieces of the midrib, for sway and speed
    step: float = 0.02  # limit: distance in u over which the direction of the midrib is a difference
    pointed: float = 1e-3  # limit: weight of the mean side vector, which stands in at pointed ends


@dataclass(frozen=True)
class FitNumbers:
    """A patch moves until its outlines are those of the masks; pairs are of the first steps and of the last.

    Covariances were fitted (`python -m benchmarks.traits --cache DIR`, column "inside").
    """

    grid: tuple[int, int] = (36, 9)  # limit: rows and columns of points at which a patch is fitted and measured
    even: float = 0.3  # chosen: share of even spacing in the places of rows; the rest is denser at both ends
    far_grid: tuple[int, int] = (20, 5)  # limit: the same where it is still far from the masks
    num_steps: int = 7  # limit: steps from a start that is nearly right
    far_reach: float = 14.0  # chosen: pixels within which a sample looks for an edge, at first
    near_reach: float = 6.0  # chosen: the same in the end
    # chosen: damping of a step, and its longest way in half-widths, at first
    far_step: tuple[float, float] = (0.05, 0.25)
    near_step: tuple[float, float] = (0.005, 0.12)  # chosen: the same in the end
    sample_weight: float = 0.35  # chosen: weight of a sample: neighbouring samples are alike
    far_scale_px: float = 4.0  # chosen: distance that has half the weight of none, at first
    least_scale_px: float = 0.7  # chosen: the same in the end, at least
    scale_factor: float = 4.0  # chosen: the same in median distances, at least: masks may contradict each other
    offset_from: int = 6  # chosen: step from which masks may be too large or small
    offset_share: float = 0.8  # chosen: share of a measured offset that is believed
    clean_px: float = 1.0  # chosen: deviation of distances of clean masks; above, fold and curl stay near none
    narrow: float = 0.15  # chosen: min. width of half a leaf that limits steps, as a share of its length
    noisy_view: float = 1.5  # chosen: deviation of a view's distances from which it counts less, in the usual one
    sd_factor: float = 2.0  # chosen: factor of deviations
    difference: float = 1e-4  # limit: move of a coefficient for a derivative, as a share of the spread of all
    usual_px: float = 0.3  # chosen: min. median distance of the usual view of a leaf
    sd_of_median: float = 1.48  # definition: standard deviation of normal errors, in median absolute ones
    quiet_px: float = 0.3  # chosen: root mean square distance above which the factor is larger
    # Where masks are clean, little is measured.
    centre_factor: float = 1.5  # chosen: sd of the common offset of all masks, in the measured one
    least_free: float = 0.5  # chosen: min. views beyond two: with two, the offset of all masks is hardly known
    least_centre_sd: float = 0.1  # chosen: the same in pixels, at least
    # Leaves have 1e-4 and more; where nothing holds a patch in its place, rounding makes 1e-15.
    least_eigenvalue: float = 1e-10  # limit: least eigenvalue of a scaled normal matrix that is not singular


@dataclass(frozen=True)
class ImageNumbers:
    """A patch drawn as masks are."""

    supersampled: int = 3  # limit: small pixels along each side of a pixel that is drawn
    drawn_too_far: float = 0.48  # definition: pixels by which OpenCV widens polygons (test_outline.py)
    sub_pixel_bits: int = 4  # limit: corners of OpenCV's polygons are whole numbers of 1 / 2^4 pixels
    least_growth_px: float = 0.15  # limit: min. offset with which a patch is drawn: less is not worth the time
    drawn_beside: int = 4  # limit: pixels that the blurred image of a patch reaches beyond it
    near_px: int = 6  # chosen: distance from a leaf in which it matters what lies in front


@dataclass(frozen=True)
class OutlineNumbers:
    """Outlines of a patch and edges of masks."""

    beyond_px: tuple[float, ...] = (1.0, 2.0)  # chosen: distances from an edge at which another instance begins
    # Filled quads are half a pixel too wide.
    outside_px: float = 1.6  # chosen: distance from a sample on the outline of a pixel that the patch does not cover
    reverse_weight: float = 0.5  # chosen: weight of samples of the masks' edges, where that of the patch's is 1
    pull_from_px: float = 4.0  # chosen: distance outside of the patch from which an edge pulls at its nearest sample
    similar: float = 0.5  # chosen: min. cosine between the normals of two samples that match
    near_steps: int = 3  # limit: steps of a pixel to either side where an edge is looked for first: most are there
    most_shift_px: float = 5.0  # chosen: max. distance between the outline of a patch and the edge of its image


@dataclass(frozen=True)
class SearchNumbers:
    """The search for the best fit of each leaf."""

    first_steps: int = 3  # limit: steps of the fit before the second one
    most_views: int = 20  # limit: views of an instance that a fit looks at; more only add time
    few_masks: int = 60  # limit: masks below which they are fitted in this process: others would take longer to start
    at_once: int = 8  # limit: instances whose starts are searched side by side
    searched_views: int = 12  # limit: views of a leaf in which starts are compared, evenly spread
    most_starts: int = 3  # limit: max. starts of each hull that are tried
    most_fits: int = 3  # limit: starts that are fitted, but for rough fits
    clear_iou: float = 0.75  # chosen: median IoU of the likely start from which a rough fit tries no other one
    least_gain: float = 0.03  # chosen: IoU by which another start must be better, for a rough fit to take it
    good_iou: float = 0.93  # chosen: median IoU of a patch above which the second hull is not asked
    forgiven: float = 0.5  # chosen: share of IoU given back where all masks are too large or too small
    as_good: float = 0.03  # chosen: IoU below the best one down to which fits are as good, the less the more they lack
    area_cost: float = 0.1  # chosen: IoU that a surface e times as large loses: bulges hide behind outlines
    wide_cost: float = 0.1  # chosen: IoU that a patch wider than long loses: some would run from edge to edge
    hopeless: float = 0.1  # chosen: IoU below the best one from which a patch goes no farther than half way
    wrong_share: float = 0.25  # chosen: share of the hull in a mask, relative to the median one, of another leaf
    behind: float = 0.03  # chosen: distance of a neighbour that lies behind, as a share of the leaf's length


@dataclass(frozen=True)
class QualityNumbers:
    """When a surface is doubted."""

    least_iou: float = 0.8  # chosen: min. median IoU; below it, a surface is doubted
    credible_iou: float = 0.7  # chosen: median IoU from which measures are given; buds, fruit and stems have less
    most_area_share: float = 0.1  # chosen: max. deviation of the area, as a share of it; above, it is doubted
    # A patch fills the bays of a star: 2.5 % of it lie there, of leaves, hearts and rectangles 0.5 % at most.
    most_unshown: float = 0.02  # chosen: share of its area that is hardly in any mask, above which it is doubted
    # The midrib ends in a corner: rectangles have 0.9 there, discs and hearts 0.4, leaves 0.3.
    near_end: float = 0.02  # chosen: distance from an end where its width is measured, as a share of its length
    blunt: float = 0.7  # chosen: width there, as a share of the greatest, above which it is doubted


@dataclass(frozen=True)
class OccupancyNumbers:
    """Occupancy of a sheet. Errors are those of areas of the palms and ferns in docs/traits.md."""

    cells: tuple[int, int] = (128, 64)  # limit: rows and columns of cells of the sheet
    vote_error: float = 0.2  # chosen: chance that a view that faces a cell is wrong about it; 0.1 is worse by 0.5 %
    # Simulated simple leaves have 0.88 and more with exact masks; with faulty ones, occupancy explains them no better.
    explained: float = 0.87  # chosen: median IoU of a patch from which it is the leaf as it is
    least_gain: float = 0.01  # chosen: IoU by which occupancy must explain the masks better than the patch
    sheet_share: float = 0.7  # fitted: python -m benchmarks.traits --areas PALM; of the patch's deviation of the area
    edge_px: float = 0.5  # definition: masks may hold, or lack, the pixels that outlines cross


@dataclass(frozen=True)
class ErrorNumbers:
    """How the masks of a segmenter err."""

    rounds: int = 4  # limit: times that the offsets and their density are found in turn
    least_masks: int = 20  # limit: min. masks from which errors are learnt
    least_spread_px: float = 0.3  # chosen: deviation of their sizes below which they are clean
    measured_px: float = 0.2  # chosen: standard deviation of the measured offset of one mask
    step_px: float = 0.05  # limit: steps at which a density is given
    floor: float = 1e-3  # limit: min. density per pixel: any mask may be wrong in another way


@dataclass(frozen=True)
class StemNumbers:
    """Numbers that tell the base of a leaf from its tip, and stems from leaves."""

    least_leaves: int = 4  # limit: leaves from which the stem is looked for
    clear: float = 0.25  # chosen: share of the length by which the base is nearer to the stem than the tip, to be sure
    rounds: int = 5  # limit: rounds of fitting the stem to the bases
    sides: int = 12  # definition: of a stem that is drawn
    # Of 27 plants (basils, muskmelons, `benchmarks/unruly_plants.py`) no leaf had more than 2.6, no stem less than 2.9.
    stem_aspect: float = 2.75  # chosen: length over width, in the median of the plant, where stems begin
    aspect_scale: float = 0.025  # chosen: logistic scale of its logarithm around that


@dataclass(frozen=True)
class AxisNumbers:
    """The axis that leaves point back to, in lengths of the leaf, or of the median leaf."""

    least_leaves: int = 3  # limit: leaves that tell an axis, or are joined by paths of thin parts
    least_of_many: int = 4  # chosen: leaves that tell one of several axes
    most_pairs: int = 200  # limit: pairs of ends of leaves through which lines are tried
    most_starts: int = 3  # limit: of all lines that are tried, those that a fit starts from
    bent_leaves: int = 5  # chosen: leaves from which the axis may bend
    begins: float = 0.15  # chosen: share of the midrib that tells in which direction it begins
    lever: float = 0.2  # chosen: share of the midrib where the azimuth of a leaf is measured
    longest_petiole: float = 0.8  # chosen: max. length of a petiole
    petiole_cost: float = 0.05  # chosen: distance from the axis that a longer petiole is worth, in its length
    least_petiole: float = 0.01  # limit: length of a petiole below which the axis may not go on along its ray
    to_bases: float = 0.05  # chosen: weight of the distance of the axis along a ray, where that beside it is 1
    petiole_square: float = 0.1  # chosen: weight of squared lengths of petioles against distances of their rays
    arch_deg: float = 7.0  # fitted: python -m benchmarks.stems (of a petiole's chord to its end at the blade)
    near: float = 0.12  # chosen: distance of a ray from the axis that has half the weight of none
    near_share: float = 0.6  # chosen: min. share of the leaves that are nearer than this
    least_extent: float = 2.5  # chosen: min. distance between the outer nodes, in median petioles or misses
    least_miss: float = 0.05  # chosen: what counts as a petiole or a miss, at least
    lean_cost: float = 1.0  # chosen: cost of a level axis per leaf, where that of a leaf that misses it is 1
    tilt_cost: float = 0.02  # chosen: weight against a tilt in a round, where that of a leaf is 1
    bend_cost: float = 0.2  # chosen: weight against a bend
    beyond: float = 0.25  # chosen: by how much an axis goes on beyond its nodes, in its lengths
    points: int = 40  # limit: points of an axis
    ray_steps: int = 17  # limit: points of a ray, and again between two of these
    rounds: int = 14  # limit: rounds of fitting the axis, a straight one in the first half


@dataclass(frozen=True)
class ThinNumbers:
    """Thin parts in photos, cells of space that show them, and the path through them."""

    longest_px: int = 500  # chosen: max. longer side of the part of a photo with the plant
    margin: float = 0.25  # chosen: what is looked at around the plant, as a share of its image
    beside_px: int = 2  # chosen: distance from a mask within which a leaf may still hide something
    around_px: int = 15  # chosen: distance to what is around a thin part: it is less wide than this
    quiet: float = 2.0  # chosen: difference in colour that means nothing, in the median one
    surely: float = 4.0  # chosen: difference above that which is sure, in the median one
    least_apart: float = 6.0  # chosen: the same in steps of L, a and b, at least
    beyond: float = 0.15  # chosen: how far cells reach beyond the leaves, in the extent of these
    coarse_cells: int = 32  # limit: cells along the plant, at first
    levels: int = 3  # limit: times that cells are looked at; they are halved in between
    least_share: float = 0.7  # chosen: min. mean share of the views that show a cell as thin
    least_views: int = 3  # limit: min. views that see a cell
    view_share: float = 0.35  # chosen: the same as a share of all views
    around_cells: int = 17  # chosen: side of the cube in which a part is thin or thick, in cells
    most_filled: float = 0.2  # chosen: max. share of this cube that shows a thin part
    most_cells: int = 20_000  # limit: cells through which a path is looked for
    gap_cells: float = 2.0  # limit: longest step between all cells, in cells
    bridge_cells: float = 16.0  # chosen: longest step between some of the cells, across what leaves hide, in cells
    cube_cells: float = 3.0  # limit: side of the cubes of which one cell each has such steps, in cells
    gap_power: float = 1.5  # chosen: exponent of the cost of a step's length
    doubt_cost: float = 4.0  # chosen: cost of a cell that no view shows, in that of a sure one
    touch_cells: float = 8.0  # chosen: max. distance between a leaf and the cell where its petiole ends
    touch_cost: float = 30.0  # chosen: cost of entering or leaving a leaf: paths do not run through leaves
    least_steps: int = 6  # chosen: min. cells of a line
    line_ends: int = 60  # limit: cells of which any two are tried as points of the line of a stem
    line_cells: float = 2.0  # chosen: distance from the line that has half the weight of none, in cells
    line_rounds: int = 6  # limit: rounds of fitting the line
    line_beyond: float = 0.6  # chosen: how far petioles may leave the line beyond its ends, in its length
    cone: float = 0.12  # chosen: sine of the angle by which a stem may bend beyond its line
    bend_cost: float = 2.0  # chosen: weight against a bend of the line, in that of a cell


RAYS = RayNumbers()
VOXELS = VoxelNumbers()
HULL = HullNumbers()
STACK = StackNumbers()
STARTS = StartNumbers()
PRIOR = PriorNumbers()
FIT = FitNumbers()
IMAGE = ImageNumbers()
OUTLINE = OutlineNumbers()
SEARCH = SearchNumbers()
DOUBTS = QualityNumbers()
OCCUPANCY = OccupancyNumbers()
ERRORS = ErrorNumbers()
STEM = StemNumbers()
AXES = AxisNumbers()
THIN = ThinNumbers()
