"""Recipes: the shipped ones made the shipped estimators, or begin as one did, and a small one makes an estimator."""

import dataclasses
import json
from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from typer.testing import CliRunner

from potlp_jax.cli import app
from potlp_jax.codec import json_copy, shipped_settings
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import Split
from potlp_jax.errors import ConfigurationError, PotlpError
from potlp_jax.learning.architectures import architecture_of
from potlp_jax.learning.dataset import read_metadata
from potlp_jax.learning.dataset_reading import read_dataset
from potlp_jax.learning.domain import Domain
from potlp_jax.learning.estimator import read_estimator, shipped_files
from potlp_jax.learning.serialization import load_estimator
from potlp_jax.learning.training import Trained
from potlp_jax.recipes import recipe as recipes
from potlp_jax.recipes.fitting import ESTIMATOR
from potlp_jax.recipes.journal import Display
from potlp_jax.recipes.recipe import PACKAGE, _stages, follow, read_recipe
from potlp_jax.recipes.times import TIMES
from potlp_jax.trials.config import trial_config_for
from potlp_jax.world.settings import Settings

SHIPPED = ("delivery", "firefighting", "firefighting-panorama", "parcels")

# One pass over a few small pictures of two-room worlds: the code of a whole training in seconds.
SMALL = {
    "environment": "toy",
    "training_worlds": 4,
    "validation_worlds": 2,
    "collect": {
        "worlds_per_shard": 2,
        "views_per_world": 3,
        "tasks_per_world": 3,
        "classes": 3,
        "staying_sets": 2,
        "camera": {"height": 64, "width": 64},
    },
    "fit": {
        "epochs": 1,
        "network": {"kind": "panorama", "second_widths": [3, 4, 5, 6, 7, 8, 9, 9]},
        "training": {"views_per_batch": 2, "samples_per_view": 4, "seed": 3},
    },
}


def test_every_shipped_estimator_has_its_recipe():
    assert tuple(shipped_settings(PACKAGE)) == SHIPPED


def test_the_shipped_firefighting_estimator_goes_on_with_the_records_of_its_recipe():
    recipe = read_recipe("firefighting")
    estimator = read_estimator(shipped_files()["firefighting"])
    sources = list(estimator.metadata["training_data"].values())
    worlds = [("explorer", recipe.training_worlds)]
    for part in recipe.rounds:
        worlds += [("potlp", part.worlds), ("explorer", part.explored.worlds)]
    assert [(source["driver"], source["worlds"]) for source in sources] == worlds
    # From another file, in one pass; a recipe begins with new parameters.
    assert estimator.metadata["initial"]
    per_epoch = estimator.metadata["panoramas"] // recipe.fit.training.views_per_batch
    assert estimator.metadata["training"]["steps"] == per_epoch
    assert architecture_of(estimator.config).name == recipe.fit.network.kind
    assert estimator.config.glances == recipe.collect.glances
    assert estimator.config.own_within == recipe.fit.network.own_within


@pytest.mark.parametrize("name", [name for name in SHIPPED if name != "firefighting"])
def test_a_shipped_recipe_is_what_made_the_shipped_file(name):
    recipe = read_recipe(name)
    world = make(recipe.environment).world(0, Split.TRAINING)
    estimator = read_estimator(shipped_files()[name])
    assert estimator.config.propositions == world.propositions
    assert not estimator.domain.misfits(Domain.of_world(world, recipe.collect.camera))
    made, data = estimator.metadata["training"], estimator.metadata["data"]
    options = _as_of_old(json_copy(dataclasses.asdict(recipe.fit.training)), made)
    assert options == {key: value for key, value in made.items() if key != "steps"}
    per_epoch = estimator.metadata["panoramas"] // recipe.fit.training.views_per_batch
    epochs = recipe.rounds[-1].epochs if recipe.rounds else recipe.fit.epochs
    assert abs(made["steps"] - epochs * per_epoch) <= epochs
    assert architecture_of(estimator.config).name == recipe.fit.network.kind
    for field in dataclasses.fields(recipe.fit.network):
        assert field.name == "kind" or getattr(recipe.fit.network, field.name) == getattr(estimator.config, field.name)
    # What was learned last is of the last round that left the records before it, and of those after it.
    begin = max((number for number, part in enumerate(recipe.rounds) if part.alone), default=None)
    later = recipe.rounds if begin is None else recipe.rounds[begin:]
    first = recipe.collect if begin is None else recipe.rounds[begin].of_collection(recipe.collect)
    collected = json_copy(dataclasses.asdict(first))
    assert data["environment"] == recipe.environment
    assert data["disturbance"] == collected["disturbance"]
    assert data["encoding"] == {"format": collected["image_format"], "quality": collected["quality"]}
    assert data["camera"].items() <= collected["camera"].items()
    for field in ("seed", "held_out", "views_per_world", "tasks_per_world", "classes", "staying_sets", "spacing"):
        assert data["collection"][field] == collected[field]
    parts = [("potlp", part.worlds, part.of_collection(recipe.collect)) for part in later]
    parts += [
        ("explorer", part.explored.worlds, part.explored.of_round(part.of_collection(recipe.collect))) for part in later
    ]
    if begin is None:
        parts.append((recipe.collect.driver, recipe.training_worlds, recipe.collect))
    parts += [
        (driver, other.worlds(count, config.worlds_per_shard), config)
        for driver, count, config in parts
        for other in recipe.beside
    ]
    # No world gives more views than this; many give as many, but some drives end early.
    most = sum(worlds * config.views_per_world for _, worlds, config in parts)
    assert 0.7 * most < estimator.metadata["panoramas"] <= most
    sources = estimator.metadata.get("training_data", {}).values()
    # A part may have been collected in several folders.
    worlds, found = Counter(), Counter()
    for driver, count, _ in parts:
        worlds[driver] += count
    for source in sources:
        found[source["driver"]] += source["worlds"]
    assert not sources or found == +worlds
    assert len(sources) > 1 or not recipe.rounds


def _as_of_old(options, made):
    """The options of a training as an estimator names them that was made before they were grouped."""
    if "augmentation" in made:
        return options
    varied = options.pop("augmentation")
    assert varied.pop("mirror_columns") == 0.0
    del options["view_share"]
    return {**options, "mirror": varied.pop("mirror_rows"), **varied}


@pytest.mark.long
def test_a_small_recipe_makes_an_estimator_and_continues(tmp_path):
    (tmp_path / "small.yaml").write_text(json.dumps(SMALL))
    recipe = read_recipe(tmp_path / "small.yaml")
    lines, told = [], []
    trained = follow(
        recipe,
        tmp_path / "out",
        tell=lambda split, collected: told.append((split, collected.worlds)),
        display=Display(say=lines.append),
    )
    assert told == [(Split.TRAINING, 0), (Split.TRAINING, 2), (Split.TRAINING, 4), ("validation", 0), ("validation", 2)]
    assert any(line.startswith("epoch   1.0") for line in lines)
    params, config, domain, metadata = load_estimator(tmp_path / "out" / ESTIMATOR)
    for found, expected in zip(jax.tree.leaves(params), jax.tree.leaves(trained.params), strict=True):
        np.testing.assert_array_equal(found, expected)
    assert config.propositions == make("toy").propositions
    assert config.second_widths == recipe.fit.network.second_widths
    assert metadata["training"]["seed"] == 3
    assert domain == Domain.of_world(make("toy").world(0), recipe.collect.camera)
    assert read_metadata(tmp_path / "out" / "validation").split == "validation"
    before = (tmp_path / "out" / ESTIMATOR).read_bytes()
    again = follow(recipe, tmp_path / "out", display=Display(say=lines.append))
    assert lines[-1].startswith("resumed at step")
    # To the bit: what a round recorded with the file would else count as recorded with another one.
    assert (tmp_path / "out" / ESTIMATOR).read_bytes() == before
    assert again.best_step == trained.best_step


@pytest.mark.long
def test_rounds_drive_with_what_was_fitted_and_learn_from_all_records(tmp_path):
    building = {"kind": "building", "widths": [4, 4, 6], "blocks": [0, 0, 1], "decoder": 4, "head": 8, "condition": 4}
    rounds = [
        {"worlds": 2, "validation_worlds": 2, "views_per_world": 2, "drives": 2, "epochs": 1, "explored": {"worlds": 2}}
    ]
    small = {**SMALL, "fit": {**SMALL["fit"], "network": building}, "rounds": rounds}
    (tmp_path / "small.yaml").write_text(json.dumps(small))
    recipe = read_recipe(tmp_path / "small.yaml")
    lines = []
    follow(recipe, tmp_path / "out", display=Display(say=lines.append))
    first, last = tmp_path / "out" / "round-0", tmp_path / "out"
    driven = read_metadata(last / "training")
    assert read_metadata(first / "training").collection["driver"] == "explorer"
    assert (driven.collection["driver"], driven.collection["first_world"]) == ("potlp", 4)
    assert driven.collection["estimator"] == read_estimator(first / ESTIMATOR).identity
    assert read_metadata(last / "explored").collection["first_world"] == 6
    _, config, _, metadata = load_estimator(last / ESTIMATOR)
    assert architecture_of(config).name == "building"
    data = (first / "training", last / "training", last / "explored")
    views = [len(read_dataset(folder).images) for folder in data]
    assert metadata["panoramas"] == sum(views)
    # The file names everything that it was made from.
    assert metadata["initial"] == driven.collection["estimator"]
    sources = [metadata["training_data"][str(number)] for number in range(3)]
    assert [source["views"] for source in sources] == views
    assert [(source["first_world"], source["worlds"]) for source in sources] == [(0, 4), (4, 2), (6, 2)]
    assert [source["driver"] for source in sources] == ["explorer", "potlp", "explorer"]
    assert [source["estimator"] for source in sources] == ["", metadata["initial"], ""]
    assert metadata["validation_data"]["0"]["split"] == "validation"
    shown = _potlp("estimator", "info", last / ESTIMATOR).stdout
    assert "toy/training, 2 worlds from 4, by potlp with" in shown
    assert metadata["initial"] in shown
    # The scales of costs stay those of the first fit, with which its parameters mean something.
    assert config == load_estimator(first / ESTIMATOR)[1]
    steps = [line.split(",") for line in (last / TIMES).read_text().splitlines()]
    assert [(int(stage), step) for stage, step, _ in steps] == [
        *((0, step) for step in ("training", "validation", "fit")),
        *((1, step) for step in ("training", "validation", "explored", "fit")),
    ]
    assert all(float(seconds) > 0 for _, _, seconds in steps)
    again = len(lines)
    follow(recipe, tmp_path / "out", display=Display(say=lines.append))
    assert any(line.startswith("resumed at step") for line in lines[again:])


def test_a_round_may_record_otherwise_and_leave_the_records_of_before(monkeypatch, tmp_path):
    rounds = [
        {"worlds": 2, "validation_worlds": 2},
        {
            **{"worlds": 4, "validation_worlds": 2, "explored": {"worlds": 2, "spacing": [0, 2]}, "alone": True},
            **{"posterior": 8, "look_every": 3, "spacing": [1, 9]},
        },
        {"worlds": 2, "validation_worlds": 2},
    ]
    (tmp_path / "small.yaml").write_text(json.dumps({**SMALL, "rounds": rounds}))
    recipe = read_recipe(tmp_path / "small.yaml")
    collected, fitted = {}, []

    def collect(generator, environment, split, worlds, into, config, engine, tell):
        collected[str(into.relative_to(tmp_path))] = config

    monkeypatch.setattr(recipes, "collect", collect)
    monkeypatch.setattr(recipes, "read_dataset", lambda folder: str(folder.relative_to(tmp_path)))
    monkeypatch.setattr(recipes, "joined", list)
    ended = Trained(params={}, best_step=1, best_loss=0.0, steps=1, reason="planned", seconds=0.0)
    monkeypatch.setattr(recipes, "fit", lambda training, *_: fitted.append(training) or ended)
    follow(recipe, tmp_path)
    assert fitted == [
        ["round-0/training"],
        ["round-0/training", "round-1/training"],
        ["round-2/training", "round-2/explored"],
        ["round-2/training", "round-2/explored", "training"],
    ]
    for folder, config in collected.items():
        own = (config.posterior, config.look_every, config.spacing)
        usual = (recipe.collect.posterior, recipe.collect.look_every, recipe.collect.spacing)
        if folder.startswith("round-2"):
            usual = (8, 3, (0.0, 2.0) if folder.endswith("explored") else (1.0, 9.0))
        assert own == usual


@pytest.mark.long
def test_worlds_of_another_family_are_recorded_beside_those_of_the_recipe(tmp_path):
    rounds = [
        {"worlds": 2, "validation_worlds": 2, "views_per_world": 2, "drives": 1, "epochs": 1, "explored": {"worlds": 2}}
    ]
    # The family itself serves as the other one: its worlds are counted on.
    small = {**SMALL, "rounds": rounds, "beside": [{"environment": "toy", "share": 0.25}]}
    (tmp_path / "small.yaml").write_text(json.dumps(small))
    follow(read_recipe(tmp_path / "small.yaml"), tmp_path / "out")
    found = [
        (str(path.parent.relative_to(tmp_path / "out")), read_metadata(path.parent), read_dataset(path.parent))
        for path in sorted((tmp_path / "out").rglob("samples-00000.parquet"))
    ]
    assert {
        name: (metadata.split, metadata.collection["driver"], metadata.collection["first_world"], len(data.worlds))
        for name, metadata, data in found
    } == {
        "round-0/training": ("training", "explorer", 0, 4),
        "round-0/training-toy": ("training", "explorer", 4, 2),
        "round-0/validation": ("validation", "explorer", 0, 2),
        "training": ("training", "potlp", 6, 2),
        "training-toy": ("training", "potlp", 8, 2),
        "explored": ("training", "explorer", 10, 2),
        "explored-toy": ("training", "explorer", 12, 2),
        "validation": ("validation", "potlp", 2, 2),
    }
    training = [data for _, metadata, data in found if metadata.split == "training"]
    made = load_estimator(tmp_path / "out" / ESTIMATOR)[3]
    assert made["panoramas"] == sum(len(data.images) for data in training)


def test_other_families_look_alike_and_have_subgoals_as_in_their_trials(tmp_path):
    given = {"environment": "delivery", "training_worlds": 4, "validation_worlds": 4}
    (tmp_path / "mine.yaml").write_text(
        json.dumps({**given, "beside": [{"environment": "campus-small", "share": 0.5}]})
    )
    recipe = read_recipe(tmp_path / "mine.yaml")
    own, _, other = next(_stages(recipe, [tmp_path])).parts
    assert (own.environment, other.environment, own.worlds, other.worlds) == ("delivery", "campus-small", 4, 4)
    for part in (own, other):
        wanted = trial_config_for(make(part.environment)).decision.frontiers
        assert part.config.frontiers == part.config.explorer.frontiers == wanted
    assert own.config.frontiers != other.config.frontiers
    (tmp_path / "mine.yaml").write_text(json.dumps({**given, "beside": [{"environment": "toy", "share": 0.5}]}))
    with pytest.raises(ConfigurationError, match="toy cannot stand beside delivery: its worlds are of toy with"):
        read_recipe(tmp_path / "mine.yaml")
    (tmp_path / "mine.yaml").write_text(json.dumps({**given, "beside": [{"environment": "campus-small", "share": 0}]}))
    with pytest.raises(ConfigurationError, match="share is 0"):
        read_recipe(tmp_path / "mine.yaml")


def test_families_that_cannot_be_joined_are_named_before_anything_is_collected(monkeypatch, tmp_path):
    class Fine(type(make("toy"))):
        """Of the same family and propositions, in metres."""

        def draw(self, key):
            return dataclasses.replace(super().draw(key), resolution=jnp.float32(0.25))

    monkeypatch.setattr(recipes, "make", lambda name: Fine() if name == "fine" else make(name))
    (tmp_path / "mine.yaml").write_text(json.dumps({**SMALL, "beside": [{"environment": "fine", "share": 1}]}))
    with pytest.raises(
        ConfigurationError, match=r"fine cannot stand beside toy: its cells measure 0\.25 metres.*1 cells"
    ):
        read_recipe(tmp_path / "mine.yaml")
    beside = [{"environment": "toy", "share": share} for share in (0.5, 1.0)]
    (tmp_path / "mine.yaml").write_text(json.dumps({**SMALL, "beside": beside}))
    with pytest.raises(ConfigurationError, match="toy stands beside toy twice: give one share for both"):
        read_recipe(tmp_path / "mine.yaml")


@pytest.mark.parametrize("named", [None, 30.0])
def test_other_families_are_sensed_as_in_their_trials_unless_the_recipe_names_a_sensor(monkeypatch, tmp_path, named):
    class NearSighted(type(make("toy"))):
        settings = Settings({"sensor": {"range_cells": 7.0}})

    monkeypatch.setattr(recipes, "make", lambda name: NearSighted() if name == "near" else make(name))
    collect = {**SMALL["collect"], **({} if named is None else {"explorer": {"sensor": {"range_cells": named}}})}
    given = {**SMALL, "collect": collect, "beside": [{"environment": "near", "share": 1}]}
    (tmp_path / "mine.yaml").write_text(json.dumps(given))
    own, _, other = next(_stages(read_recipe(tmp_path / "mine.yaml"), [tmp_path])).parts
    usual = trial_config_for(make("toy")).sensor.range_cells
    sensed = [part.config.explorer.sensor.range_cells for part in (own, other)]
    assert sensed == ([usual, 7.0] if named is None else [named, named])


def _potlp(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.mark.long
def test_the_commands_collect_and_fit_by_a_recipe(tmp_path):
    (tmp_path / "small.yaml").write_text(json.dumps(SMALL))
    told = _potlp("collect", "--recipe", tmp_path / "small.yaml", "--split", "validation", "--out", tmp_path / "data")
    assert told.exit_code == 0, told.stderr
    assert "views" in told.stdout
    assert read_metadata(tmp_path / "data").split == "validation"
    told = _potlp("fit", "--recipe", tmp_path / "small.yaml", "--out", tmp_path / "out", "--set", "network.fovea=2")
    assert told.exit_code == 0, told.stderr
    assert "ended by planned" in told.stdout
    _, config, _, metadata = load_estimator(tmp_path / "out" / ESTIMATOR)
    assert config.fovea == 2
    assert metadata["training"]["seed"] == SMALL["fit"]["training"]["seed"]
    assert (tmp_path / "out" / "curves.png").stat().st_size > 1000
    # The same worlds with the same settings: the dataset of the other command serves as well.
    again = _potlp("collect", "--recipe", tmp_path / "small.yaml", "--out", tmp_path / "out" / "training")
    assert again.exit_code == 0, again.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("collect",), "name an environment, or a recipe"),
        (("collect", "toy", "--recipe", "firefighting"), "one of the two"),
        (("collect", "toy"), "how many worlds"),
        (("collect", "toy", "--worlds", 4, "--set", "views=3"), "--set: unknown field 'views'"),
        (("collect", "mars", "--worlds", 4), "mars"),
        (("fit",), "give a DATASET and --validation, or a recipe"),
        (("fit", "data"), "another of other worlds"),
        (("fit", "data", "--validation", "other", "--processes", "2"), "a fit of a DATASET uses all cores by itself"),
        (
            ("fit", "data", "--validation", "other", "--initial", "mine.npz", "--set", "network.fovea=2"),
            "--initial keeps the network of its estimator as it is, but for own_within: leave out --set network",
        ),
        (("fit", "--recipe", "soup"), "neither a file nor one of those that are shipped"),
    ],
)
def test_what_is_wrong_with_a_command_is_named(tmp_path, arguments, message):
    told = _potlp(*arguments, "--out", tmp_path)
    assert told.exit_code == 2
    assert message in " ".join(told.stderr.split())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"worlds": 3}, "unknown field 'worlds'; known: environment, training_worlds"),
        ({"fit": {"epochs": 0}}, r"small\.yaml\.fit: epochs is 0; give at least 1"),
        ({"fit": {"training": {"steps": 5}}}, "fit.training: unknown field 'steps'"),
        ({"collect": {"camera": {"height": "tall"}}}, "collect.camera.height: give a whole number"),
    ],
)
def test_what_is_wrong_with_a_recipe_is_named(tmp_path, changes, message):
    (tmp_path / "small.yaml").write_text(json.dumps({**SMALL, **changes}))
    with pytest.raises(ConfigurationError, match=message):
        read_recipe(tmp_path / "small.yaml")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"worlds": 3}, "3 worlds are no whole shards of 2"),
        ({"drives": 0}, "drives is 0"),
        ({"epochs": 0}, "epochs is 0"),
    ],
)
def test_what_is_wrong_with_a_round_is_said_before_anything_is_collected(tmp_path, changes, message):
    given = {"worlds": 2, "validation_worlds": 2, "drives": 1, "epochs": 1, **changes}
    collect = {**SMALL["collect"], "worlds_per_shard": 2}
    (tmp_path / "small.yaml").write_text(json.dumps({**SMALL, "collect": collect, "rounds": [given]}))
    with pytest.raises(PotlpError, match=message):
        follow(read_recipe(tmp_path / "small.yaml"), tmp_path / "out")
    assert not list(tmp_path.glob("out/**/*.parquet"))


@pytest.mark.parametrize("words", [("--epochs", "3"), ("--set", "epochs=3")])
def test_epochs_are_not_of_one_stage_of_a_recipe_with_rounds_alone(tmp_path, words):
    rounds = [{"worlds": 2, "validation_worlds": 2, "epochs": 5}]
    (tmp_path / "small.yaml").write_text(json.dumps({**SMALL, "rounds": rounds}))
    told = _potlp("fit", "--recipe", tmp_path / "small.yaml", "--out", tmp_path / "out", *words)
    assert told.exit_code == 2
    assert "change `epochs` of `fit` and of each round in a copy of its file" in " ".join(told.stderr.split())
    assert not (tmp_path / "out").exists()


def test_minutes_are_of_the_fit_of_every_stage(tmp_path):
    rounds = [{"worlds": 2, "validation_worlds": 2, "epochs": 5}]
    fit = {**SMALL["fit"], "minutes": 30}
    (tmp_path / "small.yaml").write_text(json.dumps({**SMALL, "fit": fit, "rounds": rounds}))
    stages = _stages(read_recipe(tmp_path / "small.yaml"), [tmp_path] * 2)
    assert [(stage.fit.epochs, stage.fit.minutes) for stage in stages] == [(1, 30), (5, 30)]


def test_a_recipe_that_is_not_there_is_named_beside_those_that_are(tmp_path):
    with pytest.raises(ConfigurationError, match=rf"soup: neither a file nor .*{', '.join(SHIPPED)}"):
        read_recipe("soup")
    (tmp_path / "empty.yaml").write_text("environment: toy")
    with pytest.raises(ConfigurationError, match="training_worlds, validation_worlds is missing"):
        read_recipe(tmp_path / "empty.yaml")
