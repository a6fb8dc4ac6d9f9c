"""What every family of worlds offers."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Protocol, runtime_checkable

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from potlp_jax.world.grid import World

NO_SETTINGS: Mapping[str, Any] = MappingProxyType({})
"""Trials run with the defaults."""


@runtime_checkable
class Generator(Protocol):
    """A family of worlds: one fixed array shape, one tuple of propositions, worlds drawn by key.

    Attributes:
        name: the family's name; it also separates the families' seeds.
        propositions: bit ``i`` of every letter of the family is ``propositions[i]``.
        config: the parameters of the worlds, a frozen dataclass.
        tasks: formulas that belong to the family, by the number (or name) used on the command line.
        settings: what trials in its worlds need to be different from the defaults: fields of
            ``trial_config.TrialConfig``, nested as in a sweep's file.
    """

    @property
    def name(self) -> str: ...

    @property
    def config(self) -> Any: ...

    @property
    def propositions(self) -> tuple[str, ...]: ...

    @property
    def tasks(self) -> Mapping[str, str]: ...

    @property
    def settings(self) -> Mapping[str, Any]: ...

    def generate(self, key: PRNGKeyArray) -> World:
        """The world of this key: on the host, the same on every machine. Raises WorldError where none can be made."""
        ...


def host_generators(key: PRNGKeyArray, count: int) -> tuple[np.random.Generator, ...]:
    """Independent NumPy generators from one typed key, so that, say, new colours never move a wall."""
    words = np.asarray(jax.random.key_data(key)).tolist()
    return tuple(np.random.default_rng(child) for child in np.random.SeedSequence(words).spawn(count))
