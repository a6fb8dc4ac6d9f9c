"""The rules of a trial, written once: keys, estimators, when a leg stops, when a trial ends (docs/model.md section 7).

The loop that drives a robot (``loop``), the batch of simulated trials (``batch``, ``slots``) and the replay of a log
(``logs.replaying``) all ask here. What both host and device need is a pure function on arrays: the batch calls it
inside its compiled step, the loop compiles it alone.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, ArrayLike, Bool, Float32, Int8, Int32, PRNGKeyArray, UInt32

from potlp_jax.checks import SEED
from potlp_jax.errors import ConfigurationError, PotlpError
from potlp_jax.learning.domain import Domain
from potlp_jax.learning.estimator import TrainedEstimator, estimator_for
from potlp_jax.learning.labels import TrueMapEstimator
from potlp_jax.planning.commitment import Intention
from potlp_jax.planning.estimates import Estimator
from potlp_jax.planning.move import Move, MoveKind
from potlp_jax.planning.policies import Policy, PolicyFunction
from potlp_jax.precision import in_32_bits
from potlp_jax.task.propositions import require_same_propositions
from potlp_jax.task.task import TaskArrays
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.record import Outcome
from potlp_jax.types import Status, status_array
from potlp_jax.world.grid import BeliefMap, World
from potlp_jax.world.moves import DIAGONAL, is_beside

STUCK_VISITS: int = 3
"""Decisions in the same cell, state and map after which a trial counts as stuck (docs/model.md section 7). Policies
decide once per change of the map, so that a second visit is already rare and a third means a cycle."""

OUTCOMES: tuple[Outcome, ...] = tuple(Outcome)
"""What ``Tally.outcome`` is an index into."""

# Below every index, and an ``EMPTY`` slot below it: neither is mistaken for an outcome.
RUNNING: int = -1
"""``Tally.outcome`` of a trial that goes on."""

_SATISFIED, _INFEASIBLE, _STUCK, _BUDGET = (
    OUTCOMES.index(outcome) for outcome in (Outcome.SATISFIED, Outcome.INFEASIBLE, Outcome.STUCK, Outcome.BUDGET)
)


# Keys. Each use of a trial's key is folded in by its own number, so that no draw depends on how often another is made.


@in_32_bits
def trial_key(world: int, seed: int = 0) -> PRNGKeyArray:
    """The key of every policy's trial in world number ``world``, in a sweep or alone; ``seed`` gives other draws.

    Raises:
        ConfigurationError: the seed is none: ``checks.SEED``.
    """
    if not SEED.allows(seed):
        raise ConfigurationError(f"the seed is {seed}; give {SEED.wanted}")
    # The implementation is named, so that no setting of jax changes what is drawn.
    return jax.random.fold_in(jax.random.key(seed, impl="threefry2x32"), world)


def planning_key(key: PRNGKeyArray) -> PRNGKeyArray:
    """What a trial's key becomes for the planner."""
    return jax.random.fold_in(key, 1)


def sensing_key(key: PRNGKeyArray) -> PRNGKeyArray:
    """What a trial's key becomes for the sensors."""
    return jax.random.fold_in(key, 2)


def decision_key(planning: PRNGKeyArray, index: ArrayLike) -> PRNGKeyArray:
    """The key of decision ``index`` of a trial whose ``planning_key`` is given."""
    return jax.random.fold_in(planning, index)


# What a policy knows.


def config_of(policy: Policy | PolicyFunction, config: TrialConfig) -> TrialConfig:
    """The settings of a trial in simulation: those given, on a revealed map for the policy that knows the map."""
    # The policy itself is the baseline's rule: on a revealed map that is the shortest path to the end of the task.
    return dataclasses.replace(config, revealed=True) if policy is Policy.KNOWN_MAP else config


def estimator_of(
    policy: Policy | PolicyFunction,
    propositions: tuple[str, ...],
    here: Domain,
    given: TrainedEstimator | Estimator | None,
) -> TrainedEstimator | Estimator | None:
    """The estimator that a policy asks, before anything was seen; the true map of ``oracle`` is not among them.

    Args:
        policy: ``potlp`` asks the one given, or the one that is shipped for the task and the worlds. A policy of the
            user's asks the one given, or none. The other policies ask none, whatever is given.
        propositions: of the task.
        here: the worlds.
        given: read from a file, or any pytree that can be called as an ``Estimator``; a plain function is made one.

    Returns:
        The estimator, or None where the policy asks none.

    Raises:
        EstimatorError: none is shipped for these propositions in these worlds.
        PropositionsError: a trained estimator knows other ones.

    Warns:
        PotlpWarning: a trained estimator was made for other worlds.
    """
    # The shipped one is read late, so that policies which ask nothing need none.
    asked = asked_of(policy, given)
    if isinstance(asked, TrainedEstimator) or (policy is Policy.POTLP and asked is None):
        return estimator_for(propositions, here, asked)
    return asked


@dataclasses.dataclass(frozen=True)
class _Callable:
    """A ``functools.partial`` as a function: a ``Partial`` of it alone would not be known by its function's name."""

    __wrapped__: Callable[..., Any]

    def __call__(self, *arguments: Any) -> Any:
        return self.__wrapped__(*arguments)


def asked_of(
    policy: Policy | PolicyFunction, given: TrainedEstimator | Estimator | None
) -> TrainedEstimator | Estimator | None:
    """As ``estimator_of``, without a default for ``potlp``: what is given where the policy asks for it."""
    if isinstance(policy, Policy) and policy is not Policy.POTLP:
        return None
    # A function is no pytree, nor is any other object that can be called, unless its class is one; as a ``Partial`` it
    # is one without leaves, and goes through jit.
    if not callable(given) or not jax.tree_util.all_leaves([given]):
        return given
    return jax.tree_util.Partial(_Callable(given) if isinstance(given, functools.partial) else given)


def first_estimator(
    policy: Policy | PolicyFunction,
    asked: TrainedEstimator | Estimator | None,
    shape: tuple[int, int],
    resolution: float,
    panoramas: int,
    world: World | None,
) -> Estimator | None:
    """What is called in the first decision of a trial, nothing seen yet.

    Args:
        policy: of the trial.
        asked: from ``estimator_of``.
        shape: rows and columns of the map.
        resolution: side of its cells in the unit of cost.
        panoramas: how many are remembered (``TrialConfig.panoramas``).
        world: the true map, which ``oracle`` asks; None where nobody knows it.

    Returns:
        A pytree that can be called inside jit, or None where the policy asks nothing.

    Raises:
        PotlpError: the policy is ``oracle`` and nobody knows the true map.
    """
    # The oracle is PO-TLP with the answers that the map itself gives (docs/model.md section 8).
    if policy is Policy.ORACLE:
        if world is None:
            raise PotlpError("policy oracle asks the true map: give it as world, or choose another policy")
        return TrueMapEstimator(world=world)
    return asked.start(*shape, panoramas, resolution) if isinstance(asked, TrainedEstimator) else asked


# When a robot that follows a path hands back control.


@struct.dataclass(kw_only=True)
class Stop:
    """When a robot that follows a path hands back control; ``is_due`` tells.

    Attributes:
        replan_distance: cells after which a changed map is worth a new decision. While nothing new is known there is
            nothing to decide: going on to the target is what makes every policy reach it (liveness).
        budget: cells that may still be travelled.
        is_frontier: the path ends at a frontier, so that there is nothing to see there once nothing unobserved is
            beside it.
    """

    replan_distance: Float32[Array, "*batch"]
    budget: Float32[Array, "*batch"]
    is_frontier: Bool[Array, "*batch"]

    def is_due(
        self,
        before: "Knowledge",
        belief: BeliefMap,
        target: Int32[Array, "2"],
        travelled: Float32[Array, ""],
    ) -> Bool[Array, ""]:
        """Whether to stop here, before or at ``target``. Pure, for host and device.

        Args:
            before: what was known at the decision.
            belief: what is known now.
            target: the cell where the path ends.
            travelled: cells since the decision.

        Returns:
            True where a new decision is due. That the path has ended is for the robot to know.
        """
        # docs/model.md section 7, "Advance": each line below is one of its reasons to decide again.
        now = Knowledge.of(belief)
        replans = (now.cells > before.cells) & (travelled >= self.replan_distance)
        # A proposition seen for the first time may be what the task is about: not to be passed by for four cells.
        surprised = (now.propositions & ~before.propositions) != 0
        # Whatever was to be seen from the target has been seen from cells before it.
        pointless = self.is_frontier & ~is_beside(belief.unknown, target, beyond=True)
        return replans | surprised | pointless | (travelled >= self.budget)


@struct.dataclass(kw_only=True)
class Knowledge:
    """How much a belief knows: what makes a new decision worth while is that this has grown.

    Attributes:
        cells: number of observed cells.
        propositions: bits of the propositions that hold at some observed cell.
    """

    cells: Int32[Array, "*batch"]
    propositions: Int32[Array, "*batch"]

    @staticmethod
    def of(belief: BeliefMap) -> "Knowledge":
        """Of one belief."""
        # Letters of unobserved cells are 0, so that all may be taken together.
        propositions = jax.lax.reduce(belief.letters, np.int32(0), jax.lax.bitwise_or, (0, 1))
        return Knowledge(cells=count_known(belief), propositions=propositions)


def count_known(belief: BeliefMap) -> Int32[Array, ""]:
    """Number of observed cells."""
    return jnp.sum(~belief.unknown, dtype=jnp.int32)


def stop_of(move: Move, tally: "Tally", belief: BeliefMap, config: TrialConfig) -> Stop:
    """When a robot that carries out a move hands back control.

    Args:
        move: the decision.
        tally: of the trial, before the move.
        belief: what is known at the decision; only its extent matters.
        config: of the trial.

    Returns:
        The conditions.
    """
    # To the end of the task, or of the known part of an optimistic path, the robot goes without a frontier in mind.
    is_frontier = (move.kind == MoveKind.ACTION) | (move.kind == MoveKind.FRONTIER) | (move.kind == MoveKind.FALLBACK)
    # Where the horizon cuts the path it ends on the way, where nothing was to be seen anyhow.
    is_frontier &= jnp.all(move.path.cells[move.path.length] == move.target_cell)
    return Stop(
        replan_distance=jnp.float32(config.replan_distance),
        # In float32 on host and device alike, so that a leg ends on the same cell in a trial and in a batch.
        budget=budget(belief, config) - tally.travelled,
        is_frontier=is_frontier,
    )


def overflows(move: Move) -> Bool[Array, "*batch"]:
    """Whether there were more frontiers at a decision than its array of subgoals holds.

    Such a decision is taken again with a longer array, if there may be one (``FrontierConfig.most_subgoals``).
    """
    # From the subgoals and not from the move's own bits, which a policy of the user's may set as it likes.
    return (move.subgoals.status & np.uint32(int(Status.SUBGOAL_OVERFLOW))) != 0


def budget(belief: BeliefMap, config: TrialConfig) -> Float32[Array, ""]:
    """Cells that may be travelled in a trial."""
    # By the extent, not the array: padding a map gives nobody more to travel.
    return jnp.float32(config.budget_factor) * jnp.sum(belief.extent).astype(jnp.float32)


# When a trial ends.


@struct.dataclass(kw_only=True)
class Tally:
    """What the rules count while a trial runs.

    Attributes:
        state: the automaton's state, the letter of the robot's cell read.
        straight, diagonal: moves made. Counts, so that the distance does not depend on the order of the moves.
        known: cells that were known at the last decision.
        visits: per cell and state, the decisions taken there since so many cells are known.
        decisions: number of decisions.
        fallbacks: decisions that fell back on the nearest frontier.
        status: bits of ``Status`` of all decisions.
        intention: the target that the robot is committed to.
        outcome: index into ``OUTCOMES``, or ``RUNNING``.
    """

    state: Int32[Array, "*batch"]
    straight: Int32[Array, "*batch"]
    diagonal: Int32[Array, "*batch"]
    known: Int32[Array, "*batch"]
    # A table, not a list of places: fixed in shape, so that it lives on the device.
    visits: Int8[Array, "*batch H W Z"]
    decisions: Int32[Array, "*batch"]
    fallbacks: Int32[Array, "*batch"]
    status: UInt32[Array, "*batch"]
    intention: Intention
    outcome: Int8[Array, "*batch"]

    @property
    def steps(self) -> Int32[Array, "*batch"]:
        """Moves made."""
        return self.straight + self.diagonal

    @property
    def travelled(self) -> Float32[Array, "*batch"]:
        """Cells travelled."""
        return self.straight.astype(jnp.float32) + self.diagonal.astype(jnp.float32) * jnp.float32(DIAGONAL)

    @property
    def running(self) -> Bool[Array, "*batch"]:
        """Whether the trial goes on."""
        return self.outcome == RUNNING


def first_tally(belief: BeliefMap, cell: Int32[Array, "2"], task: TaskArrays) -> Tally:
    """Of a trial that has not begun: the letter of the robot's first cell is read.

    Args:
        belief: the map after the first observation.
        cell: the robot's.
        task: over the map's propositions.

    Returns:
        The tally, with nothing spent.

    Raises:
        PropositionsError: belief and task are not over the same propositions.
    """
    # The first letter that a table of the task is asked about, in a batch and in an environment for learning too.
    require_same_propositions(task.propositions, belief.propositions, knower="the map")
    # The word begins with the letter of the first cell: a start may satisfy or violate the task.
    height, width = belief.cells.shape
    letter = belief.letters[cell[0], cell[1]]
    return Tally(
        state=task.transitions[task.initial, letter],
        straight=jnp.int32(0),
        diagonal=jnp.int32(0),
        known=jnp.int32(0),
        # A byte will do: a trial is stuck after three.
        visits=jnp.zeros((height, width, task.transitions.shape[0]), jnp.int8),
        decisions=jnp.int32(0),
        fallbacks=jnp.int32(0),
        status=status_array(),
        intention=Intention.none(),
        outcome=jnp.int8(RUNNING),
    )


def count_decision(tally: Tally, move: Move) -> Tally:
    """After a decision."""
    return dataclasses.replace(
        tally,
        decisions=tally.decisions + 1,
        fallbacks=tally.fallbacks + (move.kind == MoveKind.FALLBACK).astype(jnp.int32),
        status=tally.status | move.status,
        intention=move.intention,
    )


def arrive(
    tally: Tally,
    belief: BeliefMap,
    cell: Int32[Array, "2"],
    task: TaskArrays,
    gave_up: Bool[Array, ""],
    config: TrialConfig,
) -> Tally:
    """Where a decision would be taken: whether the trial ends here instead.

    Args:
        tally: with the moves that led here.
        belief: what is known here.
        cell: where the robot is.
        task: arrays of the task.
        gave_up: the policy knew no move (``MoveKind.NONE``) and the robot made none. A robot that moves nevertheless,
            as one in a log does, may come to where there is a move again.
        config: of the trial; static.

    Returns:
        The tally with this visit counted and the outcome set.
    """
    # Counted where decisions are taken, not along the path: a corridor may be passed as often as the task wants.
    here = (cell[0], cell[1], tally.state)
    known = count_known(belief)
    # A map that has changed is another situation: all visits begin anew.
    visits = jnp.where(known == tally.known, tally.visits, 0).astype(jnp.int8).at[here].add(jnp.int8(1))
    # From the weakest reason to the strongest: what is decided last is what counts.
    outcome = jnp.where(visits[here] >= STUCK_VISITS, _STUCK, RUNNING)
    outcome = jnp.where(tally.travelled >= budget(belief, config), _BUDGET, outcome)
    outcome = jnp.where(task.trap[tally.state], _INFEASIBLE, outcome)
    outcome = jnp.where(task.accepting[tally.state], _SATISFIED, outcome)
    outcome = jnp.where(gave_up, _INFEASIBLE, outcome)
    return dataclasses.replace(tally, known=known, visits=visits, outcome=outcome.astype(jnp.int8))
