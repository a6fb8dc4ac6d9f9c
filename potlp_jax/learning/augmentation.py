"""How training data are varied: by mirroring the building, and by light and white balance."""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float32, PRNGKeyArray

from potlp_jax.checks import NOT_NEGATIVE, SHARE, require_fields
from potlp_jax.errors import TrainingError


@dataclasses.dataclass(frozen=True, kw_only=True)
class Augmentation:
    """How much is varied, in every step anew.

    Attributes:
        mirror_rows: probability that a view shows its building upside down, map and panorama alike.
        mirror_columns: probability that left and right are exchanged. Only where buildings look alike both ways: those
            of fire-fighting begin on the left.
        brightness, colour: standard deviations of the logarithm of a random gain per view, of all channels and of each
            channel.
    """

    mirror_rows: float = 0.5
    mirror_columns: float = 0.0
    brightness: float = 0.05
    colour: float = 0.02

    def __post_init__(self) -> None:
        require_fields(self, ("mirror_rows", "mirror_columns"), SHARE, TrainingError)
        require_fields(self, ("brightness", "colour"), NOT_NEGATIVE, TrainingError)


def draw_mirrors(key: PRNGKeyArray, views: int, amount: Augmentation) -> tuple[Bool[Array, " G"], Bool[Array, " G"]]:
    """Which views have their rows mirrored, and which their columns.

    Args:
        key: decides it.
        views: how many.
        amount: the chance of each.

    Returns:
        True where a view's rows are mirrored, and where its columns are.
    """
    of_rows, of_columns = jax.random.split(key)
    rows = jax.random.bernoulli(of_rows, amount.mirror_rows, (views,))
    return rows, jax.random.bernoulli(of_columns, amount.mirror_columns, (views,))


def draw_gains(key: PRNGKeyArray, views: int, amount: Augmentation) -> Float32[Array, "G 3"]:
    """Factors of the three channels of each view, around 1: as a lamp and a camera's white balance change a picture.

    Args:
        key: decides them.
        views: how many.
        amount: standard deviations of the logarithm, of all channels together and of each.

    Returns:
        A factor for red, green and blue of each view.
    """
    of_brightness, of_colour = jax.random.split(key)
    logarithm = amount.brightness * jax.random.normal(of_brightness, (views, 1))
    return jnp.exp(logarithm + amount.colour * jax.random.normal(of_colour, (views, 3)))
