"""Environments by name: those that come with the package, and those of others."""

from potlp_jax import plugins
from potlp_jax.environments.base import Generator
from potlp_jax.environments.families import FAMILIES, NAMED, PREFIXED
from potlp_jax.errors import PluginError


def make(name: str) -> Generator:
    """The generator of a family of worlds, as named on the command line.

    Args:
        name: ``toy``, ``firefighting``, ``delivery``, ``parcels``, ``rooms``, or another of ``families.NAMED``;
            ``map:FILE.yaml`` for a ROS map, ``parcels:FILE.yaml`` for deliveries to its rooms, or
            ``floorplan:FILE.xml`` for delivery worlds on a real floor plan (or on those of a folder); for an
            environment of your own ``module:attribute``, or the name of an entry point in the group
            ``potlp_jax.environments``: a ``Generator``, or what makes one when called.

    Raises:
        PluginError: there is no such family, or a foreign one cannot be imported.
        MapError: the map or the floor plan cannot be used.
    """
    # Only the family asked for is imported: reading maps needs libraries that the others do not.
    for prefix, reference in PREFIXED.items():
        if name.startswith(prefix):
            return plugins.load(reference, group=plugins.ENVIRONMENTS, kind="environment")(name)
    found = plugins.load(NAMED.get(name, name), group=plugins.ENVIRONMENTS, kind="environment", known=FAMILIES)
    # A class or a function makes one; an object is one.
    try:
        generator = found() if callable(found) else found
    except TypeError as error:
        # Such as a class without ``draw``, or one that needs arguments.
        raise PluginError(f"environment {name!r}: cannot be made: {error}") from error
    if not isinstance(generator, Generator):
        raise PluginError(
            f"environment {name!r}: {type(generator).__name__} is no environment: derive its class from "
            "potlp_jax.Generator"
        )
    if missing := [field for field in ("name", "propositions") if not hasattr(generator, field)]:
        raise PluginError(f"environment {name!r}: its class has no {' and no '.join(missing)}; see potlp_jax.Generator")
    return generator
