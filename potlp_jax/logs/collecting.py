"""Rows for training the estimator from robots' logs: the same files as ``potlp collect`` writes."""

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from potlp_jax.environments.ros.places import Places
from potlp_jax.errors import DatasetError, LogError
from potlp_jax.learning import recording, scenes
from potlp_jax.learning.dataset import finished_shards, write_shard
from potlp_jax.learning.dataset_metadata import DatasetMetadata
from potlp_jax.learning.domain import LOGS
from potlp_jax.learning.questions import TaskDistribution
from potlp_jax.learning.sample_weights import WeightBounds
from potlp_jax.logs.drive import Drive, PanoramaReader
from potlp_jax.trials.loop import versions
from potlp_jax.world.moves import step_lengths


@dataclasses.dataclass(frozen=True, kw_only=True)
class LogCollectConfig(recording.RecordingConfig):
    """What is recorded of each log: more views than of a simulated world, for there are few logs."""

    views_per_world: int = 200


@dataclasses.dataclass(frozen=True)
class Counted:
    """What was recorded of a drive.

    Attributes:
        views: recorded.
        overflowed: of these, the views of maps with more subgoals than are recorded.
    """

    views: int
    overflowed: int


def poses_of(drive: Drive) -> Iterator[scenes.Pose]:
    """The poses of a drive at which there is a picture."""
    travelled = np.cumsum([0.0, *step_lengths(drive.path)]).tolist()
    for step, cell in enumerate(drive.path):
        if step in drive.pictures:
            yield scenes.Pose(belief=drive.belief_at(step), cell=cell, step=step, travelled=travelled[step])


def collect_drives(
    drives: Sequence[Drive], places: Places, folder: Path, environment: str, split: str, config: LogCollectConfig
) -> list[Counted]:
    """Write a dataset with a shard for each drive.

    Args:
        drives: with cells of one size.
        places: where the propositions are.
        folder: without a dataset.
        environment: name of the dataset's environment.
        split: name of the dataset's split.
        config: what is recorded.

    Returns:
        What was recorded of each drive.

    Raises:
        LogError: no drive, the drives have cells of different sizes, or not one has a picture.
        DatasetError: there is a dataset in the folder already.
    """
    # Shards are numbered by log: adding to a dataset would mix numbers and draws.
    if finished_shards(folder):
        raise DatasetError(f"{folder} holds a dataset: choose an empty folder, and give all bags at once")
    # The network counts in metres, but labels of one dataset share one size of cells.
    resolutions = sorted({float(drive.world.resolution) for drive in drives})
    if len(resolutions) != 1:
        raise LogError(f"the logs have cells of {resolutions} m: give one --resolution for all")
    if not any(drive.pictures for drive in drives):
        raise LogError(
            f"{', '.join(str(drive.log.path) for drive in drives)}: no panorama that can be used: a dataset needs a "
            "topic of type sensor_msgs/CompressedImage; `potlp log inspect` says what there is"
        )
    tasks = TaskDistribution(places.names, config.held_out)
    metadata = _metadata(drives, places, environment, split, config)
    counts = []
    # A shard per drive, with draws of its own: the order of the others does not matter.
    for number, drive in enumerate(drives):
        recorder = recording.Recorder(number, config, WeightBounds(**metadata.weights))
        rng, pool = recording.draws_of_world(config, split, number, tasks)
        reader = PanoramaReader(drive, config.camera)
        recorder.add_world(drive.world, number, ~drive.seen)
        recording.record_views(
            recorder,
            drive.world,
            poses_of(drive),
            pool,
            rng,
            lambda _, step, reader=reader: reader.panorama(step),
            most=config.views_per_world,
            unexplored=drive.unexplored(),
        )
        write_shard(folder, number, recorder.worlds, recorder.views, recorder.samples, metadata)
        counts.append(Counted(len(recorder.views["view"]), recorder.overflowed))
    return counts


def _metadata(
    drives: Sequence[Drive], places: Places, environment: str, split: str, config: LogCollectConfig
) -> DatasetMetadata:
    resolution = float(drives[0].world.resolution)
    # Weights are bounded by the largest map, so that all shards share them.
    height, width = (max(drive.world.shape[axis] for drive in drives) for axis in (0, 1))
    return recording.recording_metadata(
        config,
        WeightBounds.of_map(height, width, resolution),
        versions(),
        shape=(height, width),
        propositions=places.names,
        environment=environment,
        family=LOGS,
        generator={"logs": [drive.log.path.name for drive in drives], "labels": Path(places.source).name},
        split=split,
        unit="metres",
        resolution=resolution,
        source="log",
    )
