"""Collects a dataset for the estimator from simulated buildings.

A robot drives through each world: a heuristic one that wanders (``recipes.exploration``), or a policy
(``recipes.policy_drives``): PO-TLP with an estimator that was trained before, so that the next one learns from the
states that it will meet. Now and then the panorama and the map are recorded, and for every subgoal and some outcome
classes, drawn from a distribution of tasks, the true P_S, R_S, R_F and the weights of the loss. ``docs/dataset.md``
describes the files. A collection that was interrupted continues where it stopped: what is recorded depends on the seed,
the split, the index of the world and the driver alone.
"""

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import Float32, UInt8

from potlp_jax import plugins
from potlp_jax.checks import AT_LEAST_ONE, require_fields
from potlp_jax.codec import json_copy
from potlp_jax.engine.engine import Broken, Engine, Here
from potlp_jax.engine.writer import only_writer
from potlp_jax.environments.base import Generator
from potlp_jax.environments.splits import Split, world_key
from potlp_jax.errors import DatasetError
from potlp_jax.learning.dataset import (
    Samples,
    finished_shards,
    read_metadata,
    remove_unfinished_files,
    write_shard,
)
from potlp_jax.learning.dataset_metadata import DatasetMetadata
from potlp_jax.learning.domain import unit_of
from potlp_jax.learning.estimator import TrainedEstimator, identity_of, named_estimator
from potlp_jax.learning.ideal_observer import IdealObserver, ideal_observer
from potlp_jax.learning.questions import HELD_OUT, TaskDistribution
from potlp_jax.learning.recording import (
    Recorder,
    RecordingConfig,
    draws_of_world,
    record_views,
    recording_metadata,
)
from potlp_jax.learning.sample_weights import WeightBounds
from potlp_jax.learning.scenes import Pose
from potlp_jax.planning.estimates import Estimator
from potlp_jax.planning.policies import Policy
from potlp_jax.recipes.exploration import Explorer, ExplorerConfig
from potlp_jax.recipes.policy_drives import policy_drives
from potlp_jax.task.task import Task
from potlp_jax.trials.config import trial_config_for
from potlp_jax.trials.loop import versions
from potlp_jax.trials.robot import photograph_after
from potlp_jax.world.camera import CameraConfig, Disturbance
from potlp_jax.world.grid import World, world_digest
from potlp_jax.world.moves import Cell
from potlp_jax.world.renderer import renderer_of


@dataclasses.dataclass(frozen=True, kw_only=True)
class CollectConfig(RecordingConfig):
    """What is recorded, and how the robot comes there.

    Attributes:
        first_world: index in the split of the first world; those of a second collection follow those of the first.
        worlds_per_shard: what is lost, at most, where a process is killed.
        disturbance: of the images.
        explorer: how the robot wanders; it pursues the tasks that the outcome classes are from.
        driver: ``explorer``, the robot that wanders; or the policy that drives.
        estimator: what the policy asks, by name or file (``named_estimator``); empty for a policy that asks none.
        drives: tasks that a policy pursues in a world, each from the start; the views are divided among them, and what
            one leaves over is the next one's.
        pursued: tasks that the wandering robot pursues in a world, in turn. One alone shapes what is known of the
            building as a trial does: who avoids a fire all the time sees what lies behind it and never goes there.
        posterior: buildings of the family, drawn among those that agree with what was seen, whose true labels' means
            are recorded; 0: the labels of the one building in which the robot is. Only of families that say what their
            worlds can be (``Generator.posterior``).
    """

    first_world: int = 0
    worlds_per_shard: int = 4
    disturbance: Disturbance = Disturbance()
    explorer: ExplorerConfig = ExplorerConfig()
    driver: Literal["explorer", "baseline", "potlp"] = "explorer"
    estimator: str = ""
    drives: int = 3
    pursued: int = 12
    posterior: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_fields(self, ("drives", "pursued", "worlds_per_shard"), AT_LEAST_ONE, DatasetError)
        if self.posterior < 0:
            raise DatasetError(
                f"posterior is {self.posterior}: give a number of buildings, or 0 for the labels of the robot's own"
            )
        if self.first_world < 0:
            raise DatasetError(f"first_world is {self.first_world}; worlds are numbered from 0")
        # An estimator that nobody asks would be named in the data set all the same.
        if self.estimator and self.driver != "potlp":
            raise DatasetError(f"the driver {self.driver} asks no estimator: give driver=potlp, or no estimator")


@dataclasses.dataclass(frozen=True)
class Collected:
    """Where a collection stands.

    Attributes:
        worlds, of: worlds done, of all.
        views: recorded since it was started.
        overflowed: of these, the views of maps with more subgoals than are recorded.
    """

    worlds: int
    of: int
    views: int
    overflowed: int = 0


@dataclasses.dataclass(frozen=True)
class _Job:
    """What the shards of a collection have in common; goes to other processes and machines."""

    generator: Generator
    split: Split
    config: CollectConfig
    metadata: DatasetMetadata
    # Itself, because another machine may not have its file.
    estimator: TrainedEstimator | Estimator | None


def collection_of(generator: Generator) -> CollectConfig:
    """What to record in worlds of a family: subgoals, panoramas and what the robot senses as its trials have them, and
    never the formulas it holds out.
    """
    # The estimator is asked about the subgoals of trials, on maps of their sensor, and looks through their camera: it
    # must learn from these.
    trials = trial_config_for(generator)
    frontiers = trials.decision.frontiers
    return CollectConfig(
        frontiers=frontiers,
        camera=trials.camera,
        disturbance=trials.disturbance,
        look_every=trials.look_every,
        explorer=ExplorerConfig(frontiers=frontiers, sensor=trials.sensor),
        # An estimator of one family serves all that look like it, so that it must not know their formulas either.
        held_out=HELD_OUT.get(generator.family or generator.name, ()),
    )


def collect(
    generator: Generator,
    environment: str,
    split: Split,
    worlds: int,
    folder: Path,
    config: CollectConfig,
    engine: Engine | None = None,
    tell: Callable[[Collected], None] = lambda collected: None,
) -> None:
    """Collect what is missing of ``worlds`` worlds of a split, from ``config.first_world`` on.

    Args:
        generator: where worlds come from.
        environment: the name that the dataset keeps of it.
        split: from which worlds; training and validation never share one.
        worlds: a multiple of ``config.worlds_per_shard``.
        folder: the dataset; may hold a part of it already.
        config: what is recorded.
        engine: does the work; this process by default. It makes the records, and this process writes them.
        tell: called at the start and after every shard.

    Raises:
        DatasetError: the folder holds a dataset with other metadata, another command collects into it, or ``worlds``
            does not fill whole shards.
        WorldError: ``config.posterior`` is asked of a family that does not say what its worlds can be.
    """
    shards = whole_shards(worlds, config.worlds_per_shard)
    # Before anything is made: a collection with other settings must not mix with what is there.
    metadata = dataset_metadata(generator, environment, split, config)
    estimator = named_estimator(config.estimator) if config.estimator else None
    folder.mkdir(parents=True, exist_ok=True)
    with only_writer(folder, DatasetError):
        _collect_missing(_Job(generator, split, config, metadata, estimator), shards, folder, engine or Here(), tell)


def _collect_missing(job: _Job, shards: int, folder: Path, engine: Engine, tell: Callable[[Collected], None]) -> None:
    """Record and write the shards that are not there."""
    size = job.config.worlds_per_shard
    finished = finished_shards(folder)
    # What is there was recorded with settings of its own; a dataset has one set of them.
    differences = read_metadata(folder).differences(job.metadata) if finished else []
    if differences:
        raise DatasetError(
            f"{folder} holds a dataset that was collected otherwise ({'; '.join(differences)}): continue with the same "
            "settings, or choose an empty folder"
        )
    if more := [shard for shard in finished if shard >= shards]:
        raise DatasetError(
            f"{folder} holds {(max(more) + 1) * size} worlds, more than the {shards * size} that are asked for: "
            "ask for as many, or choose an empty folder"
        )
    # Nobody else writes to the folder now, so temporary files are of processes that were killed.
    remove_unfinished_files(folder)
    # What is finished stays as it is; a larger number of worlds adds shards.
    missing = [shard for shard in range(shards) if shard not in finished]
    worlds = shards * size
    views, overflowed, done = 0, 0, worlds - len(missing) * size
    tell(Collected(done, worlds, views))
    for shard, found in engine.run(_recorded, job, missing):
        if isinstance(found, Broken):
            raise DatasetError(f"shard {shard} of {folder} cannot be collected: {found.error}")
        (recorder,) = found
        write_shard(folder, shard, recorder.worlds, recorder.views, recorder.samples, job.metadata)
        views, overflowed = views + len(recorder.views["view"]), overflowed + recorder.overflowed
        done += size
        tell(Collected(done, worlds, views, overflowed))


def whole_shards(worlds: int, size: int) -> int:
    """How many shards so many worlds fill. Raises DatasetError where a rest is left."""
    shards, rest = divmod(worlds, size)
    if rest or shards < 1:
        raise DatasetError(
            f"{worlds} worlds are no whole shards of {size} worlds: ask for {max(shards, 1) * size} worlds, or for "
            "other shards (worlds_per_shard)"
        )
    return shards


def dataset_metadata(generator: Generator, environment: str, split: Split, config: CollectConfig) -> DatasetMetadata:
    """What the shards of a collection share.

    Args:
        generator: where worlds come from; its first world tells the size and the unit.
        environment: the name that the dataset keeps of it.
        split: from which worlds.
        config: what is recorded.

    Returns:
        Metadata in which everything that decides what is recorded has a place, so that equal ones may be continued.
    """
    # All worlds of a family have one array shape and one resolution, so the first stands for all.
    world = generator.generate(world_key(split, 0, generator.name))
    resolution = float(world.resolution)
    # A path says less than what it leads to: another estimator of the same name would drive otherwise.
    asked = identity_of(named_estimator(config.estimator)) if config.estimator else ""
    return recording_metadata(
        dataclasses.replace(config, estimator=asked),
        WeightBounds.of_map(*world.shape, resolution),
        versions(),
        shape=world.shape,
        propositions=generator.propositions,
        environment=environment,
        family=world.family,
        generator=_described(generator, world, config.camera),
        split=split.value,
        unit=unit_of(resolution),
        resolution=resolution,
    )


def _described(generator: Generator, first: World, camera: CameraConfig) -> dict[str, Any]:
    """What makes the worlds and pictures what they are: configuration, first world, and the files of one's own code."""
    found = {} if generator.config is None else json_copy(dataclasses.asdict(generator.config))
    # Maps, labels and plans are read from files, whose names stay when they are edited.
    found["first_world"] = world_digest(first)
    own = {"source": generator, "renderer_source": renderer_of(camera)}
    digests = {name: plugins.source_digest(thing) for name, thing in own.items() if not plugins.is_ours(thing)}
    return found | {name: digest for name, digest in digests.items() if digest is not None}


def _recorded(job: _Job, shard: int) -> Iterator[Recorder]:
    """The rows of one shard."""
    tasks = TaskDistribution(job.generator.propositions, job.config.held_out)
    # The bounds from the metadata: of the family's first world, so that all shards share them.
    recorder = Recorder(shard, job.config, WeightBounds(**job.metadata.weights))
    first = job.config.first_world + shard * job.config.worlds_per_shard
    for index in range(first, first + job.config.worlds_per_shard):
        world = job.generator.generate(world_key(job.split, index, job.generator.name))
        _collect_world(recorder, world, index, tasks, job)
    yield recorder


def _collect_world(recorder: Recorder, world: World, index: int, tasks: TaskDistribution, job: _Job) -> None:
    """Drive through one world and record views."""
    config = job.config
    key = jax.random.fold_in(jax.random.key(config.seed), index)
    rng, pool = draws_of_world(config, job.split, index, tasks)

    def photograph(cell: Cell, step: int) -> UInt8[np.ndarray, "rows columns 3"]:
        at = np.asarray(cell, np.int32)
        return np.asarray(photograph_after(world, at, key, np.int32(step), config.camera, config.disturbance))

    recorder.add_world(world, index)
    # Half of the questions are of the tasks that are pursued: they are asked in the states that pursuing them leads to.
    pursued = pool[: config.pursued if config.driver == "explorer" else config.drives]
    asked = [*pool, *pursued * (len(pool) // len(pursued))]
    recorded = 0
    drives, count = _drives(world, index, pool, rng, job)
    for number, poses in enumerate(drives, start=1):
        # What the drives before left over is for those that follow.
        most = config.views_per_world * number // count - recorded
        recorded += record_views(
            recorder, world, poses, asked, rng, photograph, most=most, observer=_observer(world, index, job)
        )


def _observer(world: World, index: int, job: _Job) -> IdealObserver | None:
    """What gives the labels of a world, if it is not the world itself."""
    if not job.config.posterior:
        return None
    noise = jax.random.fold_in(jax.random.key(job.config.seed), index)
    key = world_key(job.split, index, job.generator.name)
    posterior = job.generator.posterior(key, noise, job.config.posterior)
    return ideal_observer(posterior, world, nearest=job.config.nearest)


def _drives(
    world: World, index: int, pool: Sequence[Task], rng: np.random.Generator, job: _Job
) -> tuple[Iterable[Iterable[Pose]], int]:
    """The drives through a world, and their number."""
    config = job.config
    if config.driver == "explorer":
        return [Explorer(world, pool[: config.pursued], rng, config.explorer).poses()], 1
    tasks, key = pool[: config.drives], jax.random.fold_in(jax.random.key(config.seed), index)
    usual = trial_config_for(world)
    # Maps and subgoals as they are recorded, also where a recipe names others than the family's.
    settings = dataclasses.replace(
        usual,
        sensor=config.explorer.sensor,
        decision=dataclasses.replace(usual.decision, frontiers=config.frontiers),
        camera=config.camera,
        disturbance=config.disturbance,
        look_every=config.look_every,
    )
    return policy_drives(world, tasks, Policy(config.driver), job.estimator, settings, key), len(tasks)


def summary(samples: Samples) -> str:
    """Size and balance of a dataset, in words."""
    # The mean and not the share of successes: with ``posterior`` a label is a share itself.
    success = samples.success
    views = len(samples.images)
    if not len(success):
        return f"{views} views, no samples"
    lines = [
        f"{views} views, {len(success)} samples ({len(success) / views:.1f} a view), {_mean(success)}",
        f"images: {np.mean([len(image) for image in samples.images]) / 1024:.1f} KiB each",
    ]
    # A proposition that is hardly ever asked for, or never found, will not be learned.
    for index, name in enumerate(samples.metadata.propositions):
        asked = samples.phi_go[:, index] > 0
        found = f", {_mean(success[asked])} there" if asked.any() else ""
        lines.append(f"{name}: asked for in {asked.mean():.1%} of samples{found}")
    return "\n".join(lines)


def _mean(success: Float32[np.ndarray, "N"]) -> str:
    return f"mean P_S {np.mean(success, dtype=np.float64):.3f}"
