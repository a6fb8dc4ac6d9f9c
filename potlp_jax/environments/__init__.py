"""Where worlds come from: one file a family, each a ``Generator``; ``make`` finds them by name."""

from potlp_jax.environments.base import Generator
from potlp_jax.errors import WorldError

FAMILIES: tuple[str, ...] = (
    "toy",
    "firefighting",
    "delivery",
    "parcels",
    "rooms",
    "map:FILE.yaml",
    "parcels:FILE.yaml",
    "floorplan:FILE.xml",
)
"""The names that ``make`` understands."""


def make(name: str) -> Generator:
    """The generator of a family of worlds, as named on the command line.

    Args:
        name: ``toy``, ``firefighting``, ``delivery``, ``parcels``, ``rooms``, ``map:FILE.yaml`` for a ROS map,
            ``parcels:FILE.yaml`` for deliveries to its rooms, or ``floorplan:FILE.xml`` for delivery worlds on a real
            floor plan (or on those of a folder).

    Raises:
        WorldError: there is no such family.
        MapError: the map or the floor plan cannot be used.
    """
    # Only the family asked for is imported: reading maps needs libraries that the others do not.
    if name == "toy":
        from potlp_jax.environments.toy import Toy

        return Toy()
    if name == "firefighting":
        from potlp_jax.environments.firefighting import Firefighting

        return Firefighting()
    if name == "delivery":
        from potlp_jax.environments.campus.delivery import Delivery

        return Delivery()
    if name == "parcels":
        from potlp_jax.environments.campus.delivery import Delivery

        return Delivery.parcels()
    if name == "rooms":
        from potlp_jax.environments.rooms import Rooms

        return Rooms()
    if name.startswith("map:"):
        from potlp_jax.environments.ros.ros_map import RosMap

        return RosMap.from_spec(name)
    if name.startswith("parcels:"):
        from potlp_jax.environments.ros.mapped_rooms import MappedRooms

        return MappedRooms.from_spec(name)
    if name.startswith("floorplan:"):
        from potlp_jax.environments.campus.floor_plans import FloorPlans

        return FloorPlans.from_spec(name)
    raise WorldError(f"unknown environment {name!r}; choose one of: {', '.join(FAMILIES)}")


__all__ = ["FAMILIES", "Generator", "make"]
