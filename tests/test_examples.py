"""Every program in ``examples`` runs, and says what its description promises."""

import importlib
from pathlib import Path

import pytest

import examples

EXAMPLES = sorted(path.stem for path in Path(examples.__file__).parent.glob("*.py") if path.stem != "__init__")


@pytest.fixture
def output(request, capsys):
    importlib.import_module(f"examples.{request.param}").main()
    return capsys.readouterr().out


def test_every_example_has_a_test():
    tested = {mark.args[1][0] for test in globals().values() for mark in getattr(test, "pytestmark", [])}
    assert sorted(tested) == EXAMPLES


def example(name):
    return pytest.mark.parametrize("output", [name], indirect=True)


def costs(line):
    """The numbers after the colon."""
    return [float(text) for text in line.partition(":")[2].replace(",", " ").split()]


@example("run_a_trial")
def test_run_a_trial(output):
    baseline, oracle = output.splitlines()
    assert baseline.startswith("baseline: satisfied, cost")
    assert oracle.startswith("oracle: satisfied, cost")


@example("plan_from_arrays")
def test_plan_from_arrays(output):
    frontiers, chosen = output.splitlines()
    assert "the robot is at (5, 2)" in frontiers
    # The upper frontier, because the exit is more likely to be beyond it.
    assert chosen.startswith("go to [1, 7]") or chosen.startswith("go to [2, 7]")


@example("own_environment")
def test_own_environment(output):
    baseline, oracle = map(costs, output.splitlines())
    assert len(baseline) == len(oracle) == 4
    assert sum(oracle) < sum(baseline), "the oracle never takes the wrong side"


@example("own_camera")
def test_own_camera(output):
    assert output.startswith("32 x 128 pixels, grey levels ")


@example("learn_to_explore")
def test_learn_to_explore(output):
    ended, mean = output.strip().split("; mean return ")
    assert ended == "8 of 8 episodes ended"
    assert float(mean) < 0.0


@example("own_policy")
def test_own_policy(output):
    baseline, own = map(costs, output.splitlines())
    assert len(baseline) == len(own) == 3


@example("own_estimator")
def test_own_estimator(output):
    assert output.startswith("satisfied, cost ")
    chances = costs(output.partition("; ")[2])
    assert chances
    assert all(0.0 < chance < 1.0 for chance in chances)


@example("own_robot")
def test_own_robot(output):
    found, end = output.splitlines()
    assert found.startswith("satisfied after ")
    assert "ended at (5, 13)" in end
