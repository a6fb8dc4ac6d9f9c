"""Rows for training the estimator from robots' logs: the same files as ``potlp collect`` writes."""

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from potlp_jax.environments.ros.places import Places
from potlp_jax.errors import DatasetError, LogError
from potlp_jax.learning.dataset import DatasetMetadata, finished_shards, write_shard
from potlp_jax.learning.questions import TaskDistribution
from potlp_jax.learning.recording import (
    Pose,
    Recorder,
    RecordingConfig,
    draws_of_world,
    record_views,
    recording_metadata,
)
from potlp_jax.learning.sample_weights import WeightBounds
from potlp_jax.logs.drive import Drive, PanoramaReader
from potlp_jax.trials.loop import versions
from potlp_jax.world.moves import step_lengths


@dataclasses.dataclass(frozen=True, kw_only=True)
class LogCollectConfig(RecordingConfig):
    """What is recorded of each log: more views than of a simulated world, for there are few logs."""

    views_per_world: int = 200


def poses_of(drive: Drive) -> Iterator[Pose]:
    """The poses of a drive at which there is a picture."""
    travelled = np.cumsum([0.0, *step_lengths(drive.path)]).tolist()
    for step, cell in enumerate(drive.path):
        if step in drive.pictures:
            yield Pose(belief=drive.belief_at(step), cell=cell, step=step, travelled=travelled[step])


def collect_drives(
    drives: Sequence[Drive], places: Places, folder: Path, environment: str, split: str, config: LogCollectConfig
) -> list[int]:
    """Write a dataset with a shard for each drive; returns the number of views of each.

    Raises:
        LogError: no drive, the drives have cells of different sizes, or not one has a picture.
        DatasetError: there is a dataset in the folder already.
    """
    if finished_shards(folder):
        raise DatasetError(f"{folder} holds a dataset: choose an empty folder, and give all bags at once")
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
    for number, drive in enumerate(drives):
        recorder = Recorder(number, config, WeightBounds(**metadata.weights))
        rng, pool = draws_of_world(config, split, number, tasks)
        reader = PanoramaReader(drive, config.camera)
        record_views(
            recorder,
            drive.world,
            number,
            poses_of(drive),
            pool,
            rng,
            lambda pose, reader=reader: reader.panorama(pose.step),
            drive.unexplored(),
        )
        write_shard(folder, number, recorder.views, recorder.samples, metadata)
        counts.append(len(recorder.views["view"]))
    return counts


def _metadata(
    drives: Sequence[Drive], places: Places, environment: str, split: str, config: LogCollectConfig
) -> DatasetMetadata:
    resolution = float(drives[0].world.resolution)
    height, width = (max(drive.world.shape[axis] for drive in drives) for axis in (0, 1))
    return recording_metadata(
        config,
        WeightBounds.of_map(height, width, resolution),
        versions(),
        propositions=places.names,
        environment=environment,
        generator={"logs": [drive.log.path.name for drive in drives], "labels": Path(places.source).name},
        split=split,
        unit="metres",
        resolution=resolution,
        source="log",
    )
