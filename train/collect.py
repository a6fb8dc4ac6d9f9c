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

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pyarrow
from jaxtyping import Array, Int32, UInt8
from tqdm import tqdm

from potlp_jax.cache import enable_compilation_cache
from potlp_jax.environments.base import Generator
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import Split, world_key
from potlp_jax.errors import DatasetError
from potlp_jax.learning.dataset import (
    DatasetMetadata,
    Samples,
    finished_shards,
    read_dataset,
    read_metadata,
    remove_unfinished_files,
    write_shard,
)
from potlp_jax.learning.mistake_costs import WeightBounds
from potlp_jax.learning.questions import HELD_OUT, TaskDistribution
from potlp_jax.learning.recording import Pose, Recorder, ViewConfig, record_views
from potlp_jax.trials.config import trial_config_for
from potlp_jax.trials.loop import versions
from potlp_jax.world.camera import CameraConfig, Disturbance, disturb
from potlp_jax.world.grid import World
from potlp_jax.world.renderer import render
from train.explorer import Explorer, ExplorerConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class CollectConfig(ViewConfig):
    """What is recorded, and how the robot comes there.

    Attributes:
        seed: of everything but the worlds.
        worlds_per_shard: what is lost, at most, where a process is killed.
        held_out: formulas whose languages are never drawn.
        camera, disturbance: the images.
        explorer: how the robot wanders; it pursues the tasks that the outcome classes are from.
    """

    seed: int = 0
    worlds_per_shard: int = 4
    held_out: tuple[str, ...] = ()
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


@partial(jax.jit, static_argnames="config")
def _image(world: World, cell: Int32[Array, "2"], key, config: CollectConfig):
    return disturb(render(world, cell, config.camera), key, config.disturbance)


def collect_world(recorder: Recorder, world: World, index: int, tasks: TaskDistribution, job: Job) -> None:
    """Wander through one world and record views in which a subgoal can be seen."""
    config = job.config
    rng = np.random.default_rng([config.seed, zlib.crc32(job.split.encode()), index])
    pool = [tasks.draw(rng) for _ in range(config.tasks_per_world)]

    def photograph(pose: Pose) -> UInt8[np.ndarray, "rows columns 3"]:
        key = jax.random.fold_in(jax.random.fold_in(jax.random.key(config.seed), index), pose.step)
        return np.asarray(_image(world, jnp.asarray(pose.cell, jnp.int32), key, config))

    record_views(recorder, world, index, Explorer(world, pool, rng, config.explorer).poses(), pool, rng, photograph)


def collect_shard(job: Job) -> int:
    """Collect and write one shard; returns the number of its views."""
    tasks = TaskDistribution(job.generator.propositions, job.config.held_out)
    recorder = Recorder(job.shard, job.config, WeightBounds(**job.metadata.weights))
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
    parser.add_argument("--noise", type=float, default=0.0, help="disturbances of the image, see world/camera.py")
    parser.add_argument("--exposure", type=float, default=0.0)
    parser.add_argument("--colour", type=float, default=0.0)
    options = parser.parse_args(arguments)
    enable_compilation_cache()
    generator = make(options.environment)
    frontiers = trial_config_for(generator).decision.frontiers
    config = CollectConfig(
        frontiers=frontiers,
        explorer=ExplorerConfig(frontiers=frontiers),
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
