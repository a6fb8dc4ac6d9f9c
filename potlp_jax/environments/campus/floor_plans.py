"""Delivery worlds on real floor plans: ``floorplan:FILE.xml``, or ``floorplan:FOLDER`` for all plans of a folder.

Options follow after commas: ``floorplan:FILE.xml,resolution=0.4,kinds=OTHER.yaml``. Names of files hold no comma. Plans
are test data: worlds on them can be drawn from the test split alone (``potlp_jax.environments.splits``).

`plan_floor.rasterise` turns a plan into a floor. A room whose label nobody explained is a room of no particular kind,
and a warning names the label.

A plan is used for every task whose places it has. Its worlds have all propositions of the delivery task, so that
letters mean the same in all of them; one for which the plan has no room holds nowhere. A task that cannot be satisfied
without it is refused by ``FloorPlans.task``. In a folder it is refused where that is so on every plan; on single ones
the world is impossible, and sweeps draw another. ``needs=professor+grad`` leaves plans out that lack one of these. What
every plan needs is a hallway, where the robot starts, and a place.
"""

import os
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from potlp_jax.environments.base import Generator, host_generators
from potlp_jax.environments.campus.delivery import DELIVERY_FAMILY, scaled_to
from potlp_jax.environments.campus.floor_plan_xml import read_kinds, read_plan
from potlp_jax.environments.campus.furnishing import (
    MANY_DOORS,
    PEOPLE,
    FurnishConfig,
    Kind,
    Placement,
    furnish,
    name_kinds,
)
from potlp_jax.environments.campus.people_posterior import PeoplePosterior, people_posterior
from potlp_jax.environments.campus.plan_floor import PlanFloor, rasterise
from potlp_jax.environments.families import FLOOR_PLAN_PREFIX
from potlp_jax.environments.options import parse_options
from potlp_jax.errors import MapError, MapWarning, TaskError
from potlp_jax.task.task import Task
from potlp_jax.world.grid import World
from potlp_jax.world.settings import Settings

NAMED_PLANS = 5
"""Plans of a folder that an error about a task names."""

LOST_ROOMS = 0.25
"""Share of the rooms from which on their loss is worth a warning."""


@dataclass(frozen=True)
class FloorPlanConfig:
    """Which plans, and how they become grids.

    Attributes:
        path: an XML file, or a folder of them.
        resolution: side of a cell in metres.
        kinds: YAML of what the labels mean; None: the shipped one.
        needs: propositions that a plan must have a room for, to be used.
        furnishing: people, light and colours.
    """

    path: str | Path
    resolution: float = 0.5
    kinds: str | Path | None = None
    needs: tuple[str, ...] = ()
    furnishing: FurnishConfig = FurnishConfig()


class FloorPlans(Generator):
    """Worlds on real plans; they differ in the building, who is where, light and colours.

    Attributes:
        name: ``floorplan:`` and the name of the file or folder.
        floors: the buildings, in the order of their files' names.
        left_out: why files of a folder are no buildings, by name.
    """

    propositions = PEOPLE.propositions
    tasks = PEOPLE.tasks
    # They look like the generator's, and the camera shows the same metres.
    family = DELIVERY_FAMILY

    def __init__(self, config: FloorPlanConfig) -> None:
        """Reads and rasterises the plans.

        Raises:
            MapError: a file cannot be used, or no plan of the folder can.

        Warns:
            MapWarning: plans of a folder are left out, a plan has lost more than a quarter of its rooms, or has labels
                of which nothing says what they mean.
        """
        self.config = config
        path, kinds = Path(config.path), read_kinds(config.kinds)
        self.left_out: dict[str, str] = {}
        floors = []
        for file in _files(path):
            try:
                floors.append(_usable_floor(file, kinds, config))
            except MapError as error:
                if not path.is_dir():
                    raise
                self.left_out[file.name] = str(error)
        if not floors:
            raise MapError(path, "", "no plan can be used:\n" + "\n".join(self.left_out.values()))
        self.floors: tuple[PlanFloor, ...] = tuple(floors)
        # From whatever folder its path is written.
        self.name = f"{FLOOR_PLAN_PREFIX}{Path(os.path.abspath(path)).stem}"
        self.settings = Settings({**MANY_DOORS, **scaled_to(config.resolution)})
        shapes = np.array([floor.floor.rooms.shape for floor in floors])
        self._shape = int(shapes[:, 0].max()), int(shapes[:, 1].max())
        self._warn_of_losses(path)

    @classmethod
    def from_spec(cls, spec: str) -> "FloorPlans":
        """From ``floorplan:PATH``, with options ``,resolution=...``, ``,kinds=...`` and ``,needs=...``.

        Raises:
            MapError: the text is not of that form, or see the class.
        """
        return cls(parse_spec(spec))

    def task(self, text: str | int) -> Task:
        """A task over the propositions of the delivery task, as ``Generator.task``.

        Raises:
            TaskError: there is no such task, or it needs places that no plan has.
        """
        task = super().task(text)
        lacking = [(floor, _needed(task, floor.absent)) for floor in self.floors]
        if all(needed for _, needed in lacking):
            plans = "\n".join(
                f"{floor.name} has no room for {', '.join(needed)}; it has {', '.join(floor.present)}. "
                f"Its labels: {', '.join(floor.labels)}"
                for floor, needed in lacking[:NAMED_PLANS]
            )
            more = f"\nand {len(lacking) - NAMED_PLANS} plans more" if len(lacking) > NAMED_PLANS else ""
            raise TaskError(
                f"{self.config.path}: the task {task.text!r} needs places that no plan has:\n{plans}{more}\n"
                "kinds=FILE.yaml gives labels another meaning; or give a task of the places that are there."
            )
        return task

    def draw(self, key: PRNGKeyArray) -> World:
        """The world of this key: a building, drawn uniformly, and people in it."""
        return self.generate_with_layout(key)[0]

    def generate_with_layout(self, key: PRNGKeyArray) -> tuple[World, PlanFloor, Placement]:
        """The world of this key, its building without padding, and who is where."""
        # The key itself draws the building, so that people need one of their own.
        furnish_key = jax.random.fold_in(key, 0)
        floor = self.building(key)
        world, placement = furnish(floor.floor, furnish_key, PEOPLE, self.config.furnishing, self._shape, floor.absent)
        return self.signed(world), floor, placement

    def posterior(self, key: PRNGKeyArray, noise: PRNGKeyArray, count: int) -> PeoplePosterior:
        """Who may be where on the plan of a key, the plan being known; see ``Generator.posterior``.

        Args:
            key: of the world, as of ``generate``: its building is known from the start; in which rooms there is light
                is read as these come in sight.
            noise: another key; decides which places of people are drawn.
            count: how many floors are drawn at a time.

        Returns:
            The posterior before the first panorama, on arrays into which every plan fits: people are in any room of
            their kinds, all equally likely. A person for whom the plan has no room is nowhere.
        """
        _, plan, placement = self.generate_with_layout(key)
        reach = self.config.furnishing.person_radius
        return people_posterior(plan.floor, PEOPLE, reach, placement.rooms, self._shape, noise, count)

    def building(self, key: PRNGKeyArray) -> PlanFloor:
        """The building of this key's world; trials in one building are not independent."""
        (rng,) = host_generators(key, 1)
        return self.floors[int(rng.integers(len(self.floors)))]

    def _warn_of_losses(self, path: Path) -> None:
        if self.left_out:
            names = ", ".join(sorted(self.left_out))
            _warn(path, f"{len(self.left_out)} of {len(self.left_out) + len(self.floors)} plans are left out: {names}")
        for floor in self.floors:
            if floor.report.rooms_lost > LOST_ROOMS * floor.report.rooms:
                _warn(path, f"{floor.name} has lost many of its rooms: {floor.report}")
        # A label that nobody explained must not become some kind of room in silence.
        unknown = sorted({label for floor in self.floors for label in floor.unknown})
        if unknown:
            names = ", ".join(unknown)
            _warn(path, f"no kind is given for {names}: rooms of no particular kind; list them in a file of kinds=")


def parse_spec(spec: str) -> FloorPlanConfig:
    """``floorplan:PATH,option=value,...`` as a configuration.

    Raises:
        MapError: the text is not of that form.
    """
    usage = "write floorplan:FILE.xml (or a folder)[,resolution=METRES][,kinds=FILE.yaml][,needs=NAME+NAME]"
    options = {"resolution": float, "kinds": str, "needs": str}
    path, values = parse_options(spec, FLOOR_PLAN_PREFIX, "plan", options, usage)
    needs = tuple(values.pop("needs").split("+")) if "needs" in values else ()
    unknown = [name for name in needs if name not in PEOPLE.propositions]
    if unknown:
        raise MapError(spec, "needs", f"{unknown[0]!r} is none of {', '.join(PEOPLE.propositions)}; {usage}")
    return FloorPlanConfig(path, needs=needs, **values)


def _files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    files = sorted(path.glob("*.xml"))
    if not files:
        raise MapError(path, "", "the folder holds no .xml file")
    return files


def _usable_floor(file: Path, kinds: Mapping[str, Kind], config: FloorPlanConfig) -> PlanFloor:
    """The floor of a plan. Raises MapError where it has no hallway to start in, no place, or lacks what is needed."""
    found = rasterise(read_plan(file), kinds, config.resolution)
    # Without any place every task would be over at once, or impossible.
    absent = found.absent if not found.present else tuple(name for name in config.needs if name in found.absent)
    needed = [(Kind.HALLWAY,)] * (not found.floor.rooms_of(Kind.HALLWAY)) + [PEOPLE.rooms[name] for name in absent]
    if needed:
        purpose = f"for {', '.join(absent)}" if absent else "where the robot could start"
        raise MapError(
            file,
            "",
            f"no room of kind {name_kinds(tuple(needed))} can be reached, {purpose}. The labels are: "
            f"{', '.join(found.labels)}; kinds=FILE.yaml gives them another meaning. ({found.report})",
        )
    return found


def _needed(task: Task, absent: tuple[str, ...]) -> tuple[str, ...]:
    """Of the propositions that hold nowhere, those without which no path satisfies the task."""
    if task.can_do_without(absent):
        return ()
    alone = tuple(name for name in absent if not task.can_do_without([name]))
    # Of `F grad | F undergrad` neither is needed alone.
    return alone or absent


def _warn(path: Path, message: str) -> None:
    warnings.warn(f"{path}: {message}", MapWarning, stacklevel=4)
