"""The devices that share a fit: those of this process, and those of other processes that joined it.

Every process of a fit runs the same program on the same data and makes its own part of each batch. Only the first one
writes, and what it decides by its files or its clock it tells the others (``agreed``). All of them see one folder.
"""

import os
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from potlp_jax.errors import TrainingError
from potlp_jax.files import one_line

T = TypeVar("T")

VIEWS: str = "views"
"""Axis of the mesh over which the views of a batch are shared out."""

# How many processes were begun together, as Slurm and Open MPI tell each of them.
_SIZES = ("SLURM_STEP_NUM_TASKS", "OMPI_COMM_WORLD_SIZE")


def join_processes(address: str | None = None) -> None:
    """Share the fit with other processes, where several were begun; jax must not have computed anything before.

    Args:
        address: ``HOST:PORT,INDEX,COUNT``: where the first process listens, the number of this one from 0 on, and how
            many there are. None: what Slurm's ``srun`` or Open MPI's ``mpirun`` says; without them this process alone.

    Raises:
        TrainingError: the address is none, or not all processes came together.
    """
    sizes = [os.environ.get(name, "") for name in _SIZES]
    # Empty, or no number: set for something else.
    if address is None and max((int(size) for size in sizes if size.isdecimal()), default=1) < 2:
        return
    given = {} if address is None else _given(address)
    # Processors have no way to talk to those of other processes by default in all versions of jax.
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    try:
        jax.distributed.initialize(**given)
    except (RuntimeError, ValueError) as error:
        raise TrainingError(
            f"the processes of the fit did not come together ({one_line(error)}): begin all of them at once with the "
            "same command, before anything is computed, and look whether the first one can be reached"
        ) from error


def _given(address: str) -> dict[str, Any]:
    where, *numbers = address.split(",")
    if ":" not in where or len(numbers) != 2 or not all(number.isdigit() for number in numbers):
        raise TrainingError(f"{address} is no HOST:PORT,INDEX,COUNT, such as 10.0.0.1:9900,0,2")
    index, count = map(int, numbers)
    if index >= count:
        raise TrainingError(f"{address}: of {count} processes the last one has the number {count - 1}")
    # Whatever batch system this runs in: what was said counts.
    return {
        "coordinator_address": where,
        "num_processes": count,
        "process_id": index,
        "cluster_detection_method": "deactivate",
    }


def is_first() -> bool:
    """Whether this is the process that writes, and shows how it goes."""
    return jax.process_index() == 0


def mesh() -> Mesh:
    """All devices of all processes, those of each process side by side."""
    return Mesh(np.array(sorted(jax.devices(), key=lambda device: (device.process_index, device.id))), (VIEWS,))


def shared_out(batch: T) -> T:
    """A batch on all devices: this process gives its rows, and each device gets equally many.

    Args:
        batch: a pytree of arrays whose rows are those of this process (``batches.Share``).
    """
    return _placed(batch, PartitionSpec(VIEWS))


def everywhere(state: T) -> T:
    """A pytree that is the same in every process, whole on every device."""
    return _placed(state, PartitionSpec())


def _placed(tree: T, spec: PartitionSpec) -> T:
    # Leaf by leaf: a structure of which some leaves are NumPy's is none of the kind that its class describes.
    leaves, structure = jax.tree.flatten(tree)
    sharding = NamedSharding(mesh(), spec)
    # With several processes an array goes to their devices by way of the host.
    local = leaves if jax.process_count() == 1 else map(np.asarray, leaves)
    return jax.tree.unflatten(structure, [jax.make_array_from_process_local_data(sharding, leaf) for leaf in local])


def agreed(values: T) -> T:
    """What the first process has, in all of them; every process must ask at the same place.

    Args:
        values: a pytree of arrays, of the same shapes everywhere.

    Returns:
        The same of jax's arrays.
    """
    leaves, structure = jax.tree.flatten(values)
    return jax.tree.unflatten(structure, list(map(jnp.asarray, multihost_utils.broadcast_one_to_all(leaves))))


def require_agreement(digest: int, what: str) -> None:
    """Refuse to go on where processes differ.

    Args:
        digest: 32 bits of what must be equal.
        what: for the message.

    Raises:
        TrainingError: in every process, where one has another digest than the first.
    """
    found = np.asarray(multihost_utils.process_allgather(np.uint32(digest))).reshape(-1)
    other = np.flatnonzero(found != found[0])
    if len(other):
        raise TrainingError(f"process {other[0]} of the fit has other {what} than process 0: give all of them the same")
