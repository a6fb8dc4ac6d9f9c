"""The estimator that is shipped: one ``.npz`` file.

The network's parameters as float32 arrays by name, and one JSON text with the network's architecture and configuration
(Sigma included), the domain that it serves, training metadata and figures. One file, not a checkpoint's folder, because
it is shipped with the package and copied by people: it is read with NumPy alone, needs no device topology, and the
zip's checksums find damage.
"""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from potlp_jax.codec import config_from_dict, differences
from potlp_jax.errors import ConfigurationError, EstimatorError, NetworkError, PotlpError
from potlp_jax.files import read_npz, reading, require_mapping, short, whole_file
from potlp_jax.learning.architectures import ARCHITECTURES, EstimatorConfig, architecture_of
from potlp_jax.learning.domain import Domain
from potlp_jax.learning.network import Params
from potlp_jax.precision import in_32_bits

ESTIMATOR_FORMAT: str = "potlp-estimator-4"
"""Changed when older files can no longer be read."""


# Name of the array that holds the JSON text as bytes; no parameter has a name without a dot.
_HEADER = "header"


def save_estimator(
    path: Path | str, params: Params, config: EstimatorConfig, domain: Domain, metadata: Mapping[str, Any]
) -> None:
    """Write an estimator.

    Args:
        path: the file; its folder is made if it is not there.
        params: float32 arrays.
        config: of the network.
        domain: of the worlds that it learned from.
        metadata: any JSON-able mapping: how the estimator was made.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays = named_arrays(params)
    description = {
        "architecture": architecture_of(config).name,
        "network": dataclasses.asdict(config),
        "domain": dataclasses.asdict(domain),
        "metadata": metadata,
    }
    header = json.dumps({"format": ESTIMATOR_FORMAT, **description})
    # Not compressed: random bits of parameters hardly shrink, and the file loads faster.
    contents: dict[str, Any] = {_HEADER: np.frombuffer(header.encode(), np.uint8), **arrays}
    with whole_file(path) as file:
        np.savez(file, **contents)


@in_32_bits
def load_estimator(path: Path | str) -> tuple[Params, EstimatorConfig, Domain, dict[str, Any]]:
    """Parameters, network configuration, domain and metadata of an estimator.

    Raises:
        EstimatorError: no such file, damaged, of another format, parameters that do not fit the configuration, or a
            parameter that is NaN or infinite.
    """
    if not Path(path).exists():
        raise EstimatorError(f"there is no estimator {path}: train one (potlp fit)")
    arrays = read_npz(path, EstimatorError, "an estimator")
    with reading(path, EstimatorError, "an estimator"):
        header = json.loads(arrays.pop(_HEADER).tobytes().decode())
    if not isinstance(header, dict) or header.get("format") != ESTIMATOR_FORMAT:
        found = header.get("format") if isinstance(header, dict) else None
        raise EstimatorError(
            f"{path} has format {short(found)}; this library reads {ESTIMATOR_FORMAT!r}: train it again"
        )
    # Widths of a damaged header may be beyond what any array can have, which shows when shapes are worked out.
    with reading(path, EstimatorError, "an estimator"):
        config, domain, metadata = _configuration(path, header)
        # What the network would have, without computing it: names and shapes must agree before anything is used.
        like = jax.eval_shape(architecture_of(config).network(config).init, jax.random.key(0))
        wanted = named_leaves(like)
    found = differences(array_shapes(arrays), array_shapes(wanted), "array")
    if found:
        raise EstimatorError(f"{path}: the parameters do not fit the network. {'; '.join(found)}")
    require_finite(arrays, str(path), EstimatorError)
    leaves = [jnp.asarray(arrays[name]) for name in wanted]
    return jax.tree.unflatten(jax.tree.structure(like), leaves), config, domain, metadata


def require_finite(arrays: Mapping[str, np.ndarray], where: str, kind: type[PotlpError]) -> None:
    """Check that all parameters are numbers.

    Args:
        arrays: by name.
        where: names the file in the message.
        kind: of error for such a file.

    Raises:
        PotlpError: of this kind; an array holds NaN or an infinity; the first one is named.
    """
    # One such parameter reaches most estimates, and every decision would be flagged as invalid.
    for name, array in arrays.items():
        # Keys and counters are integers, which are always finite.
        if np.issubdtype(array.dtype, np.floating) and not np.all(np.isfinite(array)):
            count = int(np.sum(~np.isfinite(array)))
            raise kind(
                f"{where}: the parameter {name} holds {count} values that are NaN or infinite, of {array.size}: get it "
                "again, or train it again"
            )


def _configuration(path: Path | str, header: Mapping[str, Any]) -> tuple[EstimatorConfig, Domain, dict[str, Any]]:
    # Files from before there was a choice are of the first architecture.
    name = header.get("architecture", next(iter(ARCHITECTURES)))
    if name not in ARCHITECTURES:
        raise EstimatorError(
            f"{path}: architecture {short(name)} is not known; this library has {', '.join(ARCHITECTURES)}"
        )
    try:
        architecture, network = ARCHITECTURES[name], header["network"]
        # What is no mapping is left to the reader, which says so.
        network = {**architecture.before, **network} if isinstance(network, Mapping) else network
        config = config_from_dict(architecture.config, network, "network")
        domain = config_from_dict(Domain, header["domain"], "domain")
    except (ConfigurationError, NetworkError) as error:
        raise EstimatorError(f"{path}: {error}") from error
    return config, domain, require_mapping(path, header["metadata"], EstimatorError, "an estimator with metadata")


def named_leaves(tree: Any) -> dict[str, Any]:
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def named_arrays(tree: Any) -> dict[str, np.ndarray]:
    return {name: np.asarray(leaf) for name, leaf in named_leaves(tree).items()}


def array_shapes(arrays: Mapping[str, Any]) -> dict[str, str]:
    return {name: f"{array.dtype}{list(array.shape)}" for name, array in arrays.items()}
