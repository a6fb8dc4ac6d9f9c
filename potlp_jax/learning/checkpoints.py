"""What training leaves on disk: checkpoints to resume from, and the estimator that is shipped.

A **checkpoint** is an Orbax folder named by its step, with everything that the rest of the training depends on. Orbax
writes to a temporary name and renames, so a process killed at any time leaves whole checkpoints only.

An **estimator** is one ``.npz`` file: the network's parameters as float32 arrays by name, and one JSON text with the
network's configuration (Sigma included), training metadata and figures. One file, not an Orbax folder, because it is
shipped with the package and copied by people: it is read with NumPy alone, needs no device topology, and the zip's
checksums find damage.

This is the only module that imports Orbax.
"""

import json
import os
import re
import shutil
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from orbax.checkpoint import v1 as ocp

from potlp_jax.learning.network import EstimatorNetwork, NetworkConfig, NetworkError, Params

CHECKPOINT_FORMAT: str = "potlp-checkpoint-1"
ESTIMATOR_FORMAT: str = "potlp-estimator-1"
"""Change when older files can no longer be read."""

_HEADER = "header"


class CheckpointError(ValueError):
    """A checkpoint or an estimator cannot be read or is not of this training; the message names what differs."""


def differences(stored: Any, expected: Any, name: str = "") -> list[str]:
    """What differs between two nested JSON values, by dotted name, with both values."""
    if isinstance(stored, Mapping) and isinstance(expected, Mapping):
        prefix = f"{name}." if name else ""
        keys = sorted({*stored, *expected})
        return [found for key in keys for found in differences(stored.get(key), expected.get(key), prefix + key)]
    return [] if stored == expected else [f"{name} is {stored} in the file and {expected} here"]


def checkpoint_steps(folder: Path | str) -> list[int]:
    """Steps of the whole checkpoints in the folder, in increasing order; none where there is no such folder."""
    folder = Path(folder)
    found = [path.name for path in folder.iterdir() if path.is_dir()] if folder.is_dir() else []
    return sorted(int(name) for name in found if re.fullmatch(r"\d+", name))


def save_checkpoint(
    folder: Path | str, step: int, state: Any, identity: Mapping[str, Any], progress: Mapping[str, Any], keep: int = 2
) -> None:
    """Write ``state`` (a pytree of arrays) as the checkpoint of ``step`` and delete all but the newest ``keep``.

    Args:
        identity: JSON-able; what a training must share with the checkpoint to resume from it.
        progress: JSON-able; given back on loading and not compared.
    """
    folder = Path(folder).absolute()
    folder.mkdir(parents=True, exist_ok=True)
    arrays = _named_arrays(state)
    description = {
        "format": CHECKPOINT_FORMAT,
        "identity": json.loads(json.dumps(identity)),
        "progress": json.loads(json.dumps(progress)),
        "arrays": _shapes(arrays),
        "checksum": _checksum(arrays),
    }
    ocp.save(str(folder / str(step)), arrays, custom_metadata=description, overwrite=True)
    for old in checkpoint_steps(folder)[:-keep]:
        shutil.rmtree(folder / str(old))


def load_checkpoint(
    folder: Path | str, step: int, like: Any, identity: Mapping[str, Any]
) -> tuple[Any, dict[str, Any]]:
    """The state and the progress that were saved at ``step``.

    Args:
        like: a state of the same structure, shapes and types.
        identity: as given to ``save_checkpoint``.

    Raises:
        CheckpointError: damaged, of another format, or of another training; the message names every difference.
    """
    path = Path(folder).absolute() / str(step)
    wanted = _named_arrays(like)
    try:
        description: Any = ocp.metadata(str(path)).custom_metadata
    except Exception as error:
        raise _damaged_checkpoint(path, error) from error
    if not isinstance(description, Mapping) or description.get("format") != CHECKPOINT_FORMAT:
        found = description.get("format") if isinstance(description, Mapping) else None
        raise CheckpointError(f"{path} has format {found!r}; this library reads {CHECKPOINT_FORMAT!r}")
    found = differences(description["identity"], json.loads(json.dumps(identity)))
    found += differences(description["arrays"], _shapes(wanted), "array")
    if found:
        raise CheckpointError(f"{path} is of another training; choose another folder. {'; '.join(found)}")
    try:
        arrays = ocp.load(str(path), {name: np.empty_like(array) for name, array in wanted.items()})
    except Exception as error:
        raise _damaged_checkpoint(path, error) from error
    if _checksum(arrays) != description["checksum"]:
        raise _damaged_checkpoint(path, "its checksum differs")
    leaves = [jnp.asarray(arrays[name]) for name in wanted]
    return jax.tree.unflatten(jax.tree.structure(like), leaves), dict(description["progress"])


def save_estimator(path: Path | str, params: Params, config: NetworkConfig, metadata: Mapping[str, Any]) -> None:
    """Write an estimator, under a temporary name first; ``metadata`` is any JSON-able mapping."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays = _named_arrays(params)
    header = json.dumps({"format": ESTIMATOR_FORMAT, "network": config.to_json(), "metadata": metadata})
    temporary = path.with_name(path.name + ".tmp")
    with temporary.open("wb") as file:
        contents: dict[str, Any] = {_HEADER: np.frombuffer(header.encode(), np.uint8), **arrays}
        np.savez(file, **contents)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)


def load_estimator(path: Path | str) -> tuple[Params, NetworkConfig, dict[str, Any]]:
    """Parameters, network configuration and metadata of an estimator.

    Raises:
        CheckpointError: no such file, damaged, of another format, or parameters that do not fit the configuration.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        header = json.loads(arrays.pop(_HEADER).tobytes().decode())
    except FileNotFoundError as error:
        raise CheckpointError(f"there is no estimator {path}: train one (python -m train.fit)") from error
    except (OSError, ValueError, KeyError, EOFError, AttributeError, zipfile.BadZipFile, zlib.error) as error:
        raise CheckpointError(f"{path} is not an estimator, or is damaged ({error}): get it again") from error
    if not isinstance(header, dict) or header.get("format") != ESTIMATOR_FORMAT:
        found = header.get("format") if isinstance(header, dict) else None
        raise CheckpointError(f"{path} has format {found!r}; this library reads {ESTIMATOR_FORMAT!r}: train it again")
    try:
        config = NetworkConfig.from_json(header["network"])
    except NetworkError as error:
        raise CheckpointError(f"{path}: {error}") from error
    like = jax.eval_shape(EstimatorNetwork(config).init, jax.random.key(0))
    wanted = _named_leaves(like)
    found = differences(_shapes(arrays), _shapes(wanted), "array")
    if found:
        raise CheckpointError(f"{path}: the parameters do not fit the network. {'; '.join(found)}")
    leaves = [jnp.asarray(arrays[name]) for name in wanted]
    return jax.tree.unflatten(jax.tree.structure(like), leaves), config, header["metadata"]


def require_propositions(config: NetworkConfig, propositions: tuple[str, ...], where: str) -> None:
    """Raises CheckpointError unless the estimator was trained with these propositions, in this order."""
    if config.propositions != propositions:
        raise CheckpointError(
            f"{where} knows the propositions {', '.join(config.propositions)} in this order, and not "
            f"{', '.join(propositions)}: state the task over its propositions, or train an estimator for these"
        )


def _damaged_checkpoint(path: Path, why: Any) -> CheckpointError:
    return CheckpointError(f"{path} cannot be read ({why}): delete it to resume from the one before, if there is one")


def _named_leaves(tree: Any) -> dict[str, Any]:
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def _named_arrays(tree: Any) -> dict[str, np.ndarray]:
    return {name: np.asarray(leaf) for name, leaf in _named_leaves(tree).items()}


def _shapes(arrays: Mapping[str, Any]) -> dict[str, str]:
    return {name: f"{array.dtype}{list(array.shape)}" for name, array in arrays.items()}


def _checksum(arrays: Mapping[str, np.ndarray]) -> int:
    total = 0
    for name in sorted(arrays):
        total = zlib.crc32(np.ascontiguousarray(arrays[name]).tobytes(), total)
    return total
