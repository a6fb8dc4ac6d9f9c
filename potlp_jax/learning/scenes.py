"""What there is to ask at a pose, and the answers: of the true map, or of an observer that knows what was seen.

A **pose** is where the robot stood and what it knew of the map; a **scene** the subgoals that it could be asked about
there. ``learning.recording`` makes rows of a dataset of them.
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32
from scipy import ndimage

from potlp_jax.compiling import jit_by_class
from potlp_jax.learning.ideal_observer import IdealObserver
from potlp_jax.learning.labels import TrueMapEstimator
from potlp_jax.learning.sample_weights import WeightBounds, Weights, loss_weights
from potlp_jax.planning.distances.product import grid_distances
from potlp_jax.planning.estimates import Estimates
from potlp_jax.task.task import TaskArrays
from potlp_jax.world.camera import bearing
from potlp_jax.world.frontiers import FrontierConfig, Subgoals, find_subgoals
from potlp_jax.world.grid import BeliefMap, World
from potlp_jax.world.moves import Cell
from potlp_jax.world.sensing import SensorConfig, visible


@dataclasses.dataclass(frozen=True)
class Pose:
    """Where the robot stands and what it knows.

    Attributes:
        belief: what it knows.
        cell: where it stands.
        step: cells entered so far.
        travelled: so far, in cells.
        way: cells entered since the pose before, ``cell`` not among them; none if there are no pictures.
    """

    belief: BeliefMap
    cell: Cell
    step: int
    travelled: float
    way: tuple[Cell, ...] = ()


@struct.dataclass(kw_only=True)
class Scene:
    """What there is to ask at a pose: the subgoals, D and bearing of each, and which are in the camera's view.

    All are ``asked`` about, but for those of a log that does not show what lies beyond.
    """

    subgoals: Subgoals
    asked: Bool[Array, " S"]
    distance: Float32[Array, " S"]
    bearing: Float32[Array, " S"]
    in_view: Bool[Array, " S"]


@partial(jax.jit, static_argnames="frontiers")
def survey(
    world: World, belief: BeliefMap, cell: Int32[Array, "2"], frontiers: FrontierConfig = FrontierConfig()
) -> Scene:
    """The subgoals of a belief by known-space distance, letters ignored. The camera sees without limit of range.

    Args:
        world: the true map: what is in the line of sight.
        belief: what the robot knows of it.
        cell: where the robot stands.
        frontiers: which components of the frontier are subgoals; static.

    Returns:
        What there is to ask at this pose.
    """
    distances = grid_distances(belief.free, cell, belief.resolution)
    subgoals = find_subgoals(belief, jnp.isfinite(distances), distances, frontiers)
    seen = visible(world.occupied, cell, SensorConfig(range_cells=float(sum(world.shape))))
    # A subgoal is in view where any cell of its frontier is.
    index = jnp.arange(subgoals.mask.shape[0], dtype=jnp.int32)[:, None, None]
    in_view = jnp.any((subgoals.component[None] == index) & seen[None], axis=(1, 2))
    return Scene(
        subgoals=subgoals,
        asked=subgoals.mask,
        distance=subgoals.distance,
        bearing=bearing(cell, subgoals.cells),
        in_view=in_view & subgoals.mask,
    )


@partial(jit_by_class, static_argnames=("bounds",))
def label(
    by: TrueMapEstimator | IdealObserver,
    belief: BeliefMap,
    scene: Scene,
    sheet: TaskArrays,
    bounds: WeightBounds,
) -> tuple[Estimates, Weights]:
    """Labels and weights of every (subgoal, question), also of subgoals out of view.

    Args:
        by: what answers: the true map, or an observer, by all that can be where the robot has not been.
        belief: what the robot knows of the map.
        scene: the subgoals.
        sheet: the questions (``question_sheet``).
        bounds: of the weights; static.

    Returns:
        Labels and weights, 0 where masked. The observer's have its status.
    """
    # Subgoals out of view are labelled too: missing one is cheap where another, seen or not, would do as well.
    labels = by(belief, scene.subgoals, sheet)
    mask = scene.subgoals.mask[:, None] & sheet.class_mask[None, :]
    return labels, loss_weights(scene.distance, labels, mask, bounds)


def is_answered(
    world: World, belief: BeliefMap, subgoals: Subgoals, unexplored: Bool[np.ndarray, "H W"]
) -> Bool[np.ndarray, " S"]:
    """Whether ``world`` answers all that can be asked about each subgoal; False where masked.

    Args:
        world: the final map of a drive, as far as it goes.
        belief: what was known at this pose.
        subgoals: of the belief.
        unexplored: free cells of ``world`` beyond which it is not known how the building goes on.

    Returns:
        False where one of them is on the subgoal's frontier, or can be reached from it through cells that ``belief``
        does not know: what lies beyond could be anything.
    """
    # Regions of free space that the belief does not know yet, numbered from 1; 0 is everything else.
    regions = np.zeros(unexplored.shape, np.int32)
    ndimage.label(np.asarray(belief.unknown) & ~np.asarray(world.occupied), output=regions)
    leads_on = np.unique(regions[unexplored])
    component, mask = np.asarray(subgoals.component), np.asarray(subgoals.mask)
    answers = np.zeros(mask.shape, bool)
    for subgoal in np.flatnonzero(mask):
        own = component == subgoal
        # The regions that touch the frontier are those that a robot enters through it.
        around = np.asarray(ndimage.binary_dilation(own), bool)
        open_beyond = np.isin(regions[around], leads_on[leads_on > 0])
        answers[subgoal] = not (np.any(unexplored & own) or np.any(open_beyond))
    return answers
