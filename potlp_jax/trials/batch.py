"""Many trials in one compiled program: observe, decide and advance as one step over the arrays of all slots.

A slot holds one running trial. Whenever a trial ends, its slot is given the next one, so that none stays idle while
there is work; whatever their tasks and starts, trials of one policy, configuration and array shape share one
compilation. A trial takes the decisions of ``trial.run_trial`` with the same arguments; what it leaves behind is its
outcome and path, from which the rest can be made again. The step itself is in ``batch_step``.
"""

import dataclasses
import math
import time
from collections.abc import Hashable, Iterable, Iterator
from functools import partial
from itertools import chain

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int32, PRNGKeyArray

from potlp_jax.errors import BatchError
from potlp_jax.learning.estimator import TrainedEstimator
from potlp_jax.learning.memory import Views
from potlp_jax.learning.network import Params
from potlp_jax.planning.policies import Policy
from potlp_jax.task.task import TaskArrays
from potlp_jax.trials.batch_step import EMPTY, OUTCOMES, Progress, Rules, Scene, begin, step
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.record import Outcome
from potlp_jax.world.grid import World

SLOTS: int = 8
"""Trials that run at a time; what is best on a CPU (docs/sweeps.md)."""


@dataclasses.dataclass(frozen=True)
class Start:
    """A trial to run; ``arrays`` are its task's, ``key`` is that of ``run_trial``, ``name`` comes back with the result.

    All worlds of a batch have one shape (``grid.pad_world``), all tasks one size (``Task.padded``).
    """

    world: World
    arrays: TaskArrays
    key: PRNGKeyArray
    name: Hashable = None


@dataclasses.dataclass(frozen=True)
class Finished:
    """A trial that has ended. ``path`` has one cell per entry, the start first; ``cost`` is in the world's unit.

    ``seconds`` is its share of the time in which its slots ran.
    """

    name: Hashable
    outcome: Outcome
    cost: float
    path: Int32[np.ndarray, "steps 2"]
    decisions: int
    fallbacks: int
    status: int
    seconds: float


def run_batch(
    starts: Iterable[Start],
    policy: Policy | str,
    config: TrialConfig | None = None,
    *,
    slots: int = SLOTS,
    estimator: TrainedEstimator | None = None,
) -> Iterator[Finished]:
    """Run trials of ``policy``, ``slots`` at a time, and give each as soon as it has ended.

    ``starts`` is asked for the next trial whenever a slot is free, so it may decide late. ``estimator`` is what the
    policy ``potlp`` looks with.

    Raises:
        BatchError: a world or task has another shape than the first one, or ``potlp`` has no estimator.
    """
    policy = Policy(policy)
    if slots < 1:
        raise BatchError(f"slots is {slots}, must be at least 1")
    if (policy is Policy.POTLP) and estimator is None:
        raise BatchError("policy potlp needs an estimator (learning.estimator.estimator_for)")
    config = TrialConfig() if config is None else config
    if policy is Policy.KNOWN_MAP:
        config = dataclasses.replace(config, revealed=True)
    trained = estimator if policy is Policy.POTLP else None
    rules = Rules(policy=policy, config=config, network=None if trained is None else trained.config)
    yield from _run(iter(starts), rules, slots, trained)


def _run(starts: Iterator[Start], rules: Rules, count: int, trained: TrainedEstimator | None) -> Iterator[Finished]:
    first = next(starts, None)
    if first is None:
        return
    starts = chain([first], starts)
    views = None if trained is None else trained.start(*first.world.shape).views
    params = None if trained is None else trained.params
    slots: tuple[Scene, Progress] = _empty_slots(first, views, rules, count)
    held: list[Start | None] = [None] * count
    seconds = np.zeros(count)
    while True:
        for slot in range(count):
            while held[slot] is None and (start := next(starts, None)) is not None:
                _check_shapes(start, first)
                slots = _fill(slots, jnp.int32(slot), start.world, start.arrays, start.key, views, rules=rules)
                held[slot], seconds[slot] = start, 0.0
        occupied = [slot for slot, start in enumerate(held) if start is not None]
        if not occupied:
            return
        began = time.perf_counter()
        slots = _run_until_one_ends(slots, params, rules=rules)
        ended = ~np.asarray(slots[1].running)
        seconds[occupied] += (time.perf_counter() - began) / len(occupied)
        for slot in occupied:
            start = held[slot]
            if ended[slot] and start is not None:
                yield _finished(start, slots[1], slot, float(seconds[slot]))
                held[slot] = None


def _check_shapes(start: Start, first: Start) -> None:
    for what, mine, other in (("world", start.world, first.world), ("task", start.arrays, first.arrays)):
        found, expected = ([leaf.shape for leaf in jax.tree.leaves(tree)] for tree in (mine, other))
        if found != expected:
            raise BatchError(
                f"trial {start.name!r}: its {what} has arrays of shapes {found}, the first of the batch {expected}; "
                "pad worlds with pad_world and tasks with Task.padded, or run them apart"
            )


def _finished(start: Start, progress: Progress, slot: int, seconds: float) -> Finished:
    names = ("outcome", "straight", "diagonal", "path", "decisions", "fallbacks", "status")
    outcome, straight, diagonal, path, decisions, fallbacks, status = (
        np.asarray(getattr(progress, name)[slot]) for name in names
    )
    cells = int(straight) + int(diagonal) * math.sqrt(2.0)
    return Finished(
        name=start.name,
        outcome=OUTCOMES[int(outcome)],
        cost=cells * float(start.world.resolution),
        path=path[: int(straight) + int(diagonal) + 1].astype(np.int32),
        decisions=int(decisions),
        fallbacks=int(fallbacks),
        status=int(status),
        seconds=seconds,
    )


def _empty_slots(first: Start, views: Views | None, rules: Rules, count: int) -> tuple[Scene, Progress]:
    """Slots without trials, of the shape of ``first``."""
    scene, progress = begin(first.world, first.arrays, first.key, views, rules=rules)
    progress = dataclasses.replace(progress, outcome=jnp.int8(EMPTY))
    return jax.tree.map(lambda leaf: jnp.repeat(leaf[None], count, axis=0), (scene, progress))


@partial(jax.jit, static_argnames="rules", donate_argnums=0)
def _fill(
    slots: tuple[Scene, Progress],
    slot: Int32[Array, ""],
    world: World,
    arrays: TaskArrays,
    key: PRNGKeyArray,
    views: Views | None,
    *,
    rules: Rules,
) -> tuple[Scene, Progress]:
    new = begin(world, arrays, key, views, rules=rules)
    return jax.tree.map(lambda leaf, entry: leaf.at[slot].set(entry), slots, new)


@partial(jax.jit, static_argnames="rules", donate_argnums=0)
def _run_until_one_ends(
    slots: tuple[Scene, Progress], params: Params | None, *, rules: Rules
) -> tuple[Scene, Progress]:
    scene, progress = slots
    running = jnp.sum(progress.running)
    one_decision = partial(step, scene, params, rules)
    progress = jax.lax.while_loop(lambda now: (jnp.sum(now.running) == running) & (running > 0), one_decision, progress)
    return scene, progress
