"""The trained network as an estimator: what it is asked in a decision, and which one belongs to which worlds.

``TrainedEstimator`` is what is read from a file, on the host; ``NetworkEstimator`` is the pytree that a decision calls
inside jit, with the panoramas seen so far. Which propositions an estimator knows, and which worlds it serves, its file
says.
"""

import dataclasses
import functools
import hashlib
import math
import warnings
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float32, Int32, UInt8

from potlp_jax import plugins
from potlp_jax.errors import EstimatorError, PluginError, PotlpWarning
from potlp_jax.learning.domain import Domain
from potlp_jax.learning.memory import (
    PanoramaMemory,
    empty_memory,
    observation_of_subgoals,
    remember,
    slots_of_observations,
)
from potlp_jax.learning.network import EstimatorNetwork, NetworkConfig, Params
from potlp_jax.learning.serialization import load_estimator, require_propositions
from potlp_jax.planning.distances.product import product_distances
from potlp_jax.planning.estimates import Estimates, Estimator
from potlp_jax.task.task import TaskArrays
from potlp_jax.types import NO_STATE
from potlp_jax.world.camera import bearing
from potlp_jax.world.frontiers import Subgoals
from potlp_jax.world.grid import BeliefMap

QUESTIONS: int = 3
"""Classes that are asked of a subgoal at a time."""

SURE: float = 0.97
"""The most that the chances of subgoals side by side come to together."""


@struct.dataclass(kw_only=True)
class NetworkEstimator:
    """P_S, R_S and R_F from the panoramas seen so far (Bradley et al. 2021, section IV). ``config`` is static."""

    params: Params
    memory: PanoramaMemory
    config: NetworkConfig = struct.field(pytree_node=False)

    def __call__(self, belief: BeliefMap, subgoals: Subgoals, task: TaskArrays) -> Estimates:
        """Estimates of every real (subgoal, class); padded pairs have P_S = 0.

        At least one observation must be remembered.

        The network counts in the unit of the worlds that it learned from, which is the belief's: cells or metres.
        Subgoals are asked one after the other, of each so many classes at a time, so that padding costs little.

        Raises:
            PropositionsError: the network was trained for other propositions than the task's.
        """
        require_propositions(self.config, task.propositions, "the estimator's network")
        # Each subgoal is judged from the panorama in which it was last in sight, taken from where the robot then stood.
        places = slots_of_observations(self.memory, observation_of_subgoals(self.memory, subgoals))
        distance = self.distances(belief, subgoals)
        angle = jax.vmap(bearing)(self.memory.cells[places], subgoals.cells)
        classes = task.class_mask.shape[0]

        def ask(subgoal: Int32[Array, ""], answers: Float32[Array, "3 S C"]) -> Float32[Array, "3 S C"]:
            features = self.memory.features[places[subgoal]]
            found = self._ask_of_subgoal(features, angle[subgoal], distance[subgoal], task, answers[:, subgoal])
            return answers.at[:, subgoal].set(found)

        # Real subgoals come first, so the loop ends with the last of them: what padding would cost is the second stage
        # of the network, which is most of the work.
        real = jnp.sum(subgoals.mask, dtype=jnp.int32)
        nothing = jnp.stack(
            [jnp.zeros((subgoals.mask.shape[0], classes)), *[jnp.ones((subgoals.mask.shape[0], classes))] * 2]
        )
        probability, success_cost, failure_cost = jax.lax.fori_loop(0, real, ask, nothing)
        # Rows of masked subgoals keep P_S = 0 from the start; columns of masked classes may hold anything.
        probability = jnp.where(task.class_mask[None, :], probability, 0.0)
        return Estimates(
            success_probability=exclusive_chances(probability, subgoals, self.config.exclusive_within),
            success_cost=success_cost,
            failure_cost=failure_cost,
            # Sticky: once a panorama was dropped that showed a frontier, later estimates may be worse for it.
            status=self.memory.status,
        )

    def _ask_of_subgoal(
        self,
        features: Float32[Array, "rows columns F"],
        angle: Float32[Array, ""],
        distance: Float32[Array, ""],
        task: TaskArrays,
        answers: Float32[Array, "3 C"],
    ) -> Float32[Array, "3 C"]:
        """P_S, R_S and R_F of the real classes beyond one subgoal; ``answers`` keeps what it has of the others."""
        network, classes = EstimatorNetwork(self.config), task.class_mask.shape[0]
        centred = network.centre(features, angle, distance)
        repeated = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (QUESTIONS, *leaf.shape)), centred)
        # The features of a subgoal are the same for all of its classes, so they are broadcast once.
        # Real classes first; those that fill up the last portion are dropped where they are written.
        order = jnp.argsort(~task.class_mask, stable=True).astype(jnp.int32)
        # An index of ``classes`` is out of bounds, and mode="drop" ignores it.
        order = jnp.pad(order, (0, -classes % QUESTIONS), constant_values=classes)
        portions = -(-jnp.sum(task.class_mask, dtype=jnp.int32) // QUESTIONS)

        def ask(portion: Int32[Array, ""], answers: Float32[Array, "3 C"]) -> Float32[Array, "3 C"]:
            chosen = jax.lax.dynamic_slice_in_dim(order, portion * QUESTIONS, QUESTIONS)
            answer = network.answer(self.params, repeated, task.class_phi[chosen, 0], task.class_phi[chosen, 1])
            found = jnp.stack([answer.success_probability, answer.success_cost, answer.failure_cost])
            return answers.at[:, chosen].set(found, mode="drop")

        return jax.lax.fori_loop(0, portions, ask, answers)

    def distances(self, belief: BeliefMap, subgoals: Subgoals) -> Float32[Array, " S"]:
        """From where each subgoal was seen to the subgoal through known space, letters ignored, in the belief's unit.

        0 where masked, or where known space does not lead there.
        """
        poses = self.memory.cells[slots_of_observations(self.memory, observation_of_subgoals(self.memory, subgoals))]
        return _distances(belief, poses, subgoals)

    def observe(
        self, panorama: UInt8[Array, "rows columns 3"], belief: BeliefMap, cell: Int32[Array, "2"]
    ) -> "NetworkEstimator":
        """The estimator after an observation.

        Args:
            panorama: what the camera saw, in the frame of the map.
            belief: the map after the observation.
            cell: where the panorama was taken.

        Returns:
            The same estimator with one panorama more in memory.
        """
        features = EstimatorNetwork(self.config).encode(self.params, panorama)
        return dataclasses.replace(self, memory=remember(self.memory, features, belief, cell))


def exclusive_chances(chances: Float32[Array, "S C"], subgoals: Subgoals, within: float) -> Float32[Array, "S C"]:
    """P_S of subgoals side by side, raised so that, taken as independent, they fail together as rarely as they do.

    In fire-fighting buildings two frontiers within 16 cells of each other border the same place, and what is asked for
    is in one of its parts: both succeed in less than 1 % of the cases, and one of them does with about the sum of their
    chances (``eval.exclusion``). Eq. 3 takes attempts as independent. The logarithms of the chances to fail are scaled
    by a common factor, so that all subgoals ``within`` so many cells of one fail together with ``1 - sum``, at least
    ``1 - SURE``. With ``within`` 0 nothing is raised.

    Args:
        chances: P_S as the network answers it, in [0, 1].
        subgoals: where they are; masked ones neither raise others nor are raised.
        within: distance in cells between subgoals that exclude each other; static.

    Returns:
        P_S of the same shape, nowhere lower than ``chances``.
    """
    apart = subgoals.cells[:, None] - subgoals.cells[None, :]
    near = jnp.sum(apart**2, axis=2) <= math.floor(within**2)
    near = jnp.where(near & subgoals.mask[:, None] & subgoals.mask[None, :], 1.0, 0.0)
    # Logarithms of the chance to fail: a product over neighbours becomes a matrix product.
    # Kept off 1, where the logarithm is infinite.
    fails = jnp.log1p(-jnp.minimum(chances, jnp.float32(1.0 - 1e-6)))
    independent, together = near @ fails, jnp.log1p(-jnp.minimum(near @ chances, SURE))
    # Where no neighbour can succeed both logarithms are 0, and there is nothing to scale.
    factor = jnp.where(independent < 0.0, together / jnp.minimum(independent, -1e-12), 1.0)
    # Never below 1: subgoals that exclude each other do not make each other less likely.
    return -jnp.expm1(fails * jnp.maximum(factor, 1.0))


def _distances(belief: BeliefMap, poses: Int32[Array, "S 2"], subgoals: Subgoals) -> Float32[Array, " S"]:
    """From each pose to its subgoal through known space, letters ignored; 0 where masked."""
    # One automaton state for all free cells: letters do not matter for how far away something was seen.
    open_cells = jnp.where(belief.free, 0, NO_STATE).astype(jnp.int32)[:, :, None]
    states = jnp.where(subgoals.mask, 0, NO_STATE).astype(jnp.int32)
    fields = product_distances(open_cells, belief.free, poses, states, belief.resolution)
    count = jnp.arange(poses.shape[0], dtype=jnp.int32)
    distance = fields[count, subgoals.cells[:, 0], subgoals.cells[:, 1], 0]
    return jnp.where(jnp.isfinite(distance), distance, 0.0)


@dataclasses.dataclass(frozen=True)
class TrainedEstimator:
    """An estimator read from a file, for worlds of ``domain``. ``name`` and ``digest`` (of the file) identify it in
    records."""

    params: Params
    config: NetworkConfig
    domain: Domain
    metadata: Mapping[str, Any]
    name: str
    digest: str

    @property
    def identity(self) -> str:
        """Name and digest, as in records."""
        return f"{self.name} {self.digest}"

    def start(self, height: int, width: int, panoramas: int) -> NetworkEstimator:
        """The estimator for a new trial: nothing observed yet.

        Args:
            height, width: of the map's array.
            panoramas: how many are remembered.

        Returns:
            What a decision calls inside jit.
        """
        empty = empty_memory(panoramas, self.config.feature_shape, height, width)
        return NetworkEstimator(params=self.params, memory=empty, config=self.config)


observe_panorama = jax.jit(NetworkEstimator.observe)
"""``NetworkEstimator.observe`` compiled: one compilation per network and size of the map."""


@functools.lru_cache(maxsize=8)
def read_estimator(path: Path) -> TrainedEstimator:
    """Read an estimator. Raises EstimatorError where the file is none."""
    # A digest and not the name: two files of one name are two estimators in records.
    params, config, domain, metadata = load_estimator(path)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()[:12]
    return TrainedEstimator(
        params=params, config=config, domain=domain, metadata=metadata, name=path.stem, digest=digest
    )


def named_estimator(name: str | Path) -> TrainedEstimator | Estimator:
    """An estimator by the name that a command line or a sweep's file gives.

    Args:
        name: a file; or the name of a shipped one; or ``module:attribute``, or an entry point in the group
            ``potlp_jax.estimators``, of a ``TrainedEstimator``, of a function or other pytree that can be called as an
            ``Estimator``, or of a class without arguments whose objects can.

    Returns:
        The estimator.

    Raises:
        EstimatorError: there is no such file and none of that name is shipped, or the file is no estimator.
        PluginError: it cannot be imported, or is no estimator.
    """
    path = Path(name)
    # A file goes first: its name may well contain a colon.
    if path.is_file():
        return read_estimator(path)
    if str(name) in shipped_files():
        return read_estimator(shipped_files()[str(name)])
    if not plugins.is_known(str(name), plugins.ESTIMATORS):
        raise EstimatorError(
            f"there is no estimator {name}: give a file (potlp fit makes one), module:attribute, or the name of one "
            f"that is shipped: {', '.join(shipped_files())}"
        )
    found = plugins.load(str(name), group=plugins.ESTIMATORS, kind="estimator")
    estimator = found() if isinstance(found, type) else found
    if isinstance(estimator, TrainedEstimator):
        return estimator
    if not callable(estimator):
        raise PluginError(
            f"estimator {name}: {type(estimator).__name__} cannot be called with belief, subgoals and task"
        )
    # Its signature is checked when it is called.
    return cast(Estimator, estimator)


def identity_of(estimator: TrainedEstimator | Estimator) -> str:
    """What records and stores know an estimator by: name and digest of a file, ``module:attribute`` of a function."""
    if isinstance(estimator, TrainedEstimator):
        return estimator.identity
    # A plain function goes through jit as a ``Partial``, which is a pytree without leaves.
    return plugins.reference_of(estimator.func if isinstance(estimator, functools.partial) else estimator)


@functools.cache
def shipped_files() -> dict[str, Path]:
    """The files of the estimators that come with the package, by name."""
    folder = Path(str(resources.files("potlp_jax.learning"))) / "data"
    return {path.stem: path for path in sorted(folder.glob("*.npz"))}


def shipped_estimators() -> tuple[TrainedEstimator, ...]:
    """All that come with the package, by name."""
    # What an estimator knows and serves stands in its file, so a new shipped file needs no line of code.
    return tuple(read_estimator(path) for path in shipped_files().values())


def shipped_estimator(propositions: tuple[str, ...], here: Domain) -> TrainedEstimator | None:
    """The estimator that comes with the package for these propositions, in this order, and serves these worlds."""
    found = (
        estimator
        for estimator in shipped_estimators()
        if estimator.config.propositions == propositions and not estimator.domain.misfits(here)
    )
    return next(found, None)


def why_none_is_shipped(propositions: tuple[str, ...], here: Domain) -> str:
    """Why ``shipped_estimator`` finds none, in words: none knows the propositions, or those that do serve others."""
    knowing = [estimator for estimator in shipped_estimators() if estimator.config.propositions == propositions]
    if not knowing:
        return f"no estimator is shipped for the propositions {', '.join(propositions)}"
    reasons = {estimator.name: " and ".join(estimator.domain.misfits(here)) for estimator in knowing}
    return "; ".join(f"the shipped estimator {name} knows the propositions, but {why}" for name, why in reasons.items())


def estimator_for(
    propositions: tuple[str, ...], here: Domain, given: TrainedEstimator | None = None
) -> TrainedEstimator:
    """The estimator to use for a task in some worlds: the one given, else the shipped one that serves them.

    Args:
        propositions: of the task.
        here: the worlds.
        given: is used wherever it is asked for.

    Raises:
        EstimatorError: none is shipped for these.
        PropositionsError: the one given knows other propositions.

    Warns:
        PotlpWarning: the one given was made for other worlds.
    """
    estimator = shipped_estimator(propositions, here) if given is None else given
    if estimator is None:
        raise EstimatorError(
            f"{why_none_is_shipped(propositions, here)}: choose another policy, or name the estimator to ask "
            f"({', '.join(shipped_files())}, or one of your own: docs/estimator.md)"
        )
    require_propositions(estimator.config, propositions, f"estimator {estimator.name}")
    misfits = estimator.domain.misfits(here)
    if misfits:
        # From this one place, so that Python shows it once and not for every trial.
        warnings.warn(
            f"the estimator {estimator.name} is asked about worlds that it was not made for: {'; '.join(misfits)}",
            PotlpWarning,
            stacklevel=1,
        )
    return estimator
