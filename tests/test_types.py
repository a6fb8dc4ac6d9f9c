"""The glossary of dimension names against the annotations of the package, and status bits on the device."""

import ast
import re
from collections import defaultdict
from pathlib import Path

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from beartype import beartype

import potlp_jax
from potlp_jax import types
from potlp_jax.types import Status, status_array, status_if, status_names, status_of

PACKAGE = Path(potlp_jax.__file__).parent
ENTRY = re.compile(r"(?P<names>\w+(?:, \w+)*) {2,}\S")
"""A line of the glossary: names, at least two spaces, the meaning. Titles of its parts have no meaning."""


def glossary() -> list[str]:
    """The names that the table in the docstring of ``types`` explains, in its order."""
    _, table, _ = re.split(r"^=+ +=+$", types.__doc__ or "", flags=re.MULTILINE)
    entries = [ENTRY.match(line) for line in table.splitlines()]
    return [name for entry in entries if entry for name in entry["names"].split(", ")]


def names_of(shape: str) -> set[str]:
    """Names of single dimensions in a shape of jaxtyping: no sizes, no anonymous axes, nothing behind a star."""
    return {token.lstrip("#?") for token in shape.split() if re.fullmatch(r"[#?]*[A-Za-z]\w*", token)}


def annotations() -> dict[str, set[str]]:
    """Every dimension name of the package with the files that use it."""
    found = defaultdict(set)
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if not (isinstance(node, ast.Subscript) and isinstance(node.value, ast.Name | ast.Attribute)):
                continue
            name = node.value.id if isinstance(node.value, ast.Name) else node.value.attr
            entries = node.slice.elts if isinstance(node.slice, ast.Tuple) else []
            if hasattr(jaxtyping, name) and len(entries) == 2 and isinstance(entries[1], ast.Constant):
                for dimension in names_of(str(entries[1].value)):
                    found[dimension].add(str(path.relative_to(PACKAGE)))
    return found


def test_the_glossary_explains_every_dimension_name_and_no_other():
    explained, used = glossary(), annotations()
    assert len(explained) == len(set(explained)), "a name is explained twice"
    missing = {name: sorted(files) for name, files in used.items() if name not in explained}
    assert not missing, "add these names to the glossary in potlp_jax/types.py, or use one that is there"
    assert not set(explained) - set(used), "the package does not use these names any more"


def test_names_are_read_from_shapes():
    assert names_of("*batch H W 3") == {"H", "W"}
    assert names_of(" Z") == {"Z"}
    assert names_of("_ #n ... 2") == {"n"}
    assert {"H", "W", "Z"} <= set(annotations())


def test_names_of_status_bits_are_read_back():
    assert status_names(0) == ()
    assert status_of([]) == 0
    for bits in range(2 * max(Status)):
        # Numbers with a bit that nothing means have no name for it.
        known = bits & sum(Status)
        assert status_of(status_names(known)) == known
    with pytest.raises(KeyError):
        status_of(["lost"])


def test_status_bits_are_distinct_and_combine_on_the_device():
    assert len({int(bit) for bit in Status}) == len(list(Status))
    assert all(int(bit).bit_count() == 1 for bit in Status)
    combine = jax.jit(lambda full, dead: status_if(full, Status.TREE_OVERFLOW) | status_if(dead, Status.DEAD_END))
    for full in (False, True):
        for dead in (False, True):
            wanted = (Status.TREE_OVERFLOW if full else Status.OK) | (Status.DEAD_END if dead else Status.OK)
            found = combine(jnp.asarray(full), jnp.asarray(dead))
            assert found.dtype == np.uint32
            assert Status(int(found)) == wanted
    assert int(status_array(Status.FALLBACK)) == Status.FALLBACK


def test_a_function_within_a_function_is_checked_at_each_call_by_one_checker():
    """The checkers that ``conftest.py`` reuses know the sizes of no earlier call, and are not written anew."""
    written = []

    def typechecker(function):
        written.append(function.__name__)
        return beartype(function)

    def turned(image):
        @jaxtyping.jaxtyped(typechecker=typechecker)
        def turn(image: jaxtyping.Float32[jax.Array, "H W"]) -> jaxtyping.Float32[jax.Array, "W H"]:
            return image

        return turn(image)

    for size in (2, 3):
        assert turned(jnp.zeros((size, size), jnp.float32)).shape == (size, size)
    once = len(written)
    with pytest.raises(jaxtyping.TypeCheckError, match="turn"):
        turned(jnp.zeros((2, 3), jnp.float32))
    with pytest.raises(jaxtyping.TypeCheckError, match="turn"):
        turned(jnp.zeros((2, 2), jnp.int32))
    # Of the arguments, and of these and the result.
    assert (once, written.count("turn")) == (2, 2)
