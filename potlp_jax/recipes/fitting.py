"""Fits an estimator to a dataset.

The folder of a fit then holds ``estimator.npz`` (the best parameters by validation loss: what is shipped), ``log.csv``
(one row an epoch), ``curves.png``, ``tensorboard/``, ``plan.json`` and ``checkpoints/``. One command at a time fits in
it. A fit that was interrupted, also by SIGKILL, resumes and ends with the same parameters, bit for bit, as without the
interruption.

With a time to keep, the speed is measured first, and as many steps are planned as fit, at most ``epochs``; the learning
rate's schedule ends with the plan. The plan is written once, so that a resumed training follows it. Where training is
slower than measured and is cut short (``ended_by`` in the file is ``time``), the clock decides after which step: two
such fits differ, and so does one that was interrupted. However a fit ended, the same command again gives the same file.

Several processes may share a fit (``learning.devices``): all of them call ``fit`` with one
folder, to which the first one writes.
"""

import dataclasses
import json
import time
from collections.abc import Callable, Mapping
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from potlp_jax.checks import AT_LEAST_ONE, NOT_NEGATIVE, POSITIVE, require_fields
from potlp_jax.codec import differences, json_copy
from potlp_jax.engine.writer import only_writer
from potlp_jax.errors import TrainingError
from potlp_jax.files import MOST_TEXT, read_json, reading, write_whole
from potlp_jax.learning.architectures import architecture_of
from potlp_jax.learning.building_config import BuildingConfig
from potlp_jax.learning.building_learner import BuildingOptions
from potlp_jax.learning.data_figures import camera_geometry, image_shape
from potlp_jax.learning.dataset import Samples
from potlp_jax.learning.dataset_metadata import DataSource
from potlp_jax.learning.devices import agreed, is_first, mesh
from potlp_jax.learning.estimator import TrainedEstimator, read_estimator
from potlp_jax.learning.learner import Learner
from potlp_jax.learning.learners import learner_of
from potlp_jax.learning.made_from import nearest_misfit, share_worlds, trained_before_on, trained_on
from potlp_jax.learning.network import parameter_count, require_propositions
from potlp_jax.learning.panorama_learner import PanoramaOptions
from potlp_jax.learning.serialization import save_estimator
from potlp_jax.learning.training import Trained, provenance, scale_of, seconds_per_step, steps_per_epoch, train
from potlp_jax.learning.training_options import TrainingConfig, TrainingOptions
from potlp_jax.recipes.journal import Display, Journal

ESTIMATOR: str = "estimator.npz"
"""Name of the result in a fit's folder."""

# Of the time asked for: what validation, checkpoints and a busy machine may take.
_RESERVE = 0.1
# Times the time asked for, after which a training that is slower than measured is cut short.
_OVERRUN = 1.2

_CHOSEN_BY_WHAT_WAS_LEARNED = "they choose the parameters by what was learned, and say nothing about other worlds"


@dataclasses.dataclass(frozen=True, kw_only=True)
class FitConfig:
    """What is fitted, and how.

    Attributes:
        epochs: passes over the panoramas, at most.
        minutes: plan as many steps as fit into this time; None for all epochs.
        network: the architecture and its sizes.
        training: of the optimiser and the data.
    """

    epochs: int = 10
    minutes: float | None = None
    network: BuildingOptions | PanoramaOptions = BuildingOptions()
    training: TrainingOptions = TrainingOptions()

    def __post_init__(self) -> None:
        require_fields(self, ["epochs"], AT_LEAST_ONE, TrainingError)
        if self.minutes is not None and not POSITIVE.allows(self.minutes):
            raise TrainingError(f"minutes is {self.minutes}; give a positive number, or null for no limit")


def fit(
    training: Samples,
    validation: Samples,
    out: Path,
    config: FitConfig,
    display: Display = Display(),
    initial: Path | None = None,
) -> Trained:
    """Fit an estimator, or resume.

    Args:
        training: what is learned from.
        validation: of other worlds; decides which parameters are the best.
        out: the fit's folder.
        config: what is fitted, and how.
        display: shows how it goes; of the first process alone.
        initial: an estimator to go on from, whose network is kept as it is, but for how its maps are painted, which is
            as in the training data, and how a subgoal's own frontier is told from others, which is as ``config`` has
            it; a new one by default.

    Returns:
        The best parameters, which ``out`` / ``ESTIMATOR`` holds as well.

    Raises:
        TrainingError: the data do not fit, ``out`` has a plan for something else, another command works on it, or the
            loss is not finite.
        DatasetError: the training data's camera is none.
        CheckpointError: ``out`` holds a damaged checkpoint, or one of another training.
    """
    begin = None if initial is None else read_estimator(initial)
    learner = config.network.learner(training) if begin is None else learner_after(begin, training, config.network)
    _tell_of_changes(begin, learner, display)
    _tell_of_what_is_shared(training, validation, display, begin)
    if not is_first():
        return _fitted(learner, training, validation, out, config, display, begin)
    out.mkdir(parents=True, exist_ok=True)
    # Of all processes that share the fit the first one writes.
    with only_writer(out, TrainingError):
        return _fitted(learner, training, validation, out, config, display, begin)


def _fitted(
    learner: Learner,
    training: Samples,
    validation: Samples,
    out: Path,
    config: FitConfig,
    display: Display,
    begin: TrainedEstimator | None,
) -> Trained:
    """Train, and write the estimator, in a folder that is held."""
    # Before hours of training: the file cannot be written without it.
    domain = training.metadata.domain
    plan, budget = _plan(learner, training, out, config)
    journal = _begin_journal(learner, training, plan, out, config, display) if is_first() else None
    observers: dict[str, Any] = {} if journal is None else journal.observers()
    # The journal is closed whatever happens, so that TensorBoard's file is whole.
    try:
        trained = train(
            learner,
            training,
            validation,
            plan,
            initial=begin,
            folder=out / "checkpoints",
            budget_seconds=budget,
            **observers,
        )
    finally:
        if journal is not None:
            journal.close()
    if journal is not None:
        # Whoever has the file alone can still say how it was made.
        made_from = provenance(training, validation, begin) | _earlier_data(training, begin)
        metadata = made_from | _metadata(learner, training, plan, trained, journal)
        save_estimator(out / ESTIMATOR, trained.params, learner.config, domain, metadata)
    return trained


def _begin_journal(
    learner: Learner, training: Samples, plan: TrainingConfig, out: Path, config: FitConfig, display: Display
) -> Journal:
    devices = mesh().size
    shared = f"; shared by {devices} devices" if devices > 1 else ""
    display.say(
        f"a {architecture_of(learner.config).name} network; {len(training.images)} views, "
        f"{learner.usable(training).sum()} samples; {plan.steps} steps in at most {config.epochs} epochs{shared}"
    )
    return Journal(out, plan.steps, display)


def learner_after(begin: TrainedEstimator, training: Samples, network: BuildingOptions | PanoramaOptions) -> Learner:
    """What is fitted where an estimator is gone on from.

    Raises:
        PropositionsError: it was made for other propositions than those of the data.
        TrainingError: its costs are in another unit, its labels of another kind, or, of a panorama network, its
            pictures are of another camera.
    """
    known = begin.config
    misfits = begin.domain.measure_misfits(training.metadata.domain)
    # Whoever reads maps that are painted takes another painter; whoever reads pictures has to learn anew.
    if misfits and (begin.domain.unit != training.metadata.unit or not isinstance(known, BuildingConfig)):
        raise TrainingError(f"{begin.name} cannot go on with these data: {'; '.join(misfits)}. Train from nothing")
    mixed = nearest_misfit(begin.metadata, training.metadata.nearest)
    if mixed is not None:
        raise TrainingError(f"{begin.name} cannot go on with the training data: {mixed}, or train from nothing")
    require_propositions(known.propositions, training.metadata.propositions, begin.name, asker="the training data")
    # The scales of costs are the estimator's own: with others its parameters would mean other costs. Its maps are
    # painted as those from which it learns now, by the same camera, and have their cells.
    if isinstance(known, BuildingConfig):
        meant = training.metadata
        camera = {"image_shape": image_shape(training), **camera_geometry(training, "painting the map")}
        known = dataclasses.replace(known, glances=meant.glances, step=float(meant.resolution), **camera)
        # What paths are counts as a choice and not as learned: an estimator of before goes on with those of now.
        if isinstance(network, BuildingOptions):
            known = dataclasses.replace(known, own_within=network.own_within)
    return learner_of(known)


def _tell_of_changes(begin: TrainedEstimator | None, learner: Learner, display: Display) -> None:
    """Say where what is fitted is not what an estimator that is gone on from was."""
    if begin is None or not is_first():
        return
    for name in ("own_within", "glances", "step", "image_shape", "horizon", "far", "fold"):
        before, now = (getattr(config, name, None) for config in (begin.config, learner.config))
        if before != now:
            display.say(f"{name} is {now}; {begin.name} has {before}")


def _tell_of_what_is_shared(
    training: Samples, validation: Samples, display: Display, begin: TrainedEstimator | None = None
) -> None:
    """Say where the data that choose the parameters are of worlds that are learned from, or were before."""
    if not is_first():
        return
    before = [] if begin is None else [*trained_on(begin.metadata), *trained_before_on(begin.metadata)]
    learned = [*map(dataclasses.asdict, training.sources), *before]
    chosen_by = list(map(dataclasses.asdict, validation.sources))
    shared = next((one for one in chosen_by for other in learned if share_worlds(one, other)), None)
    if set(training.sources) & set(validation.sources):
        display.say(f"the validation data are among the training data: {_CHOSEN_BY_WHAT_WAS_LEARNED}")
    elif shared is not None:
        display.say(
            f"the validation data have worlds that are learned from, or were before ({shared['environment']}/"
            f"{shared['split']}, {shared['worlds']} from {shared['first_world']}): {_CHOSEN_BY_WHAT_WAS_LEARNED}"
        )


def _earlier_data(training: Samples, begin: TrainedEstimator | None) -> dict[str, Any]:
    """What the estimators before were fitted to and this one is not; nothing where there is no such data set."""
    if begin is None:
        return {}
    names = [field.name for field in dataclasses.fields(DataSource)]
    found = [*map(dataclasses.asdict, training.sources)]
    own = len(found)
    for source in [*trained_on(begin.metadata), *trained_before_on(begin.metadata)]:
        # Files of before have all metadata of a data set.
        said = {name: source[name] for name in names if name in source}
        if said and said not in found:
            found.append(said)
    # Without an entry where there is none, so that rounds which drop nothing write the file that they wrote before.
    return {"earlier_data": {str(number): source for number, source in enumerate(found[own:])}} if found[own:] else {}


def _plan(learner: Learner, training: Samples, out: Path, config: FitConfig) -> tuple[TrainingConfig, float]:
    """How to train, for how many steps, and for how many seconds at most."""
    # Not ``asdict``, which would also take nested options apart.
    options = {field.name: getattr(config.training, field.name) for field in dataclasses.fields(config.training)}
    # The number of steps changes neither the batches nor the time of a step, so any serves to find it out.
    one = TrainingConfig(steps=1, **options)
    planned = planned_steps(
        out,
        steps_per_epoch(learner, training, one),
        config,
        lambda: seconds_per_step(learner, training, one),
        dataclasses.asdict(learner.config),
    )
    # Measuring counts: the time asked for is that of the whole command.
    budget = float("inf") if config.minutes is None else config.minutes * 60 * _OVERRUN - planned.measuring
    return TrainingConfig(steps=planned.steps, **options), budget


@dataclasses.dataclass(frozen=True)
class Planned:
    """How many steps are planned, and the seconds that were spent to find it out: at the first start alone."""

    steps: int
    measuring: float = 0.0


def planned_steps(
    folder: Path,
    epoch: int,
    config: FitConfig,
    measure: Callable[[], float],
    network: Mapping[str, Any] = MappingProxyType({}),
) -> Planned:
    """Steps to plan; where there is a plan already, what it says. The first process's plan is that of all.

    Args:
        folder: where ``plan.json`` is.
        epoch: steps in an epoch.
        config: how many epochs and how much time.
        measure: gives the seconds that a step takes; called, by all processes, where a plan must be made for a time.
        network: its configuration, which decides what is measured.

    Returns:
        The plan. A resumed training must not measure again: another number would be another schedule, and another time
        spent on it would leave another rest for the training.

    Raises:
        TrainingError: there is a plan for other options, or other data.
    """
    asked = _asked(epoch, config, network)
    path = folder / "plan.json"
    written = _agreed(_written_plan(path, asked) if is_first() and path.exists() else Planned(0))
    if written.steps:
        return written
    plan: dict[str, Any] = {"asked": asked, "steps": config.epochs * epoch}
    measuring = 0.0
    if config.minutes is not None:
        began = time.perf_counter()
        plan["seconds_per_step"] = float(agreed(np.float32(measure())))
        measuring = time.perf_counter() - began
        # At least one step, however short the time: the estimator is then poor, but there is one.
        fitting = int(config.minutes * 60 * (1 - _RESERVE) / plan["seconds_per_step"])
        plan["steps"] = max(1, min(plan["steps"], fitting))
    made = _agreed(Planned(plan["steps"], measuring))
    if is_first():
        folder.mkdir(parents=True, exist_ok=True)
        # Half a plan would stop every resumption.
        write_whole(path, json.dumps(plan | {"measuring": made.measuring}))
    return made


def _asked(epoch: int, config: FitConfig, network: Mapping[str, Any]) -> dict[str, Any]:
    """What the number of steps follows from. Other options are compared with the checkpoint, once there is one."""
    asked = {"epochs": config.epochs, "minutes": config.minutes, "seed": config.training.seed}
    asked |= {"steps_per_epoch": epoch}
    asked |= {name: getattr(config.training, name) for name in ("views_per_batch", "samples_per_view")}
    # What takes no time to measure is planned the same for all networks.
    return asked if config.minutes is None else asked | {"network": json_copy(network)}


def _agreed(plan: Planned) -> Planned:
    """The first process's plan, with its seconds in the precision in which the others learn them."""
    return Planned(int(agreed(np.int32(plan.steps))), float(agreed(np.float32(plan.measuring))))


def _written_plan(path: Path, asked: dict[str, Any]) -> Planned:
    plan = read_json(path, TrainingError, "the plan of a training", MOST_TEXT)
    with reading(path, TrainingError, "the plan of a training"):
        # Plans of before do not say how long it took to make them.
        steps, measuring = int(plan["steps"]), float(plan.get("measuring", 0))
        found = _plan_differences(plan["asked"], steps, asked)
    if found:
        raise TrainingError(f"{path} was made for another training ({'; '.join(found)}): choose another folder")
    if steps < 1 or not NOT_NEGATIVE.allows(measuring):
        raise TrainingError(f"{path} plans {steps} steps after {measuring} seconds: delete it to plan again")
    return Planned(steps, measuring)


def _plan_differences(before: Mapping[str, Any], steps: int, asked: Mapping[str, Any]) -> list[str]:
    """How what a plan was made for differs from what is asked for now."""
    if "steps_per_epoch" in before:
        return differences(before, asked)
    # Plans of before say neither data nor batches, but no plan has more steps than its epochs, and without a time to
    # keep it has as many.
    most = asked["epochs"] * asked["steps_per_epoch"]
    fits = steps <= most if asked["minutes"] else steps == most
    found = differences(before, {name: asked[name] for name in ("epochs", "minutes", "seed")})
    return found if found or fits else [f"steps was {steps}, is {most}"]


def _metadata(
    learner: Learner, training: Samples, plan: TrainingConfig, trained: Trained, journal: Journal
) -> dict[str, Any]:
    """What an estimator's file says of how it was made, beside what it was made from."""
    return {
        "training": dataclasses.asdict(plan),
        "data": dataclasses.asdict(training.metadata),
        "panoramas": len(training.images),
        "samples": int(learner.usable(training).sum()),
        "prior": scale_of(learner, training).prior,
        "parameters": parameter_count(trained.params),
        "steps": trained.steps,
        "best_step": trained.best_step,
        "ended_by": trained.reason,
        "seconds": trained.seconds,
        "figures": journal.row_of_step(trained.best_step),
        "versions": {name: version(name) for name in ("potlp-jax", "jax", "flax", "optax")},
    }
