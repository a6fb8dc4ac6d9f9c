"""Measuring, memory known in advance, the cache of compiled programs, and `potlp bench` and `potlp export`."""

import dataclasses
import json
import os
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from typer.testing import CliRunner

from eval.bench import regret
from potlp_jax.bench.memory import tree_memory
from potlp_jax.bench.perception import measure_perception
from potlp_jax.bench.planner import as_dict, make_scene, mean_depth, measure_distances
from potlp_jax.bench.problems import family_problem
from potlp_jax.bench.timing import Timing, compile_call, environment, measure, timed_runs
from potlp_jax.cache import LOG_LEVEL, SWITCH, cache_folder, enable_compilation_cache, machine_fingerprint
from potlp_jax.cli import app
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import Split, world_key
from potlp_jax.environments.toy import Toy
from potlp_jax.learning.estimator import TrainedEstimator
from potlp_jax.learning.network import EstimatorNetwork, NetworkConfig
from potlp_jax.planning.exact.api import solve_exact
from potlp_jax.planning.search.api import search_tree
from potlp_jax.planning.search.config import BestFirstConfig
from potlp_jax.planning.situation import DecisionConfig
from potlp_jax.task.task import Task
from potlp_jax.trials.config import TrialConfig, trial_config_for
from potlp_jax.world.frontiers import FrontierConfig
from tests.reference.domains import domain_of

QUICK = BestFirstConfig(simulations=12)


def _potlp(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def _run(program, **variables):
    """A fresh process on one core's worth of imports; returns what it printed as JSON."""
    # Importing jax, as this process has, sets a log level of its own for all processes below.
    inherited = {name: value for name, value in os.environ.items() if name != LOG_LEVEL}
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, env={**inherited, **variables}
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout), done.stderr


@pytest.fixture(scope="module")
def problem():
    return family_problem("find", 2, "tuning", 0)


@pytest.fixture(scope="module")
def tree(problem):
    return jax.jit(search_tree, static_argnums=2)(problem, jax.random.key(0), QUICK)[1]


@pytest.fixture(scope="module")
def scene():
    toy = Toy()
    task = Task.from_formula(toy.tasks["1"], toy.propositions)
    return make_scene(toy.generate(world_key(Split.VALIDATION, 0, toy.name)), task, observations=1)


def test_a_measurement_runs_the_function_and_keeps_phases_apart():
    calls = []

    def traced(values, power):
        calls.append(power)
        return values**power

    timing = measure(traced, jnp.arange(4.0), 3, repeats=4, static_argnums=1)
    assert calls == [3]
    assert len(timing.runs_s) == 4
    assert timing.compile_s > 0
    assert timing.trace_s > 0
    assert min(timing.runs_s) > 0


def test_a_compiled_call_computes_what_the_function_computes():
    call = compile_call(
        lambda first, factor, second: first * factor + second["x"], jnp.ones(3), 2, {"x": jnp.ones(3)}, static_argnums=1
    )
    np.testing.assert_array_equal(call.run(), 3 * np.ones(3))


def test_the_same_function_is_compiled_anew_for_each_measurement():
    calls = []

    def traced(values):
        calls.append(1)
        return values + 1.0

    for _ in range(2):
        compile_call(traced, jnp.zeros(2))
    assert len(calls) == 2


def test_a_run_ends_when_its_results_are_ready():
    slow = timed_runs(lambda: time.sleep(0.02), 3)
    assert len(slow) == 3
    assert min(slow) >= 0.02


def test_a_timing_reports_the_median_and_the_spread():
    timing = Timing(trace_s=1.0, compile_s=2.0, runs_s=(5.0, 1.0, 3.0), memory=None)
    assert timing.run_s == 3.0
    told = timing.as_dict()
    assert (told["run_s"], told["run_min_s"], told["run_max_s"], told["repeats"]) == (3.0, 1.0, 5.0, 3)
    with pytest.raises(ValueError, match="repeats is 0"):
        measure(lambda: jnp.zeros(1), repeats=0)


def test_memory_of_a_tree_from_shapes_is_what_a_search_allocates(problem, tree):
    told = tree_memory(problem, QUICK)
    assert told.total == sum(leaf.nbytes for leaf in jax.tree.leaves(tree))
    assert told.nodes == QUICK.capacity
    assert told.arrays["q_values"] == tree.q_values.nbytes


def test_memory_of_a_tree_too_large_to_allocate_is_told(problem):
    small = tree_memory(problem, dataclasses.replace(QUICK, tree_capacity=2**10))
    large = tree_memory(problem, dataclasses.replace(QUICK, tree_capacity=2**24))
    assert large.total == pytest.approx(2**14 * small.total, rel=0.01)


def test_mean_depth_is_actions_per_simulation():
    assert mean_depth(np.array([30, 10]), np.array([10, 10])) == 2.0
    assert mean_depth(None, np.array([10, 10])) is None


def test_phases_of_perception_and_decision(scene):
    config = NetworkConfig(
        propositions=Toy().propositions, first_widths=(4,) * 4, second_widths=(4,) * 8, dense_widths=(8,) * 4
    )
    params = EstimatorNetwork(config).init(jax.random.key(0))
    trained = TrainedEstimator(
        params=params, config=config, domain=domain_of("rooms"), metadata={}, name="tiny", digest=""
    )
    decision = DecisionConfig(frontiers=FrontierConfig(max_subgoals=2), search=QUICK)
    rows = measure_perception(scene, trained, TrialConfig(decision=decision), repeats=1)
    phases = [row.phase for row in rows]
    assert phases[:3] == ["render", "encode", "remember"]
    # What `measure_decision` measures, whatever the estimator.
    assert phases[3:] == ["assess", "estimates", "travel", "search", "path", "whole"]
    for row in rows:
        assert json.loads(json.dumps(as_dict(row), allow_nan=False))["run_s"] > 0


def test_distances_are_measured_on_the_true_map(scene):
    row = measure_distances(scene, sources=2, repeats=1)
    assert row.sources == 2
    assert 0 < row.reached <= 1
    assert json.loads(json.dumps(as_dict(row), allow_nan=False))["run_s"] > 0


def test_perception_needs_an_estimator():
    told = _potlp("bench", "--parts", "perception", "--environment", "toy", "--repeats", 1)
    assert told.exit_code == 2
    assert "no estimator is shipped" in told.stderr


def test_decisions_are_measured_with_the_settings_of_the_worlds(monkeypatch):
    asked = []

    def make_scene(world, task, sensor):
        asked.append(sensor)

    def measure_decision(scene, decision, repeats):
        asked.append(decision)
        return []

    monkeypatch.setattr("potlp_jax.bench.planner.make_scene", make_scene)
    monkeypatch.setattr("potlp_jax.bench.planner.measure_decision", measure_decision)
    monkeypatch.setattr("potlp_jax.cli.bench._print", lambda rows, where: None)
    told = _potlp("bench", "--parts", "decision", "--environment", "delivery", "--simulations", 12)
    assert told.exit_code == 0, told.output
    config = trial_config_for(make("delivery"))
    assert config.decision.frontiers.max_subgoals == 64
    search = dataclasses.replace(config.decision.search, simulations=12)
    assert asked == [config.sensor, dataclasses.replace(config.decision, search=search)]


def test_environment_says_where_it_was_measured():
    told = environment()
    assert told["jax"] == jax.__version__
    assert told["platform"] == jax.devices()[0].platform
    assert 1 <= told["usable_cores"] <= told["cores"]
    assert told["threads"] == ("one" if told["usable_cores"] == 1 else "default")


def test_bench_prints_json(problem):
    told = _potlp(
        *("bench", "--parts", "search", "--family", "find", "--subgoals", 2, "--batches", "2"),
        *("--simulations", 12, "--repeats", 1, "--json"),
    )
    assert told.exit_code == 0, told.stderr
    (row,) = json.loads(told.stdout)["rows"]["search"]
    assert (row["batch"], row["actions"], row["simulations"]) == (2, problem.action_count, 12)
    assert row["tree_bytes"] == tree_memory(problem, dataclasses.replace(DecisionConfig().search, simulations=12)).total
    assert row["batch_tree_bytes"] == 2 * row["tree_bytes"]
    assert 0 < row["simulations_run"] <= 2 * 12
    assert row["simulations_per_s"] == pytest.approx(row["simulations_run"] / row["run_s"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("bench", "--parts", "everything"), "everything"),
        (("bench", "--batches", "1,x"), "1,x"),
        (("bench", "--family", "none"), "three-single"),
        (("export", "F a", "--height", "5", "--out", "out"), "--width"),
        (("export", "F a", "--batch", "some", "--out", "out"), "some"),
        (("export", "F a", "--batch", "²", "--out", "out"), "--batch '²': give a number"),
        (("export", "F a", "--platforms", "abacus", "--out", "out"), "abacus"),
    ],
)
def test_wrong_input_is_named(arguments, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    told = _potlp(*arguments)
    assert told.exit_code == 2
    assert message in told.stderr


def test_export_writes_the_search(tmp_path):
    pytest.importorskip("flatbuffers", reason="jax writes exported programs with flatbuffers")
    told = _potlp(
        *("export", "F a", "--subgoals", 1, "--simulations", 4, "--platforms", "cpu", "--out", tmp_path, "--json")
    )
    assert told.exit_code == 0, told.stderr
    manifest = json.loads(told.stdout)["manifest"]
    assert list(manifest["functions"]) == ["plan"]
    assert manifest["config"]["decision"]["search"]["simulations"] == 4
    assert {path.name for path in tmp_path.iterdir()} == {"plan.jaxexport", "task.hoa", "manifest.json"}


def test_importing_the_package_leaves_the_cache_off(tmp_path):
    told, _ = _run(
        "import json, jax, potlp_jax, potlp_jax.cli\nprint(json.dumps(jax.config.values['jax_compilation_cache_dir']))",
        XDG_CACHE_HOME=str(tmp_path),
    )
    assert told is None


CACHED = """
from potlp_jax.cache import enable_compilation_cache
folder = enable_compilation_cache()
import json, jax
hits = []
jax.monitoring.register_event_listener(lambda event, **_: hits.append(event.endswith("/cache_hits")))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
from potlp_jax.bench.problems import family_problem
from potlp_jax.planning.search.api import plan_actions
from potlp_jax.planning.search.config import BestFirstConfig
problem = family_problem("find", 2, "tuning", 0)
plan = jax.jit(plan_actions, static_argnums=2)(problem, jax.random.key(0), BestFirstConfig(simulations=12))
print(json.dumps({"folder": str(folder), "hits": sum(hits), "q": repr(plan.q_values.tolist())}))
"""


@pytest.mark.long
def test_a_second_process_finds_what_the_first_compiled(tmp_path):
    first, _ = _run(CACHED, XDG_CACHE_HOME=str(tmp_path))
    second, said = _run(CACHED, XDG_CACHE_HOME=str(tmp_path))
    assert first["folder"].startswith(str(tmp_path))
    assert second["hits"] > first["hits"]
    assert second["q"] == first["q"]
    assert "prefer-no-" not in said
    third, said = _run("import jax\n" + CACHED, XDG_CACHE_HOME=str(tmp_path))
    assert third["hits"] == second["hits"]
    assert "prefer-no-" not in said


def test_the_switch_turns_the_cache_off(tmp_path, monkeypatch):
    monkeypatch.setenv(SWITCH, "1")
    assert enable_compilation_cache(tmp_path) is None


@pytest.fixture
def no_cache_yet():
    """As in a process that has been given no cache."""
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", None)
    yield
    jax.config.update("jax_compilation_cache_dir", before)


@pytest.mark.usefixtures("no_cache_yet")
def test_a_folder_that_others_may_write_to_is_not_used(tmp_path, monkeypatch):
    monkeypatch.delenv(SWITCH, raising=False)
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    tmp_path.chmod(0o777)
    assert enable_compilation_cache(tmp_path) is None
    file = tmp_path / "file"
    file.touch()
    assert enable_compilation_cache(file / "below") is None


def test_each_kind_of_machine_has_its_own_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    here = machine_fingerprint()
    assert cache_folder() == tmp_path / "potlp-jax" / here
    monkeypatch.setattr("platform.machine", lambda: "another")
    assert machine_fingerprint() != here


def test_what_a_processor_can_do_decides_on_its_folder(tmp_path, monkeypatch):
    told = "processor\t: {}\ncpu family\t: 6\nmodel\t\t: 143\nmodel name\t: A processor\ncpu MHz\t: {}\nflags\t: {}\n"

    def fingerprint(*processors):
        file = tmp_path / "cpuinfo"
        file.write_text("".join(told.format(number, *found) for number, found in enumerate(processors)))
        monkeypatch.setattr("potlp_jax.cache._PROCESSORS", file)
        return machine_fingerprint()

    known = fingerprint((2600, "fpu avx avx2"))
    # Neither how many there are nor how fast they run at the moment.
    assert fingerprint((800, "fpu avx avx2"), (900, "fpu avx avx2")) == known
    assert fingerprint((2600, "fpu avx avx2 avx512f")) != known
    told = told.replace("143", "85")
    assert fingerprint((2600, "fpu avx avx2")) != known


def test_the_regret_of_our_search_is_of_its_own_choices_and_ends():
    """In groups of one and of two rows, the last one not full: all end at the optimum, and few simulations end none."""
    problems = [family_problem("two", 2, "tuning", index) for index in range(3)]
    optima = [solve_exact(problem).q_values for problem in problems]
    for most_bytes in (1, 2 * tree_memory(problems[0], BestFirstConfig(simulations=3000)).total):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(regret, "TREE_BYTES", most_bytes)
            few, many = regret.ours("best-first")(problems, [1, 3000])
        assert (few[:2], many[:2]) == (("best-first", 1), ("best-first", 3000))
        assert not any(few[4])
        assert all(many[4])
        for action, q_values in zip(many[3], optima, strict=True):
            np.testing.assert_allclose(q_values[action], q_values.min(), rtol=1e-5)


def test_the_goal_counts_from_where_it_is_kept():
    from eval.bench.regret_report import Row, time_to_goal

    def row(budget, percent):
        of_instance = ([0], [percent], [percent], [True], [0.0], [False])
        return Row("test", "find", 1, "best-first", budget, float(budget), *of_instance)

    assert time_to_goal([row(1, 0.5), row(10, 3.0), row(100, 0.9), row(1000, 0.1)]) == 100.0
    assert time_to_goal([row(1, 0.5), row(10, 3.0)]) == np.inf


def test_regrets_are_summed_up_by_subgoals_and_by_budget():
    from eval.bench.regret_report import Row, by_budget, by_subgoals

    def row(family, subgoals, budget, percent, ended):
        exact, zeros = [True, True, False], [0.0] * 3
        return Row("test", family, subgoals, "best-first", budget, 1.0, [0, 1, 2], percent, zeros, exact, zeros, ended)

    rows = [
        row("find", 2, 30, [9.0, 9.0, 9.0], [False] * 3),
        row("find", 2, 300, [0.0, 1.0, 2.0], [True, True, False]),
        row("find", 4, 300, [3.0, 3.0, 3.0], [False, True, True]),
        row("two", 4, 300, [0.0, 0.0, 0.0], [True] * 3),
    ]
    lines = by_subgoals(rows, 300).splitlines()
    assert lines[0] == "| family | S = 2 | S = 4 | exact |"
    assert lines[2:] == ["| find | 1 (2) | 3 (3) | 4 of 6 |", "| two | – | 0 (0) | 2 of 3 |"]
    lines = by_budget([row for row in rows if row.family == "find"]).splitlines()
    assert lines[0] == "| family | 30 | 300 | ended at the last, wrong |"
    # Of the four that ended one has no exact truth, and one was right.
    assert lines[2].startswith("| find | 9 (9 to 9) | 2 (")
    assert lines[2].endswith("| 4 of 6, 2 |")
    assert lines[3].startswith("| all | 9 (9 to 9) | 2 (")


def test_planners_stand_beside_each_other():
    from eval.bench.regret_report import Row, beside, rates, times_as_fast

    def row(family, planner, budget, percent, ms):
        of_instance = ([0, 1], [percent, percent], [0.0, 0.0], [True, True], [0.0, 0.0], [False, False])
        return Row("test", family, 8, planner, budget, ms, *of_instance)

    rows = [
        row("find", "best-first", 300, 0.5, 2.0),
        row("find", "best-first", 1000, 0.0, 4.0),
        row("find", "mctx", 300, 7.0, 10.0),
        row("two", "best-first", 300, 2.5, 3.0),
        row("two", "best-first", 1000, 1.0, 5.0),
        row("two", "mctx", 300, 0.25, 40.0),
    ]
    lines = beside(rows).splitlines()
    assert lines[0] == "| family | best-first, 300 and 1,000 | within 1 %, ms | mctx, 300 and 300 | within 1 %, ms |"
    assert lines[2] == "| find | 0.5 and 0 | 1 of 1, 2 | 7 and 7 | 0 of 1 |"
    assert lines[3] == "| two | 2.5 and 1 | 1 of 1, 5 | 0.25 and 0.25 | 1 of 1, 40 |"
    assert lines[4] == "| all | 1.5 and 0.5 | 2 of 2, 3.5 | 3.6 and 3.6 | 1 of 2, 40 |"
    assert list(times_as_fast(rows)) == ["- best-first is 8 times as fast as mctx (geometric mean of 1 groups)"]
    assert rates(rows).splitlines()[2:] == ["| find | 500 (300) | – |", "| two | 200 (1,000) | 25 (300) |"]


def test_runs_on_two_devices_are_compared_trial_by_trial():
    from eval.bench.accelerator import agreement

    def found(costs, decisions):
        return {
            "rows": [{"part": "search"}, {"part": "trials", "policy": "potlp", "costs": costs, "decisions": decisions}]
        }

    mine, its = found([10.0, 20.0, 30.0], [3, 4, 5]), found([10.0, 20.0, 33.0], [3, 5, 5])
    assert list(agreement(mine, its)) == ["potlp: 1 of 3 trials the same, mean cost 20.00 and 21.00"]
