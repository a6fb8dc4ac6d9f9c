"""What a family of worlds needs of settings comes with every world, and cannot be forgotten silently."""

import dataclasses
import json
import pickle
import warnings

import jax
import pytest

from potlp_jax.codec import settings_from_words
from potlp_jax.environments.campus.delivery import Delivery
from potlp_jax.environments.toy import Toy
from potlp_jax.errors import BatchError, PotlpWarning
from potlp_jax.trials.batch import Start, run_batch
from potlp_jax.trials.config import TrialConfig, trial_config_for
from potlp_jax.trials.loop import run_trial
from potlp_jax.world.grid import pad_world, world_from_dict, world_to_dict
from potlp_jax.world.settings import NO_SETTINGS, Settings

FEW = {"decision": {"frontiers": {"max_subgoals": 5}}, "replan_distance": 2.0}


class Needy(Toy):
    """Toy worlds whose trials call for few subgoals."""

    settings = Settings(FEW)


def test_settings_are_values():
    one, other = Settings(FEW), Settings(dict(reversed(FEW.items())))
    assert one == other == FEW
    assert hash(one) == hash(other)
    assert pickle.loads(pickle.dumps(one)) == one
    assert Settings(json.loads(json.dumps(one.to_dict()))) == one
    within = Settings({"cameras": [{"range_cells": 4}, 2]})
    assert json.loads(json.dumps(within.to_dict())) == {"cameras": [{"range_cells": 4}, 2]}
    assert hash(Settings({"colour": [1, 2]})) == hash(Settings({"colour": (1, 2)}))
    assert one != NO_SETTINGS


def test_worlds_carry_the_propositions_and_settings_of_their_family():
    generator = Delivery.toy()
    world = generator.world(0)
    assert world.propositions == ("professor", "grad", "undergrad")
    assert world.settings == generator.settings
    again = world_from_dict(json.loads(json.dumps(world_to_dict(world))))
    padded = pad_world(world, 70, 80)
    assert again.settings == padded.settings == generator.settings
    assert again.propositions == padded.propositions == world.propositions
    # Static: they are no arrays, and survive what is done to these.
    moved = jax.jit(lambda world: dataclasses.replace(world, start=world.start + 0))(world)
    assert moved.settings == generator.settings


def test_a_trial_without_a_configuration_has_what_its_world_calls_for():
    generator = Needy()
    world, task = generator.world(0), generator.task(1)
    trial = run_trial(world, task, "baseline", jax.random.key(0))
    assert trial.config["decision"]["frontiers"]["max_subgoals"] == 5
    assert trial.config == dataclasses.asdict(trial_config_for(generator))
    with pytest.warns(PotlpWarning, match=r"calls for decision.frontiers.max_subgoals=5, and"):
        run_trial(world, task, "baseline", jax.random.key(0), TrialConfig(replan_distance=3.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error", PotlpWarning)
        run_trial(world, task, "baseline", jax.random.key(0), dataclasses.replace(trial_config_for(world)))


def test_a_batch_has_what_its_worlds_call_for_and_takes_no_others():
    needy, toy = Needy(), Toy()
    arrays, key = toy.task(1).arrays, jax.random.key(0)
    with pytest.warns(PotlpWarning, match="replan_distance=2.0"):
        list(run_batch([Start(needy.world(0), arrays, key)], "baseline", TrialConfig()))
    with pytest.raises(BatchError, match="its world has the settings"):
        list(run_batch([Start(toy.world(0), arrays, key), Start(needy.world(0), arrays, key)], "baseline"))


def test_tasks_of_a_family_are_over_its_propositions():
    generator = Toy()
    assert generator.task(2).text == generator.task("2").text == "!hazard U goal"
    assert generator.task("F hazard").propositions == generator.propositions
    with pytest.raises(ValueError, match=r"toy has no task 3; it has: 1 \(F goal\), 2 "):
        generator.task(3)


@pytest.mark.parametrize(
    ("text", "value"), [("1e-3", 1e-3), ("2E5", 2e5), ("-1.e2", -100.0), ("1e3x", "1e3x"), ("12", 12)]
)
def test_numbers_with_an_exponent_are_numbers(text, value):
    found = settings_from_words([f"training.rate={text}"])["training"]["rate"]
    assert found == value
    assert type(found) is type(value)
