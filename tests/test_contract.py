"""The names and signatures that code outside of this repository relies on."""

import ast
import inspect
import pickle
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import potlp_jax
from potlp_jax.environments.families import FAMILIES
from potlp_jax.environments.registry import make


def _parameters(function):
    return list(inspect.signature(function).parameters)


def test_public_names_exist_and_have_docstrings():
    for name in potlp_jax.__all__:
        value = getattr(potlp_jax, name)
        assert name in ("NO_ACTION", "__version__") or inspect.getdoc(value), name
        assert name in dir(potlp_jax)


def test_importing_the_package_loads_nothing_heavy():
    script = "import sys, potlp_jax; print(*{name.split('.')[0] for name in sys.modules}); potlp_jax.__version__"
    loaded = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True).stdout.split()
    assert not {"jax", "numpy", "flax", "scipy", "matplotlib"} & set(loaded)


def test_type_checkers_see_the_names_that_there_are():
    block = next(node for node in ast.parse(Path(potlp_jax.__file__).read_text()).body if isinstance(node, ast.If))
    seen = {
        alias.asname: f"{node.module}.{alias.name}"
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert seen == {name: f"potlp_jax.{module}.{name}" for name, module in potlp_jax._HOME.items()}
    assert sorted(potlp_jax.__all__) == sorted([*seen, "__version__"])


def test_an_unknown_name_is_no_attribute():
    with pytest.raises(AttributeError, match="no attribute 'plan_everything'"):
        _ = potlp_jax.plan_everything


@pytest.mark.parametrize(
    ("function", "parameters"),
    [
        (potlp_jax.Task.from_formula, ["text", "propositions", "max_positive_literals"]),
        (potlp_jax.Task.from_hoa, ["text", "propositions"]),
        (potlp_jax.product_transitions, ["task", "letters", "known_free"]),
        (potlp_jax.plan_actions, ["problem", "key", "config"]),
        (potlp_jax.solve_exact, ["problem"]),
        (potlp_jax.run_trial, ["world", "task", "policy", "key", "config"]),
    ],
)
def test_signatures_begin_as_promised(function, parameters):
    assert _parameters(function)[: len(parameters)] == parameters


def test_a_problem_is_made_from_arrays_and_planned_inside_jit():
    task = potlp_jax.Task.from_formula("F a")
    states, (subgoals, classes) = len(task.dfa.accepting), (2, len(task.classes))

    @jax.jit
    def plan(success_probability, key):
        problem = potlp_jax.PlanningProblem.from_arrays(
            task.arrays,
            travel=jnp.full((subgoals + 1, states, subgoals, states), 3.0),
            finish=jnp.full((subgoals + 1, states), jnp.inf),
            success_probability=success_probability,
            success_cost=jnp.full((subgoals, classes), 2.0),
            failure_cost=jnp.full((subgoals, classes), 5.0),
            dfa_state=jnp.int32(task.dfa.initial),
            subgoal_mask=jnp.ones(subgoals, bool),
            dead_end_cost=jnp.float32(100.0),
        )
        assert potlp_jax.enumerate_actions(problem).shape == (subgoals, len(task.edges))
        return potlp_jax.plan_actions(problem, key, potlp_jax.BestFirstConfig(simulations=50))

    result = plan(jnp.array([[0.2], [0.9]]), jax.random.key(0))
    assert int(result.action) == 1 * len(task.edges) + 0
    assert (int(result.subgoal), int(result.from_state), int(result.to_state)) == (1, *task.edges[0])
    # 3 to the subgoal; succeed with 0.9 for 2; else 5, back and over to the other (5 + 3), and 0.2 there.
    failed = 5 + 5 + 3 + 0.2 * 2 + 0.8 * (5 + 100)
    assert float(result.value) == pytest.approx(3 + 0.9 * 2 + 0.1 * failed, rel=1e-5)
    assert np.isinf(np.asarray(result.q_values)[-1])
    assert int(result.status) == 0


@pytest.mark.parametrize("name", [name for name in FAMILIES if ":" not in name])
def test_generators_go_to_other_processes(name):
    generator = make(name)
    copy = pickle.loads(pickle.dumps(generator))
    assert (copy.name, copy.propositions, copy.tasks) == (generator.name, generator.propositions, generator.tasks)
