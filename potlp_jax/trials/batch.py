"""Many trials in one compiled program: observe, decide and advance as one step over the arrays of all slots.

A slot holds one running trial. Whenever a trial ends, its slot is given the next one, so that none stays idle while
there is work; whatever their tasks and starts, trials of one policy, configuration and array shape share one
compilation. A trial takes the decisions of ``loop.run_trial`` with the same arguments; what it leaves behind is its
outcome and path, from which the rest can be made again. The step itself is in ``slots``.
"""

import dataclasses
import time
from collections.abc import Hashable, Iterable, Iterator
from functools import partial
from itertools import chain

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int32, PRNGKeyArray

from potlp_jax.errors import BatchError
from potlp_jax.learning.domain import Domain
from potlp_jax.learning.estimator import TrainedEstimator
from potlp_jax.learning.memory import PanoramaMemory
from potlp_jax.planning.estimates import Estimator
from potlp_jax.planning.policies import Policy, PolicyFunction, named_policy
from potlp_jax.precision import in_32_bits
from potlp_jax.task.propositions import require_same_propositions
from potlp_jax.task.task import TaskArrays
from potlp_jax.trials import rules
from potlp_jax.trials.config import TrialConfig, config_in
from potlp_jax.trials.record import Outcome
from potlp_jax.trials.slots import EMPTY, Asked, Progress, Scene, Setup, begin, step
from potlp_jax.world.grid import World
from potlp_jax.world.moves import length_of

SLOTS: int = 8
"""Trials that run at a time; what is best on a CPU (docs/sweeps.md)."""


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
            settings.

    Warns:
        PotlpWarning: the estimator given was made for other worlds.
    """
    policy = named_policy(policy)
    if slots < 1:
        raise BatchError(f"slots is {slots}, must be at least 1")
    starts = iter(starts)
    first = next(starts, None)
    if first is None:
        return
    _check_start(first, first)
    config = rules.config_of(policy, config_in(first.world, config))
    here = Domain.of_world(first.world, config.camera)
    asked = rules.estimator_of(policy, first.arrays.propositions, here, estimator)
    network = asked.config if isinstance(asked, TrainedEstimator) else None
    yield from _run(first, starts, Setup(policy=policy, config=config, network=network), slots, asked)


def _run(
    first: Start, others: Iterator[Start], setup: Setup, count: int, asked: TrainedEstimator | Estimator | None
) -> Iterator[Finished]:
    starts = chain([first], others)
    views, shared = None, asked
    if isinstance(asked, TrainedEstimator):
        # Parameters are the same in all slots; what a robot has seen is its own.
        views, shared = asked.start(*first.world.shape, setup.config.panoramas).memory, asked.params
    slots: tuple[Scene, Progress] = _empty_slots(first, views, setup, count)
    # Which trial is in which slot is the host's matter; the device knows slots alone.
    held: list[Start | None] = [None] * count
    seconds = np.zeros(count)
    while True:
        for slot in range(count):
            while held[slot] is None and (start := next(starts, None)) is not None:
                _check_start(start, first)
                slots = _fill(slots, jnp.int32(slot), start.world, start.arrays, start.key, views, setup=setup)
                held[slot], seconds[slot] = start, 0.0
        occupied = [slot for slot, start in enumerate(held) if start is not None]
        if not occupied:
            return
        # One call to the device runs all slots until one of them ends: as few round trips as there are trials.
        began = time.perf_counter()
        slots = _run_until_one_ends(slots, shared, setup=setup)
        # The only thing read back in every round; the rest only of slots that have ended.
        ended = ~np.asarray(slots[1].tally.running)
        # Slots run in one program: each is charged an equal share.
        seconds[occupied] += (time.perf_counter() - began) / len(occupied)
        for slot in occupied:
            start = held[slot]
            if ended[slot] and start is not None:
                yield _finished(start, slots[1], slot, float(seconds[slot]))
                held[slot] = None


def _check_start(start: Start, first: Start) -> None:
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
    for what in ("settings", "family"):
        mine, other = getattr(start.world, what), getattr(first.world, what)
        if mine != other:
            raise BatchError(f"trial {start.name!r}: its world has the {what} {mine}, the first of the batch {other}")
    # Another shape would compile anew in the middle of the batch, without a word: refused instead.
    for what, mine, other in (("world", start.world, first.world), ("task", start.arrays, first.arrays)):
        found, expected = ([leaf.shape for leaf in jax.tree.leaves(tree)] for tree in (mine, other))
        if found != expected:
            raise BatchError(
                f"trial {start.name!r}: its {what} has arrays of shapes {found}, the first of the batch {expected}; "
                "pad worlds with pad_world and tasks with Task.padded, or run them apart"
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


def _empty_slots(first: Start, views: PanoramaMemory | None, setup: Setup, count: int) -> tuple[Scene, Progress]:
    """Slots without trials, of the shape of ``first``."""
    # Any trial gives the shapes; its values never run, for the slot is marked empty.
    scene, progress = begin(first.world, first.arrays, first.key, views, setup=setup)
    progress = dataclasses.replace(progress, tally=dataclasses.replace(progress.tally, outcome=jnp.int8(EMPTY)))
    return jax.tree.map(lambda leaf: jnp.repeat(leaf[None], count, axis=0), (scene, progress))


@partial(jax.jit, static_argnames="setup", donate_argnums=0)
def _fill(
    slots: tuple[Scene, Progress],
    slot: Int32[Array, ""],
    world: World,
    arrays: TaskArrays,
    key: PRNGKeyArray,
    views: PanoramaMemory | None,
    *,
    setup: Setup,
) -> tuple[Scene, Progress]:
    # Donated: the arrays of all slots are changed in place instead of copied for each new trial.
    new = begin(world, arrays, key, views, setup=setup)
    return jax.tree.map(lambda leaf, entry: leaf.at[slot].set(entry), slots, new)


@partial(jax.jit, static_argnames="setup", donate_argnums=0)
def _run_until_one_ends(slots: tuple[Scene, Progress], asked: Asked, *, setup: Setup) -> tuple[Scene, Progress]:
    scene, progress = slots
    # Until fewer run than at the beginning: then a slot is free, and the host gives it a trial.
    running = jnp.sum(progress.tally.running)

    def all_still_run(now: Progress) -> Bool[Array, ""]:
        return (jnp.sum(now.tally.running) == running) & (running > 0)

    return scene, jax.lax.while_loop(all_still_run, partial(step, scene, asked, setup), progress)
