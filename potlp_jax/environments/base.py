"""What every family of worlds offers."""

import abc
import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from potlp_jax.environments.posterior import Posterior
from potlp_jax.environments.splits import Split, default_split, world_key
from potlp_jax.errors import TaskError, WorldError
from potlp_jax.precision import in_32_bits
from potlp_jax.task.propositions import require_same_propositions
from potlp_jax.task.reading import read_task
from potlp_jax.task.task import Task
from potlp_jax.world.grid import World
from potlp_jax.world.settings import NO_SETTINGS, Settings


class Generator(abc.ABC):
    """A family of worlds: one fixed array shape, one tuple of propositions, worlds drawn by key.

    A family of your own derives from this class, sets ``name`` and ``propositions`` and defines ``draw``. Generators go
    to other processes: their attributes must be picklable.

    Attributes:
        name: the family's name; it also goes into the keys of its worlds.
        propositions: bit ``i`` of every letter of the family is ``propositions[i]``.
        tasks: formulas that belong to the family, by the number (or name) used on the command line.
        settings: what trials in its worlds need to be different from the defaults: fields of
            ``trials.config.TrialConfig``, nested as in a sweep's file. Every world of the family carries them.
        family: what kind of worlds these are, to an estimator that learned from the like of them: a family that looks
            like another has that one's name here. Every world carries it. Empty: ``name``.
        config: the parameters of the worlds, a frozen dataclass; None where there are none.
    """

    name: str
    propositions: tuple[str, ...]
    # Defaults, so that a family of one's own has to say only what is special about it.
    tasks: Mapping[str, str] = MappingProxyType({})
    settings: Mapping[str, Any] = NO_SETTINGS
    family: str = ""
    config: Any = None

    @abc.abstractmethod
    def draw(self, key: PRNGKeyArray) -> World:
        """Make the world of this key, with the family's propositions: on the host, the same on every machine. Called
        by ``generate``.

        Raises:
            WorldError: no world can be made.
        """

    @in_32_bits
    def generate(self, key: PRNGKeyArray) -> World:
        """The world of this key, with the settings and the name of its family. Raises WorldError as ``draw``."""
        world: Any = self.draw(key)
        if not isinstance(world, World):
            raise WorldError(f"the environment {self.name!r} drew {type(world).__name__}, expected a World: make_world")
        return self.signed(world)

    def signed(self, world: World) -> World:
        """The world with the settings and the name of this family. Raises PropositionsError for other propositions."""
        # The names come with the letters, from where these are written: put on afterwards they could be wrong.
        require_same_propositions(
            self.propositions,
            world.propositions,
            asker=f"the environment {self.name!r}",
            knower="the world that it drew",
            remedy="make_world(..., propositions=self.propositions) in draw",
        )
        # A world that says itself what it needs cannot be run with the settings, or the estimator, of another family by
        # oversight.
        # A family may write them as a dictionary; a world's are static under jit, and so have a hash.
        return dataclasses.replace(world, settings=Settings(self.settings), family=self.family or self.name)

    def world(self, index: int, split: Split | str | None = None) -> World:
        """World number ``index`` of a split, by default of that from which the command line takes its worlds.

        Raises:
            WorldError: the family has no such world.
        """
        return self.generate(world_key(default_split(self.name) if split is None else split, index, self.name))

    def posterior(self, key: PRNGKeyArray, noise: PRNGKeyArray, count: int) -> Posterior:
        """What the world of a key can be, to a robot that has seen nothing of it yet.

        Args:
            key: of the world, as of ``generate``.
            noise: another key; decides which buildings are drawn.
            count: how many are drawn at a time.

        Returns:
            The distribution of the family's worlds, given what a robot knows at its start.

        Raises:
            WorldError: the family does not say what its worlds can be.
        """
        raise WorldError(
            f"{self.name} does not say what its worlds can be: what asks for it needs a family with `posterior`, such "
            "as firefighting"
        )

    def task(self, text: str | int) -> Task:
        """A task over the family's propositions.

        Args:
            text: number (or name) of one of the family's tasks, a formula, the name of a shipped task, or a ``.hoa``
                file.

        Raises:
            TaskError: there is no such task, or the formula is none.
        """
        return read_task(self.formula(text), self.propositions)

    def formula(self, text: str | int) -> str:
        """The formula of one of the family's tasks, by its number or name; any other text as it is.

        Raises:
            TaskError: a number that is none of the tasks.
        """
        # It would be read as a formula, in which 1 and 0 are constants.
        # A file of settings makes numbers of such names, and so may a dictionary in Python.
        formula = {str(name): formula for name, formula in self.tasks.items()}.get(str(text), str(text))
        if formula.strip().isdecimal():
            known = ", ".join(f"{number} ({entry})" for number, entry in self.tasks.items()) or "none"
            raise TaskError(f"{self.name} has no task {text}; it has: {known}. Or give a formula.")
        return formula


def host_generators(key: PRNGKeyArray, count: int) -> tuple[np.random.Generator, ...]:
    """Independent NumPy generators from one typed key, so that, say, new colours never move a wall."""
    # SeedSequence mixes the words of the key, and its children are independent by construction.
    words = np.asarray(jax.random.key_data(key)).tolist()
    return tuple(np.random.default_rng(child) for child in np.random.SeedSequence(words).spawn(count))
