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

MAP_PREFIX: str = "map:"
"""How the names of families of worlds on robots' maps begin, whose places their owner chose."""

PARCELS_PREFIX: str = "parcels:"
"""The same of those in the named rooms of real maps."""

FLOOR_PLAN_PREFIX: str = "floorplan:"
"""The same of those on real floor plans."""

PREFIXED: Mapping[str, str] = MappingProxyType(
    {
        MAP_PREFIX: "potlp_jax.environments.ros.ros_map:RosMap.from_spec",
        PARCELS_PREFIX: "potlp_jax.environments.ros.mapped_rooms:MappedRooms.from_spec",
        FLOOR_PLAN_PREFIX: "potlp_jax.environments.campus.floor_plans:FloorPlans.from_spec",
    }
)
"""Families that are made from a file, by how their names begin: functions of the whole name."""

FAMILIES: tuple[str, ...] = (
    *NAMED,
    f"{MAP_PREFIX}FILE.yaml",
    f"{PARCELS_PREFIX}FILE.yaml",
    f"{FLOOR_PLAN_PREFIX}FILE.xml",
)
"""The names as they are shown to users."""
