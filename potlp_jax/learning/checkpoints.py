"""What training leaves on disk to resume from.

A **checkpoint** is an Orbax folder named by its step, with everything that the rest of the training depends on. Orbax
writes to a temporary name and renames, so a process killed at any time leaves whole checkpoints only.

Processes that share a training all call these functions at the same time, with a folder that all of them see: Orbax
lets the first one write.

This is the only module that imports Orbax: planning with a trained estimator does without.
"""

import json
import re
import shutil
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from orbax.checkpoint import v1 as ocp

from potlp_jax.codec import differences, json_copy
from potlp_jax.errors import CheckpointError
from potlp_jax.files import one_line, short
from potlp_jax.learning.serialization import array_shapes, named_arrays, require_finite

CHECKPOINT_FORMAT: str = "potlp-checkpoint-1"
"""Changed when older checkpoints can no longer be read."""


def checkpoint_steps(folder: Path | str) -> list[int]:
    """Steps of the whole checkpoints in the folder, in increasing order; none where there is no such folder."""
    folder = Path(folder)
    # Orbax writes under another name until a checkpoint is whole, so a number is a whole one.
    found = [path.name for path in folder.iterdir() if path.is_dir()] if folder.is_dir() else []
    return sorted(int(name) for name in found if re.fullmatch(r"\d+", name))


def save_checkpoint(
    folder: Path | str, step: int, state: Any, identity: Mapping[str, Any], progress: Mapping[str, Any], keep: int = 2
) -> None:
    """Write ``state`` (a pytree of arrays) as the checkpoint of ``step`` and delete all but the newest ``keep``.

    Args:
        folder: of all checkpoints of a training; made if it is not there.
        step: the checkpoint's name.
        state: a pytree of arrays.
        identity: JSON-able; what a training must share with the checkpoint to resume from it.
        progress: JSON-able; given back on loading and not compared.
        keep: checkpoints that stay. Two: a newest one that turns out damaged can be deleted.
    """
    # Orbax wants absolute paths.
    folder = Path(folder).absolute()
    folder.mkdir(parents=True, exist_ok=True)
    arrays = named_arrays(state)
    description = {
        "format": CHECKPOINT_FORMAT,
        "identity": json_copy(identity),
        "progress": json_copy(progress),
        "arrays": array_shapes(arrays),
    }
    description["checksum"] = _checksum(arrays, description)
    # Arrays by name and not the state itself: reading then needs no class that may have changed.
    ocp.save(str(folder / str(step)), arrays, custom_metadata=description, overwrite=True)
    # After the new one is whole, never before.
    for old in checkpoint_steps(folder)[:-keep] if jax.process_index() == 0 else ():
        shutil.rmtree(folder / str(old))


def load_checkpoint(
    folder: Path | str, step: int, like: Any, identity: Mapping[str, Any]
) -> tuple[Any, dict[str, Any]]:
    """The state and the progress that were saved at ``step``.

    Args:
        folder: of all checkpoints of a training.
        step: which one.
        like: a state of the same structure, shapes and types.
        identity: as given to ``save_checkpoint``.

    Returns:
        The state, bit for bit, and the progress.

    Raises:
        CheckpointError: damaged, of another format, of another training (the message names every difference), or with
            values that are NaN or infinite.
    """
    path = Path(folder).absolute() / str(step)
    wanted = named_arrays(like)
    # Orbax raises whatever its layers raise on a damaged folder; all of it means the same here.
    try:
        description: Any = ocp.metadata(str(path)).custom_metadata
    except Exception as error:
        raise _damaged_checkpoint(path, error) from error
    if not isinstance(description, Mapping) or description.get("format") != CHECKPOINT_FORMAT:
        found = description.get("format") if isinstance(description, Mapping) else None
        raise CheckpointError(f"{path} has format {short(found)}; this library reads {CHECKPOINT_FORMAT!r}")
    missing = {"identity", "arrays", "checksum", "progress"} - set(description)
    if missing or not isinstance(description["progress"], Mapping):
        raise _damaged_checkpoint(path, f"its description lacks {', '.join(sorted(missing)) or 'progress'}")
    found = differences(description["identity"], json_copy(identity))
    found += differences(description["arrays"], array_shapes(wanted), "array")
    if found:
        raise CheckpointError(f"{path} is of another training; choose another folder. {'; '.join(found)}")
    try:
        arrays = ocp.load(str(path), {name: np.empty_like(array) for name, array in wanted.items()})
    except Exception as error:
        raise _damaged_checkpoint(path, error) from error
    # Orbax does not notice every flipped bit.
    if _checksum(arrays, description) != description["checksum"]:
        raise _damaged_checkpoint(path, "its checksum differs")
    # Scalars are left out: the best loss of a training that has not been evaluated yet is inf.
    parameters = {name: array for name, array in arrays.items() if np.ndim(array) > 0}
    require_finite(parameters, str(path), CheckpointError)
    leaves = [jnp.asarray(arrays[name]) for name in wanted]
    return jax.tree.unflatten(jax.tree.structure(like), leaves), dict(description["progress"])


def _damaged_checkpoint(path: Path, why: Any) -> CheckpointError:
    return CheckpointError(
        f"{path} cannot be read ({one_line(why)}): delete it to resume from the one before, if there is one"
    )


def _checksum(arrays: Mapping[str, np.ndarray], description: Mapping[str, Any]) -> int:
    """Of the arrays and of all that the description says beside it."""
    said = {name: value for name, value in description.items() if name != "checksum"}
    total = zlib.crc32(json.dumps(said, sort_keys=True).encode())
    # By name, so that the order of a dictionary does not matter.
    for name in sorted(arrays):
        total = zlib.crc32(np.ascontiguousarray(arrays[name]).tobytes(), total)
    return total
