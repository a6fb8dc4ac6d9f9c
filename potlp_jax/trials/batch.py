"""Many trials in one compiled program: observe, decide and advance as one step over the arrays of all slots.

A slot holds one running trial. Whenever a trial ends, its slot is given the next one, so that none stays idle while
there is work; whatever their tasks and starts, trials of one policy, configuration and array shape share one
compilation. A trial takes the decisions of ``loop.run_trial`` with the same arguments; what it leaves behind is its
outcome and path, from which the rest can be made again. The step itself is in ``slots``.

A trial that meets more frontiers than its array of subgoals holds leaves its slot. Once there are as many of these as
slots, or no others, they go on from where they are in slots with longer arrays: one compilation more for each length.
"""

import dataclasses
import time
from collections.abc import Hashable, Iterable, Iterator, Sequence
from functools import partial
from itertools import chain
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int32, PRNGKeyArray

from potlp_jax.checks import COUNT
from potlp_jax.compiling import jit_by_class
from potlp_jax.errors import BatchError
from potlp_jax.learning.domain import Domain
from potlp_jax.learning.estimator import TrainedEstimator, identity_of
from potlp_jax.learning.observing import ObservingEstimator
from potlp_jax.planning.estimates import Estimator
from potlp_jax.planning.policies import Policy, PolicyFunction, named_policy
from potlp_jax.precision import in_32_bits
from potlp_jax.task.propositions import require_same_propositions
from potlp_jax.task.task import TaskArrays
from potlp_jax.trials import rules
from potlp_jax.trials.config import TrialConfig, config_in
from potlp_jax.trials.record import Outcome
from potlp_jax.trials.robot import initial_belief
from potlp_jax.trials.slots import EMPTY, OUTGROWN, Asked, Progress, Scene, Setup, begin, step
from potlp_jax.world.grid import World
from potlp_jax.world.moves import length_of

SLOTS: int = 8
"""Trials that run at a time; what was best on a CPU."""


@dataclasses.dataclass(frozen=True)
class Start:
    """A trial to run. All worlds of a batch have one shape (``grid.pad_world``), all tasks one size (``Task.padded``).

    Attributes:
        world: the true map.
        arrays: of the task.
        key: as in ``run_trial``.
        name: comes back with the result.
    """

    world: World
    arrays: TaskArrays
    key: PRNGKeyArray
    name: Hashable = None


@dataclasses.dataclass(frozen=True)
class Finished:
    """A trial that has ended.

    Attributes:
        name: of its ``Start``.
        outcome: how it ended.
        cost: length of the path in the unit of the world's resolution.
        path: cells in order, the start first.
        decisions: number of decisions.
        fallbacks: decisions that fell back on the nearest frontier.
        status: bits of ``Status`` of all decisions.
        seconds: its share of the time in which the slots ran.
    """

    name: Hashable
    outcome: Outcome
    cost: float
    path: Int32[np.ndarray, "steps 2"]
    decisions: int
    fallbacks: int
    status: int
    seconds: float


@in_32_bits
def run_batch(
    starts: Iterable[Start],
    policy: Policy | PolicyFunction | str,
    config: TrialConfig | None = None,
    *,
    slots: int = SLOTS,
    estimator: TrainedEstimator | Estimator | None = None,
) -> Iterator[Finished]:
    """Run trials of one policy, several at a time, and give each as soon as it has ended.

    Args:
        starts: the trials. Asked for the next one whenever a slot is free, so that it may decide late.
        policy: one of the library's, or a function of one's own (``planning.policies.PolicyFunction``).
        config: settings, which all trials share; by default what their worlds call for.
        slots: trials that run at a time.
        estimator: what the policy asks, as in ``run_trial``.

    Returns:
        The trials in the order in which they end.

    Raises:
        PropositionsError: world, task and estimator of a trial are not over the same propositions, or are over others
            than the first trial of the batch.
        EstimatorError: no estimator is shipped for the first trial's task in its world.
        BatchError: a world or task has another shape than the first one, or its world is of another family or has other
            settings; or the memory of an estimator does not keep its shape.

    Warns:
        PotlpWarning: the estimator given was made for other worlds.
    """
    policy = named_policy(policy)
    if not COUNT.allows(slots):
        raise BatchError(f"slots is {slots}; give {COUNT.wanted}")
    starts = iter(starts)
    first = next(starts, None)
    if first is None:
        return
    _check_start(first, first)
    config = rules.config_of(policy, config_in(first.world, config))
    here = Domain.of_world(first.world, config.camera)
    asked = rules.estimator_of(policy, first.arrays.propositions, here, estimator)
    shared = _nothing_seen(asked, first.world, config)
    if not isinstance(asked, TrainedEstimator):
        _check_memory(shared, first.world, config)

    def checked(start: Start) -> Start:
        _check_start(start, first)
        return start

    trials = map(checked, chain([first], starts))
    yield from _run(trials, first, Setup(policy=policy, config=config), slots, shared)


def _nothing_seen(asked: TrainedEstimator | Asked, world: World, config: TrialConfig) -> Asked:
    """What is asked in the first decision of every trial of a batch."""
    if not isinstance(asked, TrainedEstimator):
        return asked
    return asked.start(*world.shape, config.panoramas, float(world.resolution))


def _check_memory(asked: Asked, world: World, config: TrialConfig) -> None:
    """Raise BatchError where a memory becomes other arrays: those of a slot stay what they are."""
    if not isinstance(asked, ObservingEstimator):
        return

    structures = []

    # Leaves, because classes of arrays refuse shapes in their place.
    def remember() -> list[Array]:
        seen = jnp.zeros((config.camera.height, config.camera.width, 3), jnp.uint8)
        memory = asked.remember(asked.encode(seen), initial_belief(world, config), world.start).memory
        leaves, structure = jax.tree.flatten(memory)
        structures.append(structure)
        return leaves

    leaves = jax.tree.leaves(asked.memory), jax.eval_shape(remember)
    kinds = [[(jnp.shape(leaf), jnp.result_type(leaf)) for leaf in found] for found in leaves]
    if jax.tree.structure(asked.memory) != structures[0] or kinds[0] != kinds[1]:
        raise BatchError(
            f"the memory of {identity_of(asked)} begins as {_as_text(kinds[0])} and is {_as_text(kinds[1])} after a "
            "picture: in a batch it needs all its arrays from the beginning"
        )


def _as_text(kinds: Sequence[tuple[tuple[int, ...], Any]]) -> str:
    return ", ".join(f"{kind}{list(shape)}" for shape, kind in kinds) or "nothing"


@dataclasses.dataclass(frozen=True)
class _Outgrown:
    """A trial that waits for a longer array of subgoals.

    Attributes:
        start: its start.
        content: of the slot that it has left, to be run again.
        seconds: its share of the time so far.
    """

    start: Start
    content: tuple[Scene, Progress]
    seconds: float


def _run(
    trials: Iterator[Start | _Outgrown], first: Start, setup: Setup, count: int, shared: Asked
) -> Iterator[Finished]:
    """Run trials in ``count`` slots, those that outgrow them in further slots of their own.

    Args:
        trials: asked for the next one whenever a slot is free.
        first: of the batch; gives the shapes.
        setup: of these slots.
        count: number of slots.
        shared: what the slots share of what the policy asks.

    Returns:
        The trials in the order in which they end.
    """
    # Parameters are the same in all slots; what a robot has seen is its own.
    memory = shared.memory if isinstance(shared, ObservingEstimator) else None
    slots: tuple[Scene, Progress] = _empty_slots(first, memory, setup, count)
    # Which trial is in which slot is the host's matter; the device knows slots alone.
    held: list[Start | None] = [None] * count
    seconds = np.zeros(count)
    waiting: list[_Outgrown] = []
    while True:
        for slot in range(count):
            while held[slot] is None and (trial := next(trials, None)) is not None:
                slots, held[slot], seconds[slot] = _enter(slots, slot, trial, memory, setup)
        occupied = [slot for slot, start in enumerate(held) if start is not None]
        # Not at the very end alone: trials that wait take memory as those in slots do.
        if waiting and (len(waiting) >= count or not occupied):
            grown = setup.grown()
            assert grown is not None
            yield from _run(iter(waiting), first, grown, count, shared)
            waiting = []
        if not occupied:
            return
        # One call to the device runs all slots until one of them ends: as few round trips as there are trials.
        began = time.perf_counter()
        slots = _run_until_one_ends(slots, shared, setup=setup)
        # The only things read back in every round; the rest only of slots that have ended.
        tally = slots[1].tally
        ended, outgrown = ~np.asarray(tally.running), np.asarray(tally.outcome) == OUTGROWN
        # Slots run in one program: each is charged an equal share.
        seconds[occupied] += (time.perf_counter() - began) / len(occupied)
        for slot in occupied:
            start = held[slot]
            if start is None or not ended[slot]:
                continue
            held[slot] = None
            if outgrown[slot]:
                waiting.append(_Outgrown(start, _taken_out(slots, jnp.int32(slot)), float(seconds[slot])))
            else:
                yield _finished(start, slots[1], slot, float(seconds[slot]))


def _enter(
    slots: tuple[Scene, Progress], slot: int, trial: Start | _Outgrown, memory: Any, setup: Setup
) -> tuple[tuple[Scene, Progress], Start, float]:
    """The slots with a trial in one of them, its start, and its share of the time so far."""
    if isinstance(trial, _Outgrown):
        return _put_back(slots, jnp.int32(slot), trial.content), trial.start, trial.seconds
    filled = _fill(slots, jnp.int32(slot), trial.world, trial.arrays, trial.key, memory, setup=setup)
    return filled, trial, 0.0


def _shown(value: Any) -> Any:
    return float(value) if isinstance(value, jax.Array) else value


def _check_start(start: Start, first: Start) -> None:
    if not isinstance(start.arrays, TaskArrays):
        raise BatchError(f"trial {start.name!r}: its arrays are a {type(start.arrays).__name__}; give Task.arrays")
    if jnp.asarray(start.key).dtype != jnp.asarray(first.key).dtype:
        raise BatchError(f"trial {start.name!r}: its key is of another kind than the first one's")
    asker = f"the task of trial {start.name!r}"
    require_same_propositions(start.arrays.propositions, start.world.propositions, asker=asker, knower="its world")
    # They are static parts of the arrays, as settings are: JAX could not put both into one batch, and would say so
    # obscurely.
    require_same_propositions(
        start.arrays.propositions,
        first.arrays.propositions,
        asker=asker,
        knower="that of the first trial of the batch",
        remedy="run trials over other ones in a batch of their own",
    )
    # An estimator that reads cells is started for cells of one size.
    for what in ("settings", "family", "resolution"):
        mine, other = (_shown(getattr(trial.world, what)) for trial in (start, first))
        if mine != other:
            raise BatchError(f"trial {start.name!r}: its world has the {what} {mine}, the first of the batch {other}")
    # Another shape would compile anew in the middle of the batch, without a word: refused instead.
    for what, mine, other in (("world", start.world, first.world), ("task", start.arrays, first.arrays)):
        found, expected = ([leaf.shape for leaf in jax.tree.leaves(tree)] for tree in (mine, other))
        if found != expected:
            mine, other = next(pair for pair in zip(found, expected, strict=True) if pair[0] != pair[1])
            raise BatchError(
                f"trial {start.name!r}: its {what} has an array of shape {mine}, and the first of the batch one of "
                f"{other}; pad worlds with pad_world and tasks with Task.padded, or run them apart"
            )


def _finished(start: Start, progress: Progress, slot: int, seconds: float) -> Finished:
    tally = progress.tally

    def number(counts: Array) -> int:
        return int(counts[slot])

    straight, diagonal = number(tally.straight), number(tally.diagonal)
    return Finished(
        name=start.name,
        outcome=rules.OUTCOMES[number(tally.outcome)],
        cost=length_of(straight, diagonal) * float(start.world.resolution),
        path=np.asarray(progress.path[slot])[: straight + diagonal + 1].astype(np.int32),
        decisions=number(tally.decisions),
        fallbacks=number(tally.fallbacks),
        status=number(tally.status),
        seconds=seconds,
    )


def _empty_slots(first: Start, memory: Any, setup: Setup, count: int) -> tuple[Scene, Progress]:
    """Slots without trials, of the shape of ``first``."""
    # Any trial gives the shapes; its values never run, for the slot is marked empty.
    scene, progress = begin(first.world, first.arrays, first.key, memory, setup=setup)
    progress = dataclasses.replace(progress, tally=dataclasses.replace(progress.tally, outcome=jnp.int8(EMPTY)))
    return jax.tree.map(lambda leaf: jnp.repeat(leaf[None], count, axis=0), (scene, progress))


@partial(jit_by_class, static_argnames=("setup",), donate_argnums=(0,))
def _fill(
    slots: tuple[Scene, Progress],
    slot: Int32[Array, ""],
    world: World,
    arrays: TaskArrays,
    key: PRNGKeyArray,
    memory: Any,
    *,
    setup: Setup,
) -> tuple[Scene, Progress]:
    # Donated: the arrays of all slots are changed in place instead of copied for each new trial.
    return _put_back(slots, slot, begin(world, arrays, key, memory, setup=setup))


@jit_by_class
def _taken_out(slots: tuple[Scene, Progress], slot: Int32[Array, ""]) -> tuple[Scene, Progress]:
    """The content of a slot whose trial has outgrown it; to be run again."""
    scene, progress = jax.tree.map(lambda leaf: leaf[slot], slots)
    tally = dataclasses.replace(progress.tally, outcome=jnp.int8(rules.RUNNING))
    return scene, dataclasses.replace(progress, tally=tally)


@partial(jit_by_class, donate_argnums=(0,))
def _put_back(
    slots: tuple[Scene, Progress], slot: Int32[Array, ""], content: tuple[Scene, Progress]
) -> tuple[Scene, Progress]:
    return jax.tree.map(lambda leaf, entry: leaf.at[slot].set(entry), slots, content)


@partial(jit_by_class, static_argnames=("setup",), donate_argnums=(0,))
def _run_until_one_ends(slots: tuple[Scene, Progress], asked: Asked, *, setup: Setup) -> tuple[Scene, Progress]:
    scene, progress = slots
    # Until fewer run than at the beginning: then a slot is free, and the host gives it a trial.
    running = jnp.sum(progress.tally.running)

    def all_still_run(now: Progress) -> Bool[Array, ""]:
        return (jnp.sum(now.tally.running) == running) & (running > 0)

    return scene, jax.lax.while_loop(all_still_run, partial(step, scene, asked, setup), progress)
