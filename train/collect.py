"""Collects a dataset for the estimator from simulated buildings.

    python -m train.collect --environment firefighting --split training --worlds 500 --out DIR --processes 2

A heuristic robot (``train/explorer.py``) wanders through each world. Now and then the panorama is recorded, and for
every subgoal in line of sight and some outcome classes, drawn from a distribution of tasks, the true P_S, R_S, R_F and
the weights of the loss. ``docs/dataset.md`` describes the files. The same command again continues where it stopped:
what is recorded depends on the seed, the split and the index of the world alone.
"""

import argparse
import dataclasses
import json
import multiprocessing
import os
import threading
import zlib
from collections.abc import Iterator, Sequence
from functools import partial
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pyarrow
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32
from tqdm import tqdm

from potlp_jax.cache import enable_compilation_cache
from potlp_jax.environments import Generator, make
from potlp_jax.environments.splits import Split, world_key
from potlp_jax.learning.dataset import (
    JPEG_QUALITY,
    SAMPLES_SCHEMA,
    VIEWS_SCHEMA,
    DatasetError,
    DatasetMetadata,
    Samples,
    encode,
    finished_shards,
    read_dataset,
    read_metadata,
    remove_unfinished_files,
    view_id,
    write_shard,
)
from potlp_jax.learning.formulas import HELD_OUT, Question, TaskDistribution, draw_questions, question_sheet
from potlp_jax.learning.labels import true_labels
from potlp_jax.learning.weights import WeightBounds, Weights, loss_weights
from potlp_jax.planning.estimates import Estimates
from potlp_jax.planning.product import grid_distances
from potlp_jax.task.task import TaskArrays
from potlp_jax.trial import versions
from potlp_jax.world.frontiers import FrontierConfig, Subgoals, find_subgoals
from potlp_jax.world.grid import BeliefMap, World
from potlp_jax.world.panorama import CameraConfig, Disturbance, bearing, disturb, render
from potlp_jax.world.sensing import SensorConfig, visible
from train.explorer import Explorer, ExplorerConfig, Pose

_FRONTIERS = FrontierConfig()


@dataclasses.dataclass(frozen=True)
class CollectConfig:
    """What is recorded.

    Attributes:
        seed: of everything but the worlds.
        worlds_per_shard: what is lost, at most, where a process is killed.
        views_per_world: at most.
        spacing: travelled between views: uniform, in cells, divided by the number of subgoals in view, so that most
            views are where there is most to choose.
        tasks_per_world: drawn for the robot to pursue and for the outcome classes.
        classes: outcome classes per view, at most; staying_sets: distinct sets of staying letters among them.
        held_out: formulas whose languages are never drawn.
        image_format, quality: of the encoded images: ``jpeg`` or ``png``; quality is JPEG's.
        camera, disturbance: the images.
        explorer: how the robot wanders.
    """

    seed: int = 0
    worlds_per_shard: int = 4
    views_per_world: int = 12
    spacing: tuple[float, float] = (6.0, 54.0)
    tasks_per_world: int = 12
    classes: int = 12
    staying_sets: int = 4
    held_out: tuple[str, ...] = ()
    image_format: str = "jpeg"
    quality: int = JPEG_QUALITY
    camera: CameraConfig = dataclasses.field(default_factory=CameraConfig)
    disturbance: Disturbance = dataclasses.field(default_factory=Disturbance)
    explorer: ExplorerConfig = dataclasses.field(default_factory=ExplorerConfig)


@dataclasses.dataclass(frozen=True)
class Job:
    """One shard to collect; goes to another process."""

    folder: Path
    shard: int
    generator: Generator
    split: Split
    config: CollectConfig
    metadata: DatasetMetadata


@struct.dataclass(kw_only=True)
class Scene:
    """What there is to ask at a pose: the subgoals, D and bearing of each, and which are in the camera's view."""

    subgoals: Subgoals
    distance: Float32[Array, " S"]
    bearing: Float32[Array, " S"]
    in_view: Bool[Array, " S"]


@jax.jit
def survey(world: World, belief: BeliefMap, cell: Int32[Array, "2"]) -> Scene:
    """The subgoals of a belief by known-space distance, letters ignored. The camera sees without limit of range."""
    distances = grid_distances(belief.free, cell, belief.resolution)
    subgoals = find_subgoals(belief, jnp.isfinite(distances), distances, _FRONTIERS)
    seen = visible(world.occupied, cell, SensorConfig(range_cells=float(sum(world.shape))))
    index = jnp.arange(subgoals.mask.shape[0], dtype=jnp.int32)[:, None, None]
    in_view = jnp.any((subgoals.component[None] == index) & seen[None], axis=(1, 2))
    return Scene(
        subgoals=subgoals,
        distance=subgoals.distance,
        bearing=bearing(cell, subgoals.cells),
        in_view=in_view & subgoals.mask,
    )


@partial(jax.jit, static_argnames="bounds")
def label(
    world: World, belief: BeliefMap, scene: Scene, sheet: TaskArrays, bounds: WeightBounds
) -> tuple[Estimates, Weights]:
    """True labels and weights of every (subgoal, question), also of subgoals out of view."""
    labels = true_labels(world, belief, scene.subgoals, sheet)
    mask = scene.subgoals.mask[:, None] & sheet.class_mask[None, :]
    return labels, loss_weights(scene.distance, labels, mask, bounds)


@partial(jax.jit, static_argnames="config")
def _image(world: World, cell: Int32[Array, "2"], key, config: CollectConfig):
    return disturb(render(world, cell, config.camera), key, config.disturbance)


class Recorder:
    """Columns of the views and samples of one shard."""

    def __init__(self, job: Job, bounds: WeightBounds) -> None:
        self._job, self._bounds = job, bounds
        self.views: dict[str, list[Any]] = {name: [] for name in VIEWS_SCHEMA.names}
        self.samples: dict[str, list[Any]] = {name: [] for name in SAMPLES_SCHEMA.names}

    def add(self, world: World, index: int, pose: Pose, scene: Scene, questions: Sequence[Question]) -> None:
        """Record a view and its samples."""
        config = self._job.config
        sheet = question_sheet(questions, config.classes, config.staying_sets)
        labels, weights = label(world, pose.belief, scene, sheet, self._bounds)
        view = view_id(self._job.shard, len(self.views["view"]))
        key = jax.random.fold_in(jax.random.fold_in(jax.random.key(config.seed), index), pose.step)
        image = np.asarray(_image(world, jnp.asarray(pose.cell, jnp.int32), key, config))
        row = {
            "view": view,
            "world": index,
            "step": pose.step,
            "row": pose.cell[0],
            "column": pose.cell[1],
            "format": config.image_format,
            "image": encode(image, config.image_format, config.quality),
        }
        for name, value in row.items():
            self.views[name].append(value)
        for name, values in _sample_columns(view, scene, questions, labels, weights).items():
            self.samples[name].extend(values)


def _sample_columns(
    view: int, scene: Scene, questions: Sequence[Question], labels: Estimates, weights: Weights
) -> dict[str, list[Any]]:
    """Columns of one view: its subgoals in view, times its questions."""
    chosen = np.flatnonzero(scene.in_view)
    count = len(questions)

    def per_subgoal(values: Array) -> list[Any]:
        return np.repeat(np.asarray(values)[chosen], count).tolist()

    def per_pair(values: Array | np.ndarray) -> list[Any]:
        return np.asarray(values)[chosen, :count].reshape(-1).tolist()

    success = np.asarray(labels.success_probability)
    return {
        "view": [view] * (len(chosen) * count),
        "task": [question.task for question in questions] * len(chosen),
        "outcome_class": [question.outcome_class for question in questions] * len(chosen),
        "row": per_subgoal(scene.subgoals.cells[:, 0]),
        "column": per_subgoal(scene.subgoals.cells[:, 1]),
        "bearing": per_subgoal(scene.bearing),
        "distance": per_subgoal(scene.distance),
        "phi_stay": [list(question.phi_stay) for question in questions] * len(chosen),
        "phi_go": [list(question.phi_go) for question in questions] * len(chosen),
        "success_probability": per_pair(success),
        "success_cost": per_pair(np.where(success > 0, np.asarray(labels.success_cost), np.nan)),
        "failure_cost": per_pair(labels.failure_cost),
        "success_weight": per_pair(weights.success),
        "failure_weight": per_pair(weights.failure),
    }


def collect_world(recorder: Recorder, world: World, index: int, tasks: TaskDistribution, job: Job) -> None:
    """Wander through one world and record views in which a subgoal can be seen."""
    config = job.config
    rng = np.random.default_rng([config.seed, zlib.crc32(job.split.encode()), index])
    pool = [tasks.draw(rng) for _ in range(config.tasks_per_world)]
    due, recorded = 0.0, 0
    for pose in Explorer(world, pool, rng, config.explorer).poses():
        if recorded == config.views_per_world:
            return
        if pose.travelled < due:
            continue
        scene = survey(world, pose.belief, jnp.asarray(pose.cell, jnp.int32))
        if not np.any(scene.in_view):
            continue
        recorder.add(world, index, pose, scene, draw_questions(rng, pool, config.classes, config.staying_sets))
        due = pose.travelled + rng.uniform(*config.spacing) / int(np.sum(scene.in_view))
        recorded += 1


def collect_shard(job: Job) -> int:
    """Collect and write one shard; returns the number of its views."""
    tasks = TaskDistribution(job.generator.propositions, job.config.held_out)
    recorder = Recorder(job, WeightBounds(**job.metadata.weights))
    first = job.shard * job.config.worlds_per_shard
    for index in range(first, first + job.config.worlds_per_shard):
        world = job.generator.generate(world_key(job.split, index, job.generator.name))
        collect_world(recorder, world, index, tasks, job)
    write_shard(job.folder, job.shard, recorder.views, recorder.samples, job.metadata)
    return len(recorder.views["view"])


def collect(
    generator: Generator,
    environment: str,
    split: Split,
    worlds: int,
    folder: Path,
    config: CollectConfig,
    processes: int = 1,
) -> None:
    """Collect what is missing of the first ``worlds`` worlds of a split.

    Raises:
        DatasetError: the folder holds a dataset with other metadata, or ``worlds`` does not fill whole shards.
    """
    shards, rest = divmod(worlds, config.worlds_per_shard)
    if rest or shards < 1 or processes < 1:
        raise DatasetError(
            f"{worlds} worlds are no whole shards of {config.worlds_per_shard} worlds, or {processes} processes are "
            f"too few: ask for {max(shards, 1) * config.worlds_per_shard} worlds, or give --worlds-per-shard"
        )
    metadata = dataset_metadata(generator, environment, split, config)
    finished = finished_shards(folder)
    if finished:
        differences = read_metadata(folder).differences(metadata)
        if differences:
            raise DatasetError(
                f"{folder} holds a dataset that was collected otherwise ({'; '.join(differences)}): continue with the "
                "same settings, or choose an empty folder"
            )
    remove_unfinished_files(folder)
    jobs = [
        Job(folder=folder, shard=shard, generator=generator, split=split, config=config, metadata=metadata)
        for shard in range(shards)
        if shard not in finished
    ]
    views = 0
    with tqdm(total=worlds, initial=worlds - len(jobs) * config.worlds_per_shard, unit="world", smoothing=0.1) as bar:
        for count in _run(jobs, processes):
            views += count
            bar.update(config.worlds_per_shard)
            bar.set_postfix(views=views, views_per_second=round(views / max(bar.format_dict["elapsed"], 1e-9), 1))


def dataset_metadata(generator: Generator, environment: str, split: Split, config: CollectConfig) -> DatasetMetadata:
    """What the shards of a collection share."""
    world = generator.generate(world_key(split, 0, generator.name))
    settings = json.loads(json.dumps(dataclasses.asdict(config)))
    camera, disturbance = settings.pop("camera"), settings.pop("disturbance")
    encoding = {"format": settings.pop("image_format"), "quality": settings.pop("quality")}
    resolution = float(world.resolution)
    return DatasetMetadata(
        propositions=generator.propositions,
        environment=environment,
        generator=json.loads(json.dumps(dataclasses.asdict(generator.config), default=str)),
        split=split.value,
        camera=camera,
        disturbance=disturbance,
        encoding=encoding,
        weights=dataclasses.asdict(WeightBounds.of_map(*world.shape, resolution)),
        collection=settings,
        versions={**versions(), "pyarrow": pyarrow.__version__, "opencv": cv2.__version__},
        unit="cells" if resolution == 1.0 else "metres",
        resolution=resolution,
    )


def _run(jobs: Sequence[Job], processes: int) -> Iterator[int]:
    """Views of each shard as it is done."""
    if processes == 1:
        yield from map(collect_shard, jobs)
        return
    context = multiprocessing.get_context("spawn")
    cores = context.SimpleQueue()
    allowed = sorted(os.sched_getaffinity(0))
    for index in range(processes):
        cores.put(allowed[index % len(allowed)])
    with context.Pool(processes, _start_worker, (cores,)) as pool:
        yield from pool.imap_unordered(collect_shard, jobs)


def _start_worker(cores) -> None:
    """A process keeps to one core, and ends with its parent however that ends."""
    os.sched_setaffinity(0, {cores.get()})
    enable_compilation_cache()
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def summary(samples: Samples) -> str:
    """Size and balance of a dataset, in words."""
    holds = samples.success > 0
    views = len(samples.images)
    if not len(holds):
        return f"{views} views, no samples"
    lines = [
        f"{views} views, {len(holds)} samples ({len(holds) / views:.1f} a view), {holds.mean():.1%} successes",
        f"images: {np.mean([len(image) for image in samples.images]) / 1024:.1f} KiB each",
    ]
    for index, name in enumerate(samples.metadata.propositions):
        asked = samples.phi_go[:, index] > 0
        lines.append(f"{name}: asked for in {asked.mean():.1%} of samples, {holds[asked].mean():.1%} of them successes")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    defaults = CollectConfig()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--environment", default="firefighting")
    parser.add_argument("--split", type=Split, choices=list(Split), default=Split.TRAINING)
    parser.add_argument("--worlds", type=int, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--seed", type=int, default=defaults.seed)
    parser.add_argument("--worlds-per-shard", type=int, default=defaults.worlds_per_shard)
    parser.add_argument("--views-per-world", type=int, default=defaults.views_per_world)
    parser.add_argument("--classes", type=int, default=defaults.classes)
    parser.add_argument("--format", choices=("jpeg", "png"), default=defaults.image_format)
    parser.add_argument("--quality", type=int, default=defaults.quality, help="of JPEG")
    parser.add_argument("--noise", type=float, default=0.0, help="disturbances of the image, see world/panorama.py")
    parser.add_argument("--exposure", type=float, default=0.0)
    parser.add_argument("--colour", type=float, default=0.0)
    options = parser.parse_args(arguments)
    enable_compilation_cache()
    generator = make(options.environment)
    config = CollectConfig(
        seed=options.seed,
        worlds_per_shard=options.worlds_per_shard,
        views_per_world=options.views_per_world,
        classes=options.classes,
        held_out=HELD_OUT.get(generator.name, ()),
        image_format=options.format,
        quality=options.quality,
        disturbance=Disturbance(noise=options.noise, exposure=options.exposure, colour=options.colour),
    )
    try:
        collect(generator, options.environment, options.split, options.worlds, options.out, config, options.processes)
    except DatasetError as error:
        parser.exit(1, f"error: {error}\n")
    print(summary(read_dataset(options.out)))


if __name__ == "__main__":
    main()
