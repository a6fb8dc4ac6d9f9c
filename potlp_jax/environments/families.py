"""Names of the families of worlds that come with the package, and where each is defined.

A table of strings, so that listing the names loads neither JAX nor the libraries that single families need.
"""

from collections.abc import Mapping
from types import MappingProxyType

NAMED: Mapping[str, str] = MappingProxyType(
    {
        "toy": "potlp_jax.environments.toy:Toy",
        "firefighting": "potlp_jax.environments.firefighting:Firefighting",
        "delivery": "potlp_jax.environments.campus.delivery:Delivery",
        "parcels": "potlp_jax.environments.campus.delivery:Delivery.parcels",
        "rooms": "potlp_jax.environments.rooms:Rooms",
        "campus-small": "potlp_jax.environments.campus.campus:Campus.small",
        "campus-medium": "potlp_jax.environments.campus.campus:Campus.medium",
        "campus-large": "potlp_jax.environments.campus.campus:Campus.large",
        "campus-small-parcels": "potlp_jax.environments.campus.campus:Campus.small_parcels",
        "campus-medium-parcels": "potlp_jax.environments.campus.campus:Campus.medium_parcels",
        "campus-large-parcels": "potlp_jax.environments.campus.campus:Campus.large_parcels",
    }
)
"""``module:attribute`` of the class (or function without arguments) that makes each family's generator."""

PREFIXED: Mapping[str, str] = MappingProxyType(
    {
        "map:": "potlp_jax.environments.ros.ros_map:RosMap.from_spec",
        "parcels:": "potlp_jax.environments.ros.mapped_rooms:MappedRooms.from_spec",
        "floorplan:": "potlp_jax.environments.campus.floor_plans:FloorPlans.from_spec",
    }
)
"""Families that are made from a file, by how their names begin: functions of the whole name."""

FAMILIES: tuple[str, ...] = (*NAMED, "map:FILE.yaml", "parcels:FILE.yaml", "floorplan:FILE.xml")
"""The names as they are shown to users."""
