"""The estimator that is shipped: one ``.npz`` file.

The network's parameters as float32 arrays by name, and one JSON text with the network's configuration (Sigma included),
training metadata and figures. One file, not a checkpoint's folder, because it is shipped with the package and copied by
people: it is read with NumPy alone, needs no device topology, and the zip's checksums find damage.
"""

import dataclasses
import json
import os
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from potlp_jax.codec import config_from_dict, differences
from potlp_jax.errors import CheckpointError, ConfigurationError
from potlp_jax.learning.network import EstimatorNetwork, NetworkConfig, Params

ESTIMATOR_FORMAT: str = "potlp-estimator-3"
"""Changed when older files can no longer be read."""


# Name of the array that holds the JSON text as bytes; no parameter has a name without a dot.
_HEADER = "header"


def save_estimator(path: Path | str, params: Params, config: NetworkConfig, metadata: Mapping[str, Any]) -> None:
    """Write an estimator.

    Args:
        path: the file; its folder is made if it is not there.
        params: float32 arrays.
        config: of the network.
        metadata: any JSON-able mapping: how the estimator was made.
    """
    # Under a temporary name first: a process that is killed leaves the old estimator or the new one.
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays = named_arrays(params)
    header = json.dumps({"format": ESTIMATOR_FORMAT, "network": dataclasses.asdict(config), "metadata": metadata})
    temporary = path.with_name(path.name + ".tmp")
    with temporary.open("wb") as file:
        # Not compressed: random bits of parameters hardly shrink, and the file loads faster.
        contents: dict[str, Any] = {_HEADER: np.frombuffer(header.encode(), np.uint8), **arrays}
        np.savez(file, **contents)
        file.flush()
        # Before the rename: otherwise a power cut could leave the name without the contents.
        os.fsync(file.fileno())
    temporary.replace(path)


def load_estimator(path: Path | str) -> tuple[Params, NetworkConfig, dict[str, Any]]:
    """Parameters, network configuration and metadata of an estimator.

    Raises:
        CheckpointError: no such file, damaged, of another format, or parameters that do not fit the configuration.
    """
    # All that a file that is no zip, or a damaged one, makes NumPy and zlib raise.
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        header = json.loads(arrays.pop(_HEADER).tobytes().decode())
    except FileNotFoundError as error:
        raise CheckpointError(f"there is no estimator {path}: train one (potlp fit)") from error
    except (OSError, ValueError, KeyError, EOFError, AttributeError, zipfile.BadZipFile, zlib.error) as error:
        raise CheckpointError(f"{path} is not an estimator, or is damaged ({error}): get it again") from error
    if not isinstance(header, dict) or header.get("format") != ESTIMATOR_FORMAT:
        found = header.get("format") if isinstance(header, dict) else None
        raise CheckpointError(f"{path} has format {found!r}; this library reads {ESTIMATOR_FORMAT!r}: train it again")
    try:
        config = config_from_dict(NetworkConfig, header["network"], "network")
    except ConfigurationError as error:
        raise CheckpointError(f"{path}: {error}") from error
    # What the network would have, without computing it: names and shapes must agree before anything is used.
    like = jax.eval_shape(EstimatorNetwork(config).init, jax.random.key(0))
    wanted = named_leaves(like)
    found = differences(array_shapes(arrays), array_shapes(wanted), "array")
    if found:
        raise CheckpointError(f"{path}: the parameters do not fit the network. {'; '.join(found)}")
    leaves = [jnp.asarray(arrays[name]) for name in wanted]
    return jax.tree.unflatten(jax.tree.structure(like), leaves), config, header["metadata"]


def require_propositions(config: NetworkConfig, propositions: tuple[str, ...], where: str) -> None:
    """Check that an estimator was trained with these propositions, in this order.

    Args:
        config: of the estimator's network.
        propositions: those of the task or the data.
        where: names the estimator in the message.

    Raises:
        CheckpointError: it was not.
    """
    # The order matters: an entry of phi means what its position says.
    if config.propositions != propositions:
        raise CheckpointError(
            f"{where} knows the propositions {', '.join(config.propositions)} in this order, and not "
            f"{', '.join(propositions)}: state the task over its propositions, or train an estimator for these"
        )


def named_leaves(tree: Any) -> dict[str, Any]:
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def named_arrays(tree: Any) -> dict[str, np.ndarray]:
    return {name: np.asarray(leaf) for name, leaf in named_leaves(tree).items()}


def array_shapes(arrays: Mapping[str, Any]) -> dict[str, str]:
    return {name: f"{array.dtype}{list(array.shape)}" for name, array in arrays.items()}
