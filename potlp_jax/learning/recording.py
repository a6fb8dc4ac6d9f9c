"""From poses to the rows of a dataset: panoramas, what they painted on the map, questions and answers.

In simulation and from a robot's log alike. At each pose (``learning.scenes``) a panorama is taken and painted on the
map. Now and then the panorama and the map are recorded, and for every subgoal and some outcome classes, drawn from a
pool of tasks, P_S, R_S, R_F and the weights of the loss. ``docs/dataset.md`` describes the rows.
"""

import dataclasses
import math
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Int32, UInt8

from potlp_jax.checks import AT_LEAST_ONE, NOT_NEGATIVE, SEED, require_fields
from potlp_jax.codec import json_copy
from potlp_jax.compiling import jit_by_class
from potlp_jax.errors import DatasetError
from potlp_jax.learning.dataset import (
    IMAGE_FORMATS,
    JPEG_QUALITY,
    SAMPLES_SCHEMA,
    VIEWS_SCHEMA,
    WORLDS_SCHEMA,
    encode,
    view_id,
    writer_versions,
)
from potlp_jax.learning.dataset_metadata import DatasetMetadata
from potlp_jax.learning.ideal_observer import IdealObserver
from potlp_jax.learning.labels import TrueMapEstimator
from potlp_jax.learning.map_images import encode_view, encode_world
from potlp_jax.learning.observing import look_step, looks_between
from potlp_jax.learning.painting import Painting, blank_painting, paint
from potlp_jax.learning.questions import Question, TaskDistribution, draw_questions, question_sheet
from potlp_jax.learning.sample_weights import WeightBounds, Weights
from potlp_jax.learning.scenes import Pose, Scene, is_answered, label, survey
from potlp_jax.planning.estimates import Estimates
from potlp_jax.task.task import Task
from potlp_jax.types import Status
from potlp_jax.world.camera import CameraConfig, Disturbance
from potlp_jax.world.frontiers import FrontierConfig
from potlp_jax.world.grid import BeliefMap, World
from potlp_jax.world.moves import Cell


@dataclasses.dataclass(frozen=True, kw_only=True)
class RecordingConfig:
    """What is recorded of a world.

    Attributes:
        views_per_world: at most.
        spacing: travelled between views: uniform, in cells, divided by the number of subgoals in view, so that most
            views are where there is most to choose.
        tasks_per_world: drawn for the outcome classes.
        classes: outcome classes per view, at most; staying_sets: distinct sets of staying letters among them.
        image_format, quality: of the encoded images: ``jpeg`` or ``png``; quality is JPEG's.
        frontiers: which components of the frontier are subgoals; of more than ``max_subgoals`` the nearest are kept.
        seed: of everything but the worlds.
        held_out: formulas whose languages are never drawn.
        camera: takes the images.
        look_every: how often it looks on the way, as in a trial (``TrialConfig``), to paint the map.
        glances: whether cells of which a part alone is in sight are painted, too (``learning.painting.paint``).
        nearest: whether by the labels only subgoals lead to a class that are nearly the shortest way to it
            (``learning.labels.nearest_ways``).
    """

    views_per_world: int = 12
    spacing: tuple[float, float] = (6.0, 54.0)
    tasks_per_world: int = 12
    classes: int = 12
    staying_sets: int = 4
    image_format: str = "jpeg"
    quality: int = JPEG_QUALITY
    frontiers: FrontierConfig = FrontierConfig()
    seed: int = 0
    held_out: tuple[str, ...] = ()
    camera: CameraConfig = CameraConfig()
    look_every: int = 1
    glances: bool = True
    nearest: bool = False

    def __post_init__(self) -> None:
        require_fields(self, ("views_per_world", "classes", "tasks_per_world"), AT_LEAST_ONE, DatasetError)
        require_fields(self, ("look_every",), NOT_NEGATIVE, DatasetError)
        require_fields(self, ("seed",), SEED, DatasetError)
        if not 0 <= self.spacing[0] <= self.spacing[1] < math.inf:
            raise DatasetError(f"spacing is {self.spacing}: give the least and the most, in cells")
        # A sheet of questions goes from one set to another (``question_sheet``).
        if self.staying_sets < 2:
            raise DatasetError(f"staying_sets is {self.staying_sets}; give at least 2")
        if self.image_format not in IMAGE_FORMATS:
            raise DatasetError(f"image_format is {self.image_format!r}; choose {' or '.join(IMAGE_FORMATS)}")
        if not 0 <= self.quality <= 100:
            raise DatasetError(f"quality is {self.quality}; give a number from 0 to 100")


def recording_metadata(
    config: RecordingConfig, bounds: WeightBounds, versions: Mapping[str, str], **facts: Any
) -> DatasetMetadata:
    """What the shards of a dataset share.

    Args:
        config: becomes ``camera``, ``encoding`` and ``collection``, and ``disturbance`` where it has one.
        bounds: of the samples' weights.
        versions: of what the records depend on besides the libraries that write them.
        facts: the other fields of ``DatasetMetadata``.

    Returns:
        Metadata that are equal for collections that may be continued by each other.
    """
    settings = json_copy(dataclasses.asdict(config))
    return DatasetMetadata(
        camera=settings.pop("camera"),
        disturbance=settings.pop("disturbance", dataclasses.asdict(Disturbance())),
        encoding={"format": settings.pop("image_format"), "quality": settings.pop("quality")},
        weights=dataclasses.asdict(bounds),
        versions={**versions, **writer_versions()},
        collection=settings,
        **facts,
    )


def draws_of_world(
    config: RecordingConfig, split: str, index: int, tasks: TaskDistribution
) -> tuple[np.random.Generator, list[Task]]:
    """What is drawn for one world of a dataset.

    Args:
        config: for the seed and the size of the pool.
        split, index: name the world.
        tasks: what the pool is drawn from.

    Returns:
        The world's random numbers, which no other world shares, and its pool of tasks.
    """
    # crc32 and not hash(): Python's hash of a text is another one in every process.
    rng = np.random.default_rng([config.seed, zlib.crc32(split.encode()), index])
    return rng, [tasks.draw(rng) for _ in range(config.tasks_per_world)]


@struct.dataclass(kw_only=True)
class Seen:
    """What the camera has shown on a drive.

    Attributes:
        painting: on the map.
        observer: remembers what was in sight and gives the labels; None where the true map does.
    """

    painting: Painting
    observer: IdealObserver | None


@partial(jit_by_class, static_argnames=("camera", "glances"))
def _after_picture(
    seen: Seen,
    image: UInt8[Array, "rows columns 3"],
    belief: BeliefMap,
    cell: Int32[Array, "2"],
    camera: CameraConfig,
    glances: bool,
) -> Seen:
    observer = None if seen.observer is None else seen.observer.remember(None, belief, cell)
    return Seen(painting=paint(seen.painting, image, belief, cell, camera, glances=glances), observer=observer)


class Recorder:
    """Columns of the worlds, views and samples of one shard."""

    def __init__(self, shard: int, config: RecordingConfig, bounds: WeightBounds) -> None:
        self._shard, self._bounds = shard, bounds
        self.config = config
        self.worlds: dict[str, list[Any]] = {name: [] for name in WORLDS_SCHEMA.names}
        self.views: dict[str, list[Any]] = {name: [] for name in VIEWS_SCHEMA.names}
        self.samples: dict[str, list[Any]] = {name: [] for name in SAMPLES_SCHEMA.names}
        self.overflowed = 0
        """Views of maps with more subgoals than are recorded."""

    def add_world(self, world: World, index: int, unseen: Bool[np.ndarray, "H W"] | None = None) -> None:
        """Record a true map; the views that are added next are of it.

        Args:
            world, index: the true map and its number.
            unseen: as in ``map_images.encode_world``.
        """
        row = {"world": index, **dataclasses.asdict(encode_world(world, unseen))}
        for name, value in row.items():
            self.worlds[name].append(value)

    def add(
        self,
        world: World,
        pose: Pose,
        image: UInt8[np.ndarray, "rows columns 3"],
        seen: Seen,
        scene: Scene,
        questions: Sequence[Question],
    ) -> None:
        """Record a view of the world that was added last, and its samples.

        Args:
            world: the true map.
            pose: where the robot stands.
            image: what the camera saw.
            seen: what it has shown until then, this image included.
            scene: the subgoals; each becomes a sample for every question.
            questions: what is asked of each of them.

        Raises:
            DatasetError: no building of the family agrees with what was seen.
        """
        config = self.config
        # One sheet size for all views: the labels are compiled once.
        sheet = question_sheet(questions, config.classes, config.staying_sets)
        by = TrueMapEstimator(world=world, nearest=config.nearest) if seen.observer is None else seen.observer
        labels, weights = label(by, pose.belief, scene, sheet, self._bounds)
        if labels.status is not None and Status.INVALID in Status(int(labels.status)):
            raise DatasetError(
                f"world {self.worlds['world'][-1]}, step {pose.step}: no building of its family agrees with what was "
                "seen, so that it cannot give labels: its `posterior` does not fit its worlds"
            )
        # Numbered in the order of recording; samples refer to their view by it.
        view = view_id(self._shard, len(self.views["view"]))
        row = {
            "view": view,
            "world": self.worlds["world"][-1],
            "step": pose.step,
            "row": pose.cell[0],
            "column": pose.cell[1],
            "format": config.image_format,
            "image": encode(image, config.image_format, config.quality),
            **dataclasses.asdict(encode_view(pose.belief, seen.painting)),
        }
        for name, value in row.items():
            self.views[name].append(value)
        self.overflowed += Status.SUBGOAL_OVERFLOW in Status(int(scene.subgoals.status))
        for name, values in _sample_columns(view, scene, questions, labels, weights).items():
            self.samples[name].extend(values)


def record_views(
    recorder: Recorder,
    world: World,
    poses: Iterable[Pose],
    tasks: Sequence[Task],
    rng: np.random.Generator,
    photograph: Callable[[Cell, int], UInt8[np.ndarray, "rows columns 3"] | None],
    *,
    most: int,
    unexplored: Bool[np.ndarray, "H W"] | None = None,
    observer: IdealObserver | None = None,
) -> int:
    """Record views of one drive through a world at random intervals along ``poses``.

    Args:
        recorder: gets the rows; the world was added to it.
        world: the true map.
        poses: of the robot, in order, nothing known before the first; not read further than needed.
        tasks: the pool that questions are drawn from.
        rng: moves on.
        photograph: what the camera sees from a cell that was entered after so many others; called in their order. None:
            there is no picture, and the pose is passed over.
        most: views to record.
        unexplored: as in ``is_answered``; subgoals that ``world`` does not answer for are left out. None: it answers
            for all.
        observer: of the world, that has seen nothing; gives the labels in place of the true map.

    Returns:
        How many views were recorded.
    """
    config, due, recorded = recorder.config, 0.0, 0
    seen = Seen(painting=blank_painting(*world.shape), observer=observer)
    for pose in poses:
        if recorded == most:
            break
        # At every pose and on the way, as in a trial, where panoramas precede each decision.
        seen = _seen_on_the_way(seen, pose, photograph, config)
        image = photograph(pose.cell, pose.step)
        if image is None:
            continue
        at = jnp.asarray(pose.cell, jnp.int32)
        seen = _after_picture(seen, image, pose.belief, at, config.camera, config.glances)
        # Before the scene is made: finding subgoals is what takes time.
        if pose.travelled < due:
            continue
        scene = survey(world, pose.belief, jnp.asarray(pose.cell, jnp.int32), config.frontiers)
        if unexplored is not None:
            scene = _answered_part(scene, world, pose.belief, unexplored)
        if not np.any(scene.asked):
            continue
        questions = draw_questions(rng, tasks, config.classes, config.staying_sets)
        recorder.add(world, pose, image, seen, scene, questions)
        # More views where there is more to choose, which is where a decision matters.
        due = pose.travelled + rng.uniform(*config.spacing) / max(1, int(np.sum(scene.in_view)))
        recorded += 1
    return recorded


def overflow_in_words(views: int, overflowed: int, most: int, option: str) -> str:
    """What is said where views had more subgoals than are recorded; empty where none had.

    Args:
        views: that were recorded now.
        overflowed: of these, the views with more subgoals.
        most: subgoals that are recorded of a view.
        option: what records more, before the number.
    """
    if not overflowed:
        return ""
    return (
        f"{overflowed} of the {views} views recorded now have more than {most} subgoals: the nearest {most} of each "
        f"are asked about ({option}{2 * most} records more, into an empty folder)"
    )


def _seen_on_the_way(
    seen: Seen,
    pose: Pose,
    photograph: Callable[[Cell, int], UInt8[np.ndarray, "rows columns 3"] | None],
    config: RecordingConfig,
) -> Seen:
    """With what the camera showed since the pose before, this pose's own panorama left out."""
    before = pose.step - len(pose.way) - 1
    for number in range(looks_between(before, pose.step, config.look_every)):
        step = look_step(before, number, config.look_every)
        cell = pose.way[step - before - 1]
        image = photograph(cell, step)
        if image is not None:
            seen = _after_picture(seen, image, pose.belief, jnp.asarray(cell, jnp.int32), config.camera, config.glances)
    return seen


def _answered_part(scene: Scene, world: World, belief: BeliefMap, unexplored: Bool[np.ndarray, "H W"]) -> Scene:
    """Only the subgoals for which the world answers."""
    asked = jnp.asarray(is_answered(world, belief, scene.subgoals, unexplored))
    return dataclasses.replace(scene, asked=scene.asked & asked)


def _sample_columns(
    view: int, scene: Scene, questions: Sequence[Question], labels: Estimates, weights: Weights
) -> dict[str, list[Any]]:
    """Columns of one view: its subgoals, times its questions."""
    chosen = np.flatnonzero(scene.asked)
    count = len(questions)

    # Rows by subgoal, then by question: what belongs to a subgoal is repeated, what belongs to a question runs through.
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
        "in_view": per_subgoal(scene.in_view),
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
