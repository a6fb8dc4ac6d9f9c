"""Programs of callers' own classes: jax takes two dataclasses of as many fields for one structure."""

import ast
import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import pytest

import potlp_jax
from potlp_jax.compiling import jit_by_class

PACKAGE = Path(potlp_jax.__file__).parent

# One pair of classes in a hundred is confused by `jax.jit`: among so many one is, nearly surely.
MANY = 300


def class_with(number: int) -> type:
    """A pytree of one field; its class knows a number that its fields do not."""
    made = dataclasses.make_dataclass("Kind", [("value", Any)])
    made.number = number
    return jax.tree_util.register_dataclass(made)


KINDS = [class_with(number) for number in range(MANY)]


def number_of(kind, more=0, *, sign: int = 1):
    return kind.value * 0 + sign * kind.number + more


@pytest.mark.parametrize("within", [lambda kind: kind, lambda kind: {"members": (kind, 1.0)}])
def test_programs_of_two_classes_are_told_apart(within):
    compiled = jit_by_class(
        lambda given: number_of(jax.tree.leaves(given, is_leaf=lambda leaf: type(leaf) in KINDS)[0])
    )
    value = jnp.int32(1)
    assert [int(compiled(within(kind(value)))) for kind in KINDS] == list(range(MANY))
    assert compiled._cache_size() == MANY
    # None is compiled again.
    assert int(compiled(within(KINDS[7](value)))) == 7
    assert compiled._cache_size() == MANY


def test_what_comes_back_is_of_the_class_that_was_given():
    compiled = jit_by_class(lambda kind: dataclasses.replace(kind, value=kind.value + 1))
    assert all(type(compiled(kind(jnp.int32(0)))) is kind for kind in KINDS)


def test_static_and_donated_arguments_are_those_of_jax():
    compiled = jit_by_class(number_of, static_argnames=("sign",), donate_argnums=(0,))
    given = KINDS[5](jnp.int32(1))
    assert int(compiled(given, 2, sign=-1)) == -3
    assert int(compiled(KINDS[5](jnp.int32(1)), more=2, sign=1)) == 7
    assert compiled._cache_size() == 2
    assert compiled.__name__ == "number_of"


def test_a_structure_without_classes_is_still_what_jax_compares():
    """Where this fails jax tells classes apart by itself, and ``jit_by_class`` can go."""
    first, second = (jax.tree.structure(kind(0)) for kind in KINDS[:2])
    assert first == second
    assert hash(first) != hash(second)


def names_of_callers_pytrees(function: ast.FunctionDef) -> set[str]:
    arguments = function.args
    return {found.arg for found in (*arguments.args, *arguments.kwonlyargs)} & {
        "estimator",
        "asked",
        "memory",
        "slots",
        "by",
        "seen",
        "observer",
    }


def test_functions_that_are_given_estimators_are_compiled_by_class():
    wrong = []
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef) and names_of_callers_pytrees(node):
                compiled = [ast.unparse(decorator) for decorator in node.decorator_list]
                wrong += [f"{path.name}: {node.name}" for text in compiled if "jax.jit" in text]
            elif isinstance(node, ast.Call) and ast.unparse(node).startswith("jax.jit(decide"):
                wrong.append(f"{path.name}: {ast.unparse(node)}")
    assert not wrong
