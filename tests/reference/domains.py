"""Domains of estimators that tests make."""

from potlp_jax.learning.domain import Domain
from potlp_jax.world.camera import CameraConfig


def domain_of(family: str) -> Domain:
    """What serves a family that counts in cells, with the default camera."""
    return Domain.of_cells(family, CameraConfig(), 1.0)
