"""Fits on disk: what a second start does, what is refused, and what an estimator's file says of how it was made."""

import dataclasses
import json
import types

import jax
import numpy as np
import pytest
from typer.testing import CliRunner

from potlp_jax.cli import app
from potlp_jax.engine.writer import only_writer
from potlp_jax.errors import DatasetError, TrainingError
from potlp_jax.learning.dataset_reading import joined
from potlp_jax.learning.estimator import read_estimator
from potlp_jax.learning.made_from import trained_before_on
from potlp_jax.learning.panorama_learner import PanoramaOptions
from potlp_jax.learning.predictions import check_fit
from potlp_jax.learning.serialization import save_estimator
from potlp_jax.learning.training_options import TrainingOptions
from potlp_jax.recipes import fitting
from potlp_jax.recipes.fitting import ESTIMATOR, FitConfig, fit, planned_steps
from potlp_jax.recipes.journal import Display
from tests.test_training import synthetic

SMALL = FitConfig(
    epochs=3,
    network=PanoramaOptions(second_widths=(3,) * 8),
    training=TrainingOptions(views_per_batch=4, samples_per_view=4, patience=0),
)


def _clock_that_measuring_moves(monkeypatch, seconds):
    """Measuring the speed takes so many seconds, by a clock of its own; a step takes next to none."""
    passed = [0.0]

    def seconds_per_step(*arguments):
        passed[0] += seconds
        return 1e-4

    monkeypatch.setattr(fitting, "seconds_per_step", seconds_per_step)
    monkeypatch.setattr(fitting, "time", types.SimpleNamespace(perf_counter=lambda: passed[0]))


@pytest.mark.long
def test_a_fit_that_its_time_ended_gives_the_same_file_again(tmp_path, monkeypatch):
    # 72 seconds, of which measuring leaves nothing: one step is made.
    _clock_that_measuring_moves(monkeypatch, 71.9999)
    config = dataclasses.replace(SMALL, minutes=1.0)
    samples, found = synthetic(8, 4, 0), []
    for _ in range(2):
        ended = fit(samples, samples, tmp_path, config)
        found.append((ended.reason, ended.steps, (tmp_path / ESTIMATOR).read_bytes()))
    assert found[0][:2] == ("time", 1)
    assert found[0] == found[1]


def test_a_plan_of_before_does_not_say_how_long_measuring_took(tmp_path):
    config = FitConfig(epochs=2, minutes=3.0)
    made = planned_steps(tmp_path, 5, config, lambda: 1.0)
    assert (made.steps, made.measuring) == (10, pytest.approx(0, abs=1))
    file = tmp_path / "plan.json"
    plan = json.loads(file.read_text())
    del plan["measuring"]
    file.write_text(json.dumps(plan))
    assert planned_steps(tmp_path, 5, config, _never) == fitting.Planned(10)


@pytest.mark.long
def test_a_file_counts_what_was_learned_from(tmp_path):
    samples, lines = synthetic(8, 6, 0), []
    # The panorama shows every success, and some failures.
    samples.in_view[:] = (samples.success > 0) | (np.arange(48) % 3 == 0)
    fit(samples, samples, tmp_path, dataclasses.replace(SMALL, epochs=1), Display(say=lines.append))
    metadata = read_estimator(tmp_path / ESTIMATOR).metadata
    assert metadata["prior"] == np.mean(samples.success[samples.in_view], dtype=np.float64) != samples.success.mean()
    assert metadata["samples"] == samples.in_view.sum() < 48
    assert f"a panorama network; 8 views, {metadata['samples']} samples; 2 steps" in "\n".join(lines)


def _of_worlds(seed, first, split="training", environment="synthetic"):
    """A data set of one world, with this number."""
    samples = synthetic(8, 4, seed)
    metadata = dataclasses.replace(
        samples.metadata, collection={"first_world": first}, split=split, environment=environment
    )
    return dataclasses.replace(samples, metadata=metadata)


@pytest.mark.parametrize(
    ("validation", "said"),
    [
        # Recorded otherwise, in the world that is learned from.
        (_of_worlds(1, 5), True),
        (_of_worlds(1, 6), False),
        (_of_worlds(1, 5, split="validation"), False),
        (_of_worlds(1, 5, environment="another"), False),
        # Robots' logs have no numbers.
        (_of_worlds(1, None), False),
    ],
)
def test_validation_worlds_that_are_learned_from_are_said(validation, said):
    lines = []
    fitting._tell_of_what_is_shared(_of_worlds(0, 5), validation, Display(say=lines.append))
    assert [line.split(": ")[0] for line in lines] == (
        ["the validation data have worlds that are learned from, or were before (synthetic/training, 1 from 5)"]
        if said
        else []
    )


@pytest.mark.long
def test_a_file_names_what_the_estimators_before_it_were_fitted_to(tmp_path):
    first, second, third = (_of_worlds(seed, 10 * seed) for seed in range(3))
    validation, once = _of_worlds(9, 0, "validation"), dataclasses.replace(SMALL, epochs=1)
    for name, training, before in (
        ("a", first, None),
        ("b", joined([first, second]), "a"),
        ("c", third, "b"),
        ("d", second, "c"),
    ):
        initial = None if before is None else tmp_path / before / ESTIMATOR
        fit(training, validation, tmp_path / name, once, initial=initial)
    found = {name: read_estimator(tmp_path / name / ESTIMATOR).metadata for name in "abcd"}
    # As they were where nothing is dropped: what drove with the file knows it by its digest.
    assert not any("earlier_data" in found[name] for name in "ab")
    worlds = {name: [source["first_world"] for source in trained_before_on(found[name])] for name in "cd"}
    assert worlds == {"c": [0, 10], "d": [20, 0]}
    begin, lines = read_estimator(tmp_path / "c" / ESTIMATOR), []
    fitting._tell_of_what_is_shared(third, _of_worlds(7, 10), Display(say=lines.append), begin)
    assert len(lines) == 1
    shown = CliRunner().invoke(app, ["estimator", "info", str(tmp_path / "c" / ESTIMATOR)]).stdout
    assert "before that on" in shown
    assert shown.count("synthetic/training") == 3


def _seen_by(camera):
    samples = synthetic(8, 4, 0)
    return dataclasses.replace(samples, metadata=dataclasses.replace(samples.metadata, camera=camera))


def test_data_of_a_camera_whose_geometry_is_not_known_are_fitted(tmp_path):
    known = synthetic(1, 1, 0).metadata.camera
    samples = _seen_by({name: value for name, value in known.items() if name not in ("horizon", "far", "fold")})
    fit(samples, samples, tmp_path, dataclasses.replace(SMALL, epochs=1))
    estimator = read_estimator(tmp_path / ESTIMATOR)
    assert estimator.domain == dataclasses.replace(synthetic(1, 1, 0).metadata.domain, camera=None)
    check_fit(estimator.config, estimator.domain, samples, "it", "the data", estimator.metadata)


def test_a_camera_that_is_none_is_named_before_training(tmp_path, monkeypatch):
    monkeypatch.setattr(fitting, "train", _stop)
    samples = _seen_by({**synthetic(1, 1, 0).metadata.camera, "height": "tall"})
    with pytest.raises(DatasetError, match=r"camera\.height: give a whole number"):
        fit(samples, samples, tmp_path, SMALL)


def test_the_network_that_is_fitted_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(fitting, "train", _stop)
    samples, lines = synthetic(8, 4, 0), []
    network = SMALL.network.learner(samples)
    save_estimator(tmp_path / "e.npz", network.init(jax.random.key(0)), network.config, samples.metadata.domain, {})
    # What ``config`` says of the kind counts for nothing here.
    with pytest.raises(StoppedError):
        fit(samples, samples, tmp_path, FitConfig(epochs=1), Display(say=lines.append), initial=tmp_path / "e.npz")
    assert any(line.startswith("a panorama network;") for line in lines)


def test_two_commands_do_not_fit_in_one_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(fitting, "train", _stop)
    samples = synthetic(8, 4, 0)
    with only_writer(tmp_path, TrainingError), pytest.raises(TrainingError, match="another command works on it"):
        fit(samples, samples, tmp_path, SMALL)
    assert not (tmp_path / "plan.json").exists()
    # The folder is let go of, also by an error.
    for _ in range(2):
        with pytest.raises(StoppedError):
            fit(samples, samples, tmp_path, SMALL)


@pytest.mark.parametrize("minutes", [float("inf"), float("nan"), 0.0, -1.0])
def test_minutes_that_are_no_time_are_named(minutes):
    with pytest.raises(TrainingError, match=f"minutes is {minutes}; give a positive number, or null"):
        FitConfig(minutes=minutes)


class StoppedError(Exception):
    pass


def _stop(*arguments, **options):
    raise StoppedError


@pytest.mark.parametrize("minutes", [None, 3.0])
def test_a_plan_is_of_one_training_before_there_is_a_checkpoint(tmp_path, monkeypatch, minutes):
    monkeypatch.setattr(fitting, "train", _stop)
    monkeypatch.setattr(fitting, "seconds_per_step", lambda *arguments: 0.5)
    config = dataclasses.replace(SMALL, minutes=minutes)
    samples = synthetic(8, 4, 0)
    for _ in range(2):
        with pytest.raises(StoppedError):
            fit(samples, samples, tmp_path, config)
    with pytest.raises(TrainingError, match="steps_per_epoch was 2, is 10"):
        fit(synthetic(40, 4, 0), samples, tmp_path, config)
    larger = dataclasses.replace(config.training, views_per_batch=8)
    with pytest.raises(TrainingError, match="views_per_batch was 4, is 8"):
        fit(samples, samples, tmp_path, dataclasses.replace(config, training=larger))
    # What a step takes depends on the network; how many steps an epoch has does not.
    wider = dataclasses.replace(config, network=PanoramaOptions(second_widths=(5,) * 8))
    with pytest.raises(StoppedError) if minutes is None else pytest.raises(TrainingError, match="second_widths was"):
        fit(samples, samples, tmp_path, wider)


@pytest.mark.parametrize(("minutes", "steps", "epoch"), [(None, 20, 10), (3.0, 20, 10), (3.0, 7, 10)])
def test_a_plan_of_before_is_followed_where_it_agrees(tmp_path, minutes, steps, epoch):
    asked = {"epochs": 2, "minutes": minutes, "seed": 0}
    (tmp_path / "plan.json").write_text(json.dumps({"asked": asked, "steps": steps}))
    config = FitConfig(epochs=2, minutes=minutes)
    assert planned_steps(tmp_path, epoch, config, _never).steps == steps
    # Of fewer data, or larger batches.
    with pytest.raises(TrainingError, match=f"steps was {steps}, is 4"):
        planned_steps(tmp_path, 2, config, _never)


def _never():
    raise AssertionError("a resumed training must not measure again")
