"""A decision's starting point: known space as the planner sees it, and the planning problem that it poses.

References:
  Bradley et al., Learning and Planning for Temporally Extended Tasks in Unknown Environments, ICRA 2021, III-B.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.custom_batching import sequential_vmap
from jaxtyping import Array, Bool, Float32, Int32, UInt32

from potlp_jax.checks import COUNT, FLAG, NOT_NEGATIVE, POSITIVE, SHARE, as_python_numbers, require_fields
from potlp_jax.errors import ProblemError
from potlp_jax.planning.distances.product import (
    distance_table,
    product_distances,
    product_transitions,
    reachable_cells,
    reachable_states,
)
from potlp_jax.planning.estimates import Estimates
from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.planning.search.config import BestFirstConfig, UctConfig
from potlp_jax.planning.shapes import check_task, require_shapes
from potlp_jax.precision import whole_numbers
from potlp_jax.task.propositions import require_same_propositions
from potlp_jax.task.task import TaskArrays
from potlp_jax.types import NO_STATE, CellLike, StateLike, Status, status_if
from potlp_jax.world.frontiers import FrontierConfig, Subgoals, find_subgoals
from potlp_jax.world.grid import BeliefMap


@dataclasses.dataclass(frozen=True)
class DecisionConfig:
    """Settings of a decision.

    Attributes:
      frontiers: how frontiers become subgoals.
      search: which search, and its settings.
      dead_end_factor: times ``(H + W)`` times the resolution it is the cost of a dead end (docs/model.md).
      commitment: hysteresis: fraction of its expected cost by which another action must be cheaper before the robot
        switches to it. 0: it switches at once, as published. The default was chosen on validation worlds, against
        0, 30 % and fixed numbers of cells (docs/results/panorama.md, "Commitment").
      least_chance: share of the largest P_S of a class, among the subgoals in reach, below which a subgoal is no way to
        it (``worthwhile``). 0: all count, as published.
      irrevocable_last: an irrevocable move is made only on a known path to acceptance, or where no frontier can be
        reached without one (docs/model.md section 7). False: it is weighed like any other move.
      path_horizon: moves in the path of one decision, at most; None means ``4 (H + W)``.
    """

    frontiers: FrontierConfig = FrontierConfig()
    search: BestFirstConfig | UctConfig = BestFirstConfig()
    dead_end_factor: float = 4.0
    commitment: float = 0.15
    least_chance: float = 0.0
    irrevocable_last: bool = True
    path_horizon: int | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.search, BestFirstConfig | UctConfig):
            raise ValueError(f"search is {self.search!r}; give a BestFirstConfig or a UctConfig")
        require_fields(self, ("irrevocable_last",), FLAG, ValueError)
        require_fields(self, ("dead_end_factor",), POSITIVE, ValueError)
        require_fields(self, ("commitment",), NOT_NEGATIVE, ValueError)
        require_fields(self, ("least_chance",), SHARE, ValueError)
        if self.path_horizon is not None:
            require_fields(self, ("path_horizon",), COUNT, ValueError)
        as_python_numbers(self)

    def horizon(self, height: int, width: int) -> int:
        """Moves in the path of one decision on a map of this size."""
        return self.path_horizon if self.path_horizon is not None else 4 * (height + width)

    def grown(self) -> "DecisionConfig | None":
        """With the next longer array of subgoals, None where it is as long as it may become."""
        frontiers = self.frontiers.grown()
        return None if frontiers is None else dataclasses.replace(self, frontiers=frontiers)


@struct.dataclass(kw_only=True)
class Situation:
    """Known space as the planner sees it from the robot's product state.

    Attributes:
      belief: what is known of the map.
      task: arrays of the task.
      cell: the robot's row and column.
      state: the automaton's state, the letter of the robot's cell read.
      transitions: state after entering a cell in a state; ``NO_STATE`` where that is impossible or not permitted now
        (``DecisionConfig.irrevocable_last``), and from accepting states.
      distances: path cost from the robot to a cell in a state by such moves; inf where it is out of reach.
      all_transitions: as ``transitions``, with all moves that are possible.
      all_distances: as ``distances``, with all moves that are possible: the known path to acceptance may use them.
      subgoals: of the belief, nearest first.
      finish_cell: cell of the nearest accepting product state in known space.
      finish_state: its state.
      finish_cost: its path cost; inf where acceptance is out of reach.
      status: bits of ``types.Status`` that every move decided here reports: those of the subgoals and of the estimates,
        and ``INVALID`` where no decision can be taken from these inputs.
    """

    belief: BeliefMap
    task: TaskArrays
    cell: Int32[Array, "*batch 2"]
    state: Int32[Array, "*batch"]
    transitions: Int32[Array, "*batch H W Z"]
    distances: Float32[Array, "*batch H W Z"]
    all_transitions: Int32[Array, "*batch H W Z"]
    all_distances: Float32[Array, "*batch H W Z"]
    subgoals: Subgoals
    finish_cell: Int32[Array, "*batch 2"]
    finish_state: Int32[Array, "*batch"]
    finish_cost: Float32[Array, "*batch"]
    status: UInt32[Array, "*batch"]

    @property
    def is_valid(self) -> Bool[Array, "*batch"]:
        """False where the inputs hold something that is not allowed: no move follows from them."""
        return (self.status & np.uint32(int(Status.INVALID))) == 0

    def moves_for(self, finishes: Bool[Array, ""]) -> tuple[Float32[Array, "H W Z"], Int32[Array, "H W Z"]]:
        """Distances and transitions of the path to a target; ``finishes``: the target is acceptance itself."""
        distances = jnp.where(finishes, self.all_distances, self.distances)
        return distances, jnp.where(finishes, self.all_transitions, self.transitions)

    def with_status_of(self, estimates: Estimates | None) -> "Situation":
        """The situation with what the estimator reports."""
        if estimates is None or estimates.status is None:
            return self
        return dataclasses.replace(self, status=self.status | estimates.status)


def assess(
    belief: BeliefMap,
    cell: CellLike,
    state: StateLike,
    task: TaskArrays,
    config: FrontierConfig,
    irrevocable_last: bool = True,
) -> Situation:
    """Distances, subgoals and the path to acceptance from the robot's product state.

    Args:
      belief: what is known of the map.
      cell: the robot's cell, which the belief knows to be free.
      state: the automaton's state, the letter of the robot's cell read.
      task: arrays of the task.
      config: how frontiers become subgoals.
      irrevocable_last: as in ``DecisionConfig``; static.

    Returns:
      What every policy decides from.

    Raises:
      PropositionsError: belief and task are not over the same propositions; while tracing, under jit.
      ProblemError: cell, state or what the map says are no whole numbers, the task is not its arrays, or an array has
        another shape.
    """
    if not isinstance(task, TaskArrays):
        raise ProblemError(f"the task is a {type(task).__name__}; give its arrays, task.arrays")
    cell, state = whole_numbers(cell, "cell", ProblemError), whole_numbers(state, "state", ProblemError)
    _check_shapes(belief, cell, state)
    check_task(task)
    whole_numbers(belief.cells, "belief.cells", ProblemError)
    letters, resolution = whole_numbers(belief.letters, "belief.letters", ProblemError), belief.resolution
    belief = dataclasses.replace(belief, letters=letters, resolution=jnp.asarray(resolution, jnp.float32))
    # Every decision, of every policy, begins here: what follows reads letters with the task's tables.
    require_same_propositions(task.propositions, belief.propositions, knower="the belief")
    # Nothing remains to be done after acceptance: without moves of their own, accepting states need no sweep.
    moves = product_transitions(task, belief.letters, belief.free)
    transitions = jnp.where(task.accepting[None, None, :], NO_STATE, moves)
    distances = product_distances(transitions, belief.free, cell[None], state[None], belief.resolution)[0]
    # A frontier counts as reached in whatever state: the automaton may need another state than the nearest one.
    nearest = jnp.min(distances, axis=2)
    reachable = reachable_cells(belief.free, cell, jnp.isfinite(nearest))
    subgoals = find_subgoals(belief, reachable, nearest, config)
    # Where the task ends in known space, if it can.
    finish = jnp.where(task.accepting[None, None, :], distances, jnp.inf)
    finish_cell, finish_state = cell_and_state(jnp.argmin(finish.reshape(-1)), finish.shape)
    finish_cost = jnp.min(finish)
    permitted, within = transitions, distances
    if irrevocable_last:
        permitted, within = _revocable_first(
            transitions,
            distances,
            subgoals.frontier,
            finish_cost,
            belief.letters,
            belief.free,
            belief.resolution,
            cell,
            state,
            task.irrevocable,
        )
    return Situation(
        belief=belief,
        task=task,
        cell=cell,
        state=state,
        transitions=permitted,
        distances=within,
        all_transitions=transitions,
        all_distances=distances,
        subgoals=subgoals,
        finish_cell=finish_cell,
        finish_state=finish_state,
        finish_cost=finish_cost,
        status=subgoals.status | status_if(~_can_be_assessed(belief, cell, state, task), Status.INVALID),
    )


def _check_shapes(belief: BeliefMap, cell: Array, state: Array) -> None:
    """Raise ProblemError, while tracing, where map, cell and state are not those of one robot."""
    grid = jnp.shape(belief.cells)
    if len(grid) != 2:
        raise ProblemError(f"belief.cells has shape {grid}, expected ('H', 'W'): one map")
    expected = {
        "belief.letters": (belief.letters, grid),
        "belief.resolution": (belief.resolution, ()),
        "belief.extent": (belief.extent, (2,)),
        "cell": (cell, (2,)),
        "state": (state, ()),
    }
    require_shapes(expected, f"the map is {grid}")


# Under vmap the maps are taken one after the other, so that ``cond`` runs one branch only: a task without irrevocable
# moves pays for none, whatever stands beside it in a batch.
@sequential_vmap
def _revocable_first(
    transitions: Int32[Array, "H W Z"],
    distances: Float32[Array, "H W Z"],
    frontier: Bool[Array, "H W"],
    finish_cost: Float32[Array, ""],
    letters: Int32[Array, "H W"],
    free: Bool[Array, "H W"],
    resolution: Float32[Array, ""],
    cell: Int32[Array, "2"],
    state: Int32[Array, ""],
    irrevocable: Bool[Array, "Z L"],
) -> tuple[Int32[Array, "H W Z"], Float32[Array, "H W Z"]]:
    """Transitions and distances by revocable moves; by all moves where the former lead to nothing.

    Args:
      transitions: all moves that are possible.
      distances: by all moves.
      frontier: True on frontier cells.
      finish_cost: path cost to acceptance by all moves, inf where it is out of reach in known space.
      letters, free, resolution: of the belief; as plain arrays, because vmap puts marks in their place.
      cell, state: the robot's product state.
      irrevocable: of the task.

    Returns:
      Arrays of the same shapes.
    """

    def without() -> tuple[Array, Array]:
        masked = jnp.where(jnp.moveaxis(irrevocable[:, letters], 0, -1), NO_STATE, transitions)
        within = product_distances(masked, free, cell[None], state[None], resolution)[0]
        # Where acceptance is certain there is progress, too: it is what the task was explored for.
        leads_on = jnp.any(frontier[:, :, None] & jnp.isfinite(within)) | jnp.isfinite(finish_cost)
        return jnp.where(leads_on, masked, transitions), jnp.where(leads_on, within, distances)

    return jax.lax.cond(jnp.any(irrevocable), without, lambda: (transitions, distances))


def _can_be_assessed(
    belief: BeliefMap, cell: Int32[Array, "2"], state: Int32[Array, ""], task: TaskArrays
) -> Bool[Array, ""]:
    """Whether cell, state, letters and resolution are what the map and the task allow."""
    # An index out of range is clamped on the device, and would be answered as if it were another.
    states, letters = task.transitions.shape
    # No path begins in a cell that is not free: moves out of it would cut its own corners.
    height, width = belief.cells.shape
    is_cell = is_in_map(cell, belief) & belief.free[jnp.clip(cell[0], 0, height - 1), jnp.clip(cell[1], 0, width - 1)]
    is_state = (state >= 0) & (state < states) & task.state_mask[jnp.clip(state, 0, states - 1)]
    are_letters = jnp.all((belief.letters >= 0) & (belief.letters < letters))
    is_length = (belief.resolution > 0.0) & jnp.isfinite(belief.resolution)
    return is_cell & is_state & are_letters & is_length


def is_in_map(cells: Int32[Array, "*N 2"], belief: BeliefMap) -> Bool[Array, "*N"]:
    """Whether rows and columns lie in the array of the map."""
    height, width = belief.cells.shape
    row, column = cells[..., 0], cells[..., 1]
    return (row >= 0) & (row < height) & (column >= 0) & (column < width)


def planning_problem(situation: Situation, estimates: Estimates, config: DecisionConfig) -> PlanningProblem:
    """The dense problem of a situation: travel through known space, and what lies beyond each subgoal.

    Args:
      situation: known space, from the robot's product state.
      estimates: P_S, R_S and R_F of the situation's subgoals.
      config: ``dead_end_factor`` and ``least_chance`` matter.

    Returns:
      The unbatched problem.
    """
    task, subgoals = situation.task, situation.subgoals
    at_subgoals = situation.distances[subgoals.cells[:, 0], subgoals.cells[:, 1]]
    in_reach = subgoals.mask & jnp.any(jnp.isfinite(at_subgoals), axis=1)
    estimates = worthwhile(estimates, in_reach, config.least_chance)
    travel, finish = _subgoal_travel(situation, estimates)
    # The robot's node has its own state alone: no rollout is there in another.
    at_robot = jnp.arange(task.transitions.shape[0])[:, None, None] == situation.state
    robot_travel = jnp.where(at_robot & subgoals.mask[None, :, None], at_subgoals[None], jnp.inf)
    robot_finish = jnp.where(at_robot[:, 0, 0], situation.finish_cost, jnp.inf)
    belief = situation.belief
    # Of the map without padding, so that padding changes no result.
    size = jnp.sum(belief.extent).astype(jnp.float32)
    return PlanningProblem.from_arrays(
        task,
        travel=jnp.concatenate([travel, robot_travel[None]]),
        finish=jnp.concatenate([finish, robot_finish[None]]),
        success_probability=estimates.success_probability,
        success_cost=estimates.success_cost,
        failure_cost=estimates.failure_cost,
        # Without a state the problem is invalid too, so that nothing is chosen whatever the estimates say.
        dfa_state=jnp.where(situation.is_valid, situation.state, NO_STATE),
        subgoal_mask=subgoals.mask,
        dead_end_cost=config.dead_end_factor * size * belief.resolution,
    )


def worthwhile(estimates: Estimates, in_reach: Bool[Array, " S"], least_chance: float) -> Estimates:
    """The estimates without subgoals that are hardly a way to a class while there are far better ones in reach.

    The model takes attempts to be independent of each other, and adds up chances that are one: thirty dark rooms, each
    of which may have a second door to the one hallway that was not seen, are thirty chances to get there. Behind doors
    that the robot stands before, such chances cost little and are tried first; there is always a next one.

    A subgoal that the robot cannot get to is no measure of others: it is never tried, so that they would never count.

    Args:
      estimates: of every subgoal and class; masked entries may hold anything.
      in_reach: True on the real subgoals that a permitted move of the robot can lead to, in some state.
      least_chance: share of the largest P_S of a class among those in reach; below it P_S counts as 0.

    Returns:
      The estimates; the largest P_S of each class in reach is always left.
    """
    if least_chance == 0.0:
        return estimates
    chance = estimates.success_probability
    best = jnp.max(jnp.where(in_reach[:, None], chance, 0.0), axis=0, keepdims=True)
    kept = jnp.where(chance < jnp.float32(least_chance) * best, 0.0, chance)
    return dataclasses.replace(estimates, success_probability=kept)


def _subgoal_travel(
    situation: Situation, estimates: Estimates
) -> tuple[Float32[Array, "S Z S Z"], Float32[Array, "S Z"]]:
    """Costs from each subgoal in each state, after re-entering the subgoal's cell (docs/model.md section 5)."""
    task, subgoals = situation.task, situation.subgoals
    count, states = subgoals.mask.shape[0], task.transitions.shape[0]
    # From the unknown region a rollout comes back over the subgoal's cell, and reads its letter.
    # What a rollout does later costs what it is expected to cost, irrevocable moves too: only the move that is made now
    # is withheld.
    reentered = situation.all_transitions[subgoals.cells[:, 0], subgoals.cells[:, 1]]
    # Rollouts leave a subgoal only after an action there, so one where nothing can succeed needs no table. Nor does a
    # state that no re-entry leads to from where the automaton can still get, or an accepting one.
    promising = subgoals.mask & jnp.any(estimates.success_probability > 0.0, axis=1)
    own = jnp.arange(states, dtype=jnp.int32)
    ahead = jnp.where(reachable_states(task, situation.state)[None], reentered, NO_STATE)
    needed = jnp.any(ahead[:, :, None] == own[None, None, :], axis=1) & promising[:, None] & ~task.accepting[None]
    sources = jnp.where(needed, own[None, :], NO_STATE)
    travel, finish = distance_table(
        situation.all_transitions,
        situation.belief.free,
        task.accepting,
        jnp.repeat(subgoals.cells, states, axis=0),
        sources.reshape(-1),
        subgoals.cells,
        situation.belief.resolution,
    )
    travel = jnp.where(subgoals.mask[None, :, None], travel, jnp.inf).reshape(count, states, count, states)
    finish = finish.reshape(count, states)
    subgoal = jnp.arange(count)[:, None]
    # Where the letter of the subgoal's cell violates the task in a state, there is no path back in that state.
    exists = reentered != NO_STATE
    # An accepting re-entry satisfies the task at once: nothing remains to be paid.
    accepted = exists & task.accepting[reentered]
    finish = jnp.where(exists, jnp.where(accepted, 0.0, finish[subgoal, reentered]), jnp.inf)
    return jnp.where(exists[:, :, None, None], travel[subgoal, reentered], jnp.inf), finish


def nearest_frontier(situation: Situation) -> tuple[Int32[Array, "2"], Int32[Array, ""], Float32[Array, ""]]:
    """Nearest subgoal by product distance; where none can be reached, nearest frontier cell of any component."""
    cells, kept = situation.subgoals.cells, situation.subgoals.mask
    # Scattered into a grid, so that the nearest one and its state come out of one minimum.
    by_subgoal = jnp.full(situation.distances.shape, jnp.inf, jnp.float32)
    rows, columns = cells[:, 0], cells[:, 1]
    at_subgoals = jnp.where(kept[:, None], situation.distances[rows, columns], jnp.inf)
    by_subgoal = by_subgoal.at[rows, columns].min(at_subgoals)
    # Subgoals may be masked or out of reach, as where there are more than the array holds. A frontier cell then
    # still leads somewhere new.
    by_cell = jnp.where(situation.subgoals.frontier[:, :, None], situation.distances, jnp.inf)
    cost = jnp.where(jnp.isfinite(jnp.min(by_subgoal)), by_subgoal, by_cell)
    cell, state = cell_and_state(jnp.argmin(cost.reshape(-1)), cost.shape)
    return cell, state, jnp.min(cost)


def cell_and_state(index: Int32[Array, ""], shape: tuple[int, ...]) -> tuple[Int32[Array, "2"], Int32[Array, ""]]:
    """Cell and state of an index into a flattened [H, W, Z] array."""
    _, width, states = shape
    index = index.astype(jnp.int32)
    return jnp.stack([index // (width * states), (index // states) % width]), index % states
