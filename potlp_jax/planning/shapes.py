"""Shapes and types of arrays, checked while tracing.

The native kernels read memory by these shapes, and the search's kernel by these types too: nothing is left to
broadcasting or conversion. Nothing of a check is part of the traced program.
"""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from potlp_jax.errors import ProblemError
from potlp_jax.precision import narrow_type
from potlp_jax.task.task import TaskArrays

_SIZES = {
    "state_mask": "Z",
    "edge_mask": "E",
    "class_mask": "C",
    "condition_mask": "M",
    "transitions": "Z L",
    "class_phi": "C 2 P",
    "condition_classes": "M K",
}
"""Arrays of a task whose last axes are the sizes that the annotations of all its arrays speak of."""


def check_task(task: TaskArrays, batch: tuple[int, ...] = ()) -> dict[str, int]:
    """Check that the arrays of a task fit together.

    Args:
      task: of one task, or of several that are stacked.
      batch: leading axes that every array has; none for one task.

    Returns:
      Z, L, E, C, P, M and K.

    Raises:
      ProblemError: an array has another shape or type; the message names it, what was found and what is expected.
    """
    sizes = {}
    for name, axes in _SIZES.items():
        sizes[axes[-1]] = last_axis(f"task.{name}", getattr(task, name), batch, tuple(axes.split()))
    check_arrays(task, sizes, batch, "task.")
    return sizes


def last_axis(name: str, array: Any, batch: tuple[int, ...], axes: tuple[str, ...]) -> int:
    """Length of the last axis of an array that has those of the batch and as many as ``axes``.

    Args:
      name: of the array, for the message.
      array: which gives a size.
      batch: its leading axes.
      axes: names of the others.

    Returns:
      The length.

    Raises:
      ProblemError: it has other axes.
    """
    found = jnp.shape(array)
    if len(found) != len(batch) + len(axes) or found[: len(batch)] != batch:
        raise ProblemError(f"{name} has shape {found}, expected {(*batch, *axes)}")
    return found[-1]


def check_arrays(arrays: Any, sizes: Mapping[str, int], batch: tuple[int, ...] = (), prefix: str = "") -> None:
    """Check every array of a dataclass against the type and the axes that its annotation says.

    Arrays of 64 bits pass as those of 32: public functions round them (``precision``).

    Args:
      arrays: the dataclass.
      sizes: length of each named axis.
      batch: leading axes that every array has.
      prefix: put before names in the message.

    Raises:
      ProblemError: an array has another shape or type; the message names it, what was found and what is expected.
    """
    for field, kind, axes in _declared(arrays):
        name, array = prefix + field, getattr(arrays, field)
        if not hasattr(array, "dtype"):
            raise ProblemError(f"{name} is of type {type(array).__name__}; give an array")
        expected = (*batch, *(sizes[axis] if axis in sizes else int(axis) for axis in axes))
        if array.shape != expected:
            said = ", ".join(f"{axis} = {sizes[axis]}" for axis in axes if axis in sizes)
            raise ProblemError(f"{name} has shape {array.shape}, expected {expected}{said and ': ' + said}")
        if narrow_type(array.dtype) != kind:
            raise ProblemError(f"{name} has the type {array.dtype}, expected {kind}")


def require_shapes(expected: Mapping[str, tuple[Any, tuple[int, ...]]], why: str = "") -> None:
    """Check arrays that were given one by one.

    Args:
      expected: each array and its shape, by name.
      why: what the shapes follow from, for the message.

    Raises:
      ProblemError: an array has another shape; the message names the first.
    """
    for name, (array, shape) in expected.items():
        if jnp.shape(array) != shape:
            raise ProblemError(f"{name} has shape {jnp.shape(array)}, expected {shape}{why and ': ' + why}")


def _declared(arrays: Any) -> Iterator[tuple[str, np.dtype, list[str]]]:
    """Name, type and axes of each field that is annotated as an array, without the axes of a batch."""
    for field in dataclasses.fields(arrays):
        annotation: Any = field.type
        if hasattr(annotation, "dim_str"):
            yield field.name, np.dtype(annotation.dtypes[0]), annotation.dim_str.split()[1:]
