"""Robots of one's own: the contract is checked, legs may fail, maps may grow and be corrected; the record is exact."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from typer.testing import CliRunner

import potlp_jax
from potlp_jax.cli import app
from potlp_jax.errors import PotlpError, RecordError, RobotError
from potlp_jax.learning.labels import TrueMapEstimator
from potlp_jax.planning.policies import Policy
from potlp_jax.trials import loop
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.loop import BrokenDriveError
from potlp_jax.trials.record import BeliefMap, load_trial
from potlp_jax.trials.replay import replay_decision, views_of
from potlp_jax.trials.robot import GrowingRobot, Leg, SimulatedRobot
from potlp_jax.trials.setbacks import SetbackConfig
from potlp_jax.types import NO_STATE
from potlp_jax.view.decisions import describe_decision
from potlp_jax.view.replay_page import replay_data
from potlp_jax.world.grid import belief_from_numpy, make_world, moved_layer

PROPOSITIONS = ("fire", "exit")
TASK = potlp_jax.Task.from_formula("!fire U exit", PROPOSITIONS)
KEY = jax.random.key(0)
FLOOR = np.array(
    [
        list(row)
        for row in (
            "###############",
            "#......#......#",
            "#......#..f...#",
            "#.............#",
            "#......#......#",
            "#......#.....e#",
            "###############",
        )
    ]
)


class Rover:
    """Sees three rows and columns around it and drives three cells at most."""

    def __init__(self, start=(1, 1)):
        self.cells = np.full(FLOOR.shape, BeliefMap.UNKNOWN)
        self.cell = start
        self.sense()

    def sense(self):
        row, column = self.cell
        near = np.s_[max(row - 3, 0) : row + 4, max(column - 3, 0) : column + 4]
        self.cells[near] = np.where(FLOOR[near] == "#", BeliefMap.OCCUPIED, BeliefMap.FREE)

    def arrays(self):
        letters = np.where(FLOOR == "f", 0b01, 0) | np.where(FLOOR == "e", 0b10, 0)
        return self.cells.copy(), np.where(self.cells == BeliefMap.UNKNOWN, 0, letters)

    def observe(self):
        return belief_from_numpy(*self.arrays(), propositions=PROPOSITIONS), self.cell

    def panorama(self):
        raise AssertionError("the baseline takes no panorama")

    def may_enter(self, cell):
        return True

    def advance(self, path, stop):
        cells = []
        for cell in [tuple(map(int, entry)) for entry in np.asarray(path.cells)[1 : int(path.length) + 1][:3]]:
            if not self.may_enter(cell):
                return Leg(cells=tuple(cells), failure="the door is shut")
            self.cell = cell
            self.sense()
            cells.append(cell)
        return Leg(cells=tuple(cells))


class GrowingRover(Rover):
    """Its map is the box of what it knows and a ring of unobserved cells: it grows in all directions."""

    def box(self):
        known = np.argwhere(self.cells != BeliefMap.UNKNOWN)
        # In steps of several cells, so that few shapes are compiled; the box may begin before the floor does.
        top = int(known[:, 0].min()) // 2 * 2 - 1
        return top, -1, 8 - top, 8 + 8 * (int(known[:, 1].max()) // 8)

    @property
    def origin(self):
        return self.box()[:2]

    def observe(self):
        top, left, height, width = self.box()
        cells, letters = self.arrays()
        pad = ((1, height), (1, width))
        cells, letters = np.pad(cells, pad, constant_values=BeliefMap.UNKNOWN), np.pad(letters, pad)
        window = np.s_[top + 1 : top + 1 + height, left + 1 : left + 1 + width]
        belief = belief_from_numpy(cells[window], letters[window], propositions=PROPOSITIONS)
        return belief, (self.cell[0] - top, self.cell[1] - left)

    def advance(self, path, stop):
        top, left, *_ = self.box()
        moved = dataclasses.replace(path, cells=path.cells + jnp.array([[top, left]], jnp.int32))
        leg = super().advance(moved, stop)
        return dataclasses.replace(leg, cells=tuple((row - top, column - left) for row, column in leg.cells))


class MistakenRover(Rover):
    """Takes cells for what they are not, forgets others, and sees a fire that is none; never where it stands."""

    def __init__(self, seed):
        self.random = np.random.default_rng(seed)
        super().__init__()

    def observe(self):
        cells, letters = self.arrays()
        wrong = self.random.random(cells.shape) < 0.06
        wrong[max(self.cell[0] - 1, 0) : self.cell[0] + 2, max(self.cell[1] - 1, 0) : self.cell[1] + 2] = False
        wrong &= FLOOR != "e"
        cells[wrong] = self.random.integers(-1, 2, cells.shape)[wrong]
        letters[wrong] = np.where(cells[wrong] == BeliefMap.FREE, 1, 0)
        letters[cells == BeliefMap.UNKNOWN] = 0
        # Where it drove on the last leg it knows better.
        for cell in self.leg:
            cells[cell], letters[cell] = BeliefMap.FREE, 0b10 if FLOOR[cell] == "e" else 0
        return belief_from_numpy(cells, letters, propositions=PROPOSITIONS), self.cell

    leg = ()

    def advance(self, path, stop):
        leg = super().advance(path, stop)
        self.leg = leg.cells
        return leg


def driven(robot, **options):
    """A trial, and the maps that its decisions were planned on."""
    maps = []
    trial = potlp_jax.run_robot(robot, TASK, "baseline", KEY, listener=lambda _, belief: maps.append(belief), **options)
    return trial, maps


def assert_same_map(found, wanted):
    # A record's world has a ring around it where the robot's map had no border of obstacles.
    ring = (found.cells.shape[0] - wanted.cells.shape[0]) // 2
    cells, letters = np.asarray(wanted.cells), np.asarray(wanted.letters)
    assert np.array_equal(found.cells, np.pad(cells, ring, constant_values=BeliefMap.UNKNOWN))
    assert np.array_equal(found.letters, np.pad(letters, ring))
    assert np.array_equal(found.extent, wanted.extent)


def test_the_record_is_whole_without_a_true_map(tmp_path):
    trial, maps = driven(Rover(), name="rover")
    assert trial.outcome == "satisfied"
    assert trial.environment == "robot:rover"
    trial.save(tmp_path / "trial.json")
    again = load_trial(tmp_path / "trial.json")
    assert again.decisions == trial.decisions
    for decision, belief in zip(again.decisions, maps, strict=True):
        assert_same_map(again.planned_on(decision), belief)
    # What was never observed is an obstacle, and never seen.
    unseen = again.first_seen < 0
    assert unseen.any()
    assert np.asarray(again.world.occupied)[unseen].all()
    assert replay_data(again, views_of(again))["corrections"] == []


@pytest.mark.parametrize("seed", range(6))
def test_what_was_seen_wrongly_is_in_the_record_as_it_was_seen(seed, tmp_path):
    trial, maps = driven(MistakenRover(seed))
    assert trial.corrections
    trial.save(tmp_path / "trial.json")
    trial = load_trial(tmp_path / "trial.json")
    for decision, belief in zip(trial.decisions, maps, strict=True):
        assert_same_map(trial.planned_on(decision), belief)
    # The page shows each of them while it lasted.
    width = trial.world.shape[1]
    for (index, first, until, value, letter), entry in zip(
        replay_data(trial, views_of(trial))["corrections"], trial.corrections, strict=True
    ):
        assert divmod(index, width) == entry.cell
        assert first <= until
        assert (value, letter) == (entry.value, entry.letter)


def test_a_map_that_grows_changes_no_decision():
    wanted, _ = driven(Rover((5, 1)))
    robot = GrowingRover((5, 1))
    assert isinstance(robot, GrowingRobot)
    assert not isinstance(Rover(), GrowingRobot)
    first = robot.origin
    trial, maps = driven(robot)
    # It really grew, to the right and upward, where cells are counted from.
    assert len({belief.cells.shape for belief in maps}) > 1
    assert first != robot.origin
    top, left = robot.origin
    ring = 1 if trial.world.shape != maps[-1].cells.shape else 0
    there = tuple((row + top - ring, column + left - ring) for row, column in trial.path)
    assert there == wanted.path
    assert [decision.kind for decision in trial.decisions] == [decision.kind for decision in wanted.decisions]
    for decision, belief in zip(trial.decisions, maps, strict=True):
        found = trial.planned_on(decision)
        assert int((~found.unknown).sum()) == int((~belief.unknown).sum())
        assert np.array_equal(found.extent, belief.extent)


@struct.dataclass
class Footprints:
    """Remembers in which cells the camera looked, and takes what is beside one for less likely."""

    memory: jax.Array

    @classmethod
    def of_shape(cls, shape):
        return cls(memory=jnp.zeros(shape, bool))

    def encode(self, panorama):
        return panorama

    def remember(self, seen, belief, cell):
        return dataclasses.replace(self, memory=self.memory.at[cell[0], cell[1]].set(True))

    def __call__(self, belief, subgoals, task):
        rows, columns = jnp.nonzero(self.memory, size=64, fill_value=10_000)
        away = jnp.abs(subgoals.cells[:, 0, None] - rows[None]) + jnp.abs(subgoals.cells[:, 1, None] - columns[None])
        # By how near they are, so that a memory that is off by a cell answers otherwise.
        visits = jnp.sum(jnp.maximum(8 - away, 0), axis=1, dtype=jnp.int32)
        shape = (subgoals.mask.shape[0], task.class_mask.shape[0])
        chance = jnp.broadcast_to(0.8 / (1 + visits.astype(jnp.float32) / 4)[:, None], shape)
        return potlp_jax.Estimates(
            success_probability=jnp.where(task.class_mask[None, :], chance, 0.0),
            success_cost=jnp.full(shape, 5.0),
            failure_cost=jnp.full(shape, 5.0),
        )


@struct.dataclass
class Carried(Footprints):
    """Goes along with the map."""

    def moved(self, shape, rows, columns):
        return dataclasses.replace(self, memory=moved_layer(self.memory, shape, rows, columns, False))


@pytest.mark.parametrize(("rows", "columns"), [(0, 0), (2, 3), (-2, 1), (1, -4), (-3, -3), (9, 0), (0, -8), (4, 6)])
def test_a_layer_moves_cell_by_cell(rows, columns):
    layer = np.arange(6 * 8 * 2, dtype=np.int32).reshape(6, 8, 2)
    found = np.asarray(moved_layer(jnp.asarray(layer), (7, 9), rows, columns, -1))
    assert found.shape == (7, 9, 2)
    for row, column in np.ndindex(7, 9):
        before = row - rows, column - columns
        had = 0 <= before[0] < 6 and 0 <= before[1] < 8
        assert found[row, column].tolist() == (layer[before].tolist() if had else [-1, -1])


def looking(kind):
    """A rover of a kind whose camera shows nothing in particular."""

    class Looking(kind):
        def panorama(self):
            return jnp.zeros((4, 8, 3), jnp.uint8)

    return Looking((5, 1))


@pytest.mark.long
def test_an_estimator_that_moves_with_the_map_answers_as_if_it_had_never_grown(caplog):
    def chances(robot, estimator):
        trial = potlp_jax.run_robot(robot, TASK, "potlp", KEY, estimator=estimator)
        return [[action.success_probability for action in decision.actions] for decision in trial.decisions]

    wanted = chances(looking(Rover), Footprints.of_shape(FLOOR.shape))
    # What was seen before the map grew counts: only then is no frontier as likely as one that nobody was near.
    assert any(max(row) < 0.4 for row in wanted[2:] if row)
    robot = looking(GrowingRover)
    assert chances(robot, Carried.of_shape(robot.observe()[0].cells.shape)) == wanted
    assert "forgets" not in caplog.text
    robot = looking(GrowingRover)
    potlp_jax.run_robot(robot, TASK, "potlp", KEY, estimator=Footprints.of_shape(robot.observe()[0].cells.shape))
    assert "forgets" in caplog.text


class Shut(Rover):
    """Cannot get past the door in the middle until it has tried so many times."""

    def __init__(self, attempts):
        super().__init__()
        self.left = attempts

    def may_enter(self, cell):
        if cell[1] < 7:
            return True
        self.left -= 1
        return self.left < 0


def test_a_target_is_tried_again_and_then_set_aside_and_the_record_says_so():
    trial, _ = driven(Shut(3))
    assert trial.outcome == "satisfied"
    failed = [decision for decision in trial.decisions if decision.failure]
    assert [decision.failure for decision in failed] == ["the door is shut"] * 3
    # Tried again at once: nothing is set aside before the second failure, something after it.
    first = failed[0].index
    assert failed[1].index == first + 1
    assert not trial.decisions[first + 1].set_aside
    assert any(decision.set_aside for decision in trial.decisions)
    assert "the robot failed: the door is shut" in describe_decision(trial, failed[0])


def test_a_door_that_stays_shut_ends_the_trial_as_stuck():
    config = SetbackConfig(attempts=2, decisions=3, give_up=5)
    trial, _ = driven(Shut(10**6), setbacks=config)
    assert trial.outcome == "stuck"
    # Not at the third decision in one place, as a cycle would be.
    assert sum(bool(decision.failure) for decision in trial.decisions) >= 5


def leg_of(cells, **others):
    """A leg as somebody's program makes it, where nothing checks types."""
    leg = Leg(cells=())
    for name, value in {"cells": cells, **others}.items():
        object.__setattr__(leg, name, value)
    return leg


class Breaks(Rover):
    """Breaks the contract in one way, on its second leg."""

    legs = 0

    def __init__(self, fault):
        super().__init__()
        self.fault = fault

    def advance(self, path, stop):
        leg = super().advance(path, stop)
        self.legs += 1
        if self.legs == 2 and self.fault == "jumps":
            return Leg(cells=leg.cells[1:])
        if self.legs == 2 and self.fault == "elsewhere":
            self.cell = leg.cells[0]
        if self.legs == 2 and self.fault == "no leg":
            return leg.cells
        if self.legs == 2 and self.fault == "fractions":
            return leg_of([(row + 0.5, column) for row, column in leg.cells])
        if self.legs == 2 and self.fault == "flat":
            return leg_of([5])
        if self.legs == 2 and self.fault == "no cells":
            return leg_of(None)
        if self.legs == 2 and self.fault == "no words":
            return leg_of(leg.cells, failure=3)
        return leg

    def observe(self):
        if self.legs < 2:
            return super().observe()
        cells, letters = self.arrays()
        names = PROPOSITIONS
        if self.fault == "blocked":
            cells[self.cell] = BeliefMap.OCCUPIED
        if self.fault == "outside":
            return super().observe()[0], (99, 0)
        if self.fault == "grows":
            cells, letters = np.pad(cells, 1), np.pad(letters, 1)
        if self.fault == "names":
            names = ("exit", "fire")
        if self.fault == "nothing":
            return None
        if self.fault == "number":
            return super().observe()[0], 5
        if self.fault == "floats":
            return super().observe()[0], tuple(map(float, self.cell))
        if self.fault == "ragged":
            return super().observe()[0], ((1, 2), 3)
        if self.fault == "damaged map":
            belief, cell = super().observe()
            # Nothing checks types where somebody else makes it.
            object.__setattr__(belief, "cells", None)
            return belief, cell
        if self.fault == "fraction":
            belief, cell = super().observe()
            object.__setattr__(belief, "letters", np.asarray(belief.letters, np.float32))
            return belief, cell
        if self.fault in ("letter", "extent"):
            belief, cell = super().observe()
            changed = {
                "letter": {"letters": belief.letters.at[cell].set(9)},
                "extent": {"extent": belief.extent * 0},
            }
            return belief.replace(**changed[self.fault]), cell
        if self.fault == "no map":
            cells[:] = 7
        resolution = 0.5 if self.fault == "resolution" else 1.0
        return belief_from_numpy(cells, letters, resolution, propositions=names), self.cell


FAULTS = (
    ("jumps", "no neighbour"),
    ("elsewhere", "says that it is in cell"),
    ("no leg", "returns a Leg"),
    ("blocked", "not free in the map"),
    ("outside", "says that it is in cell \\(99, 0\\)"),
    ("grows", "GrowingRobot"),
    ("names", "propositions"),
    ("resolution", "onto one grid"),
    ("nothing", "observe\\(\\) returns"),
    ("number", "the cell that observe\\(\\) returns is a pair \\(row, column\\), found 5"),
    ("floats", "of whole numbers, found"),
    ("ragged", "found \\(\\(1, 2\\), 3\\)"),
    ("damaged map", "the cells of the robot's map are object; give whole numbers"),
    ("letter", r"the robot's map: letters of .* must lie in 0\.\.3, found 0\.\.9"),
    ("fraction", "the letters of the robot's map are float32; give whole numbers"),
    ("extent", r"and the extent \[0, 0\]"),
    ("no map", "observe\\(\\) of the robot raised WorldError"),
    ("fractions", "each cell of a leg is a pair \\(row, column\\) of whole numbers, found"),
    ("flat", "each cell of a leg is a pair \\(row, column\\), found 5"),
    ("no cells", "the cells of the leg raised TypeError"),
    ("no words", "in words, found 3"),
)
"""Of ``Breaks``, and what is said of each."""


@pytest.mark.parametrize(("fault", "said"), FAULTS)
def test_a_broken_contract_is_named(fault, said):
    with pytest.raises(RobotError, match=said):
        driven(Breaks(fault))


def broken_off(robot):
    """The record of a drive that ends by an error, the error, and the maps that its decisions were planned on."""
    maps = []
    with pytest.raises(BrokenDriveError) as caught:
        potlp_jax.run_robot(robot, TASK, "baseline", KEY, listener=lambda _, belief: maps.append(belief))
    assert caught.value.trial is not None
    return caught.value.trial, str(caught.value), maps


@pytest.mark.parametrize("fault", [fault for fault, _ in FAULTS])
def test_a_drive_that_breaks_off_leaves_its_record(fault, tmp_path):
    whole, _ = driven(Rover())
    trial, error, maps = broken_off(Breaks(fault))
    assert trial.outcome == "unfinished"
    # The second leg fails: until then it did what a robot without a fault did.
    assert [decision.target for decision in trial.decisions] == [decision.target for decision in whole.decisions[:2]]
    assert trial.path == whole.path[: whole.decisions[1].step + 1]
    assert trial.notes[-1] == f"the drive ended by an error: {error}"
    trial.save(tmp_path / "trial.json")
    again = load_trial(tmp_path / "trial.json")
    for decision, belief in zip(again.decisions, maps, strict=True):
        assert_same_map(again.planned_on(decision), belief)


@pytest.mark.parametrize(
    ("cells", "cell"), [(list, tuple), (list, list), (np.array, np.array), (tuple, lambda cell: tuple(np.array(cell)))]
)
def test_cells_of_any_whole_numbers_decide_alike(cells, cell, monkeypatch):
    class Converts(Rover):
        def observe(self):
            belief, here = super().observe()
            return belief, cell(here)

        def advance(self, path, stop):
            return leg_of(cells([cell(there) for there in super().advance(path, stop).cells]))

    decide, intentions = loop._decide, []

    def note(*arguments, **options):
        intention = arguments[6]
        intentions.append((intention.cell.tolist(), int(intention.edge), int(intention.state)))
        return decide(*arguments, **options)

    def run(kind):
        intentions.clear()
        trial = potlp_jax.run_robot(looking(kind), TASK, "potlp", KEY, estimator=Footprints.of_shape(FLOOR.shape))
        # What the robot is committed to where it went where it was told.
        return trial.decisions, trial.path, tuple(intentions)

    monkeypatch.setattr(loop, "_decide", note)
    wanted = run(Rover)
    assert any(state != NO_STATE for _, _, state in wanted[2])
    assert run(Converts) == wanted


def test_a_remark_that_cannot_be_had_costs_no_record():
    class Mute(Rover):
        @property
        def noticed(self):
            raise OSError("no voice")

    assert driven(Mute())[0].notes == ("noticed of the robot raised OSError: no voice",)


@pytest.mark.parametrize("policy", ["known-map", "known_map", Policy.KNOWN_MAP])
def test_no_robot_knows_the_map(policy):
    with pytest.raises(PotlpError, match="known-map knows all from the start, and this robot does not"):
        potlp_jax.run_robot(Rover(), TASK, policy, KEY)
    # Nor one whose settings are of a simulation that shows all.
    with pytest.raises(PotlpError, match="known-map knows all from the start, and this robot does not"):
        potlp_jax.run_robot(Rover(), TASK, policy, KEY, TrialConfig(revealed=True))


def test_a_listener_that_fails_leaves_the_record():
    def fails(decision, belief):
        if decision.index == 2:
            raise BrokenPipeError("nobody reads")

    with pytest.raises(BrokenDriveError, match="the listener raised BrokenPipeError: nobody reads") as caught:
        potlp_jax.run_robot(Rover(), TASK, "baseline", KEY, listener=fails)
    assert caught.value.trial is not None
    assert len(caught.value.trial.decisions) == 3


def test_a_growing_map_that_breaks_off_leaves_the_record_on_the_map_before():
    class Fails(GrowingRover):
        def __init__(self, legs):
            self.legs = legs
            super().__init__((5, 1))

        def advance(self, path, stop):
            leg = super().advance(path, stop)
            self.legs -= 1
            return leg

        def observe(self):
            if not self.legs:
                raise ConnectionError("the battery is empty")
            return super().observe()

    whole, maps = driven(GrowingRover((5, 1)))
    assert len({belief.cells.shape for belief in maps}) > 1
    for legs in range(1, len(whole.decisions)):
        trial, error, maps = broken_off(Fails(legs))
        assert error == "observe() of the robot raised ConnectionError: the battery is empty"
        rows, columns = np.subtract(whole.path[0], trial.path[0])
        steps = whole.decisions[legs - 1].step
        assert [(row + rows, column + columns) for row, column in trial.path] == list(whole.path[: steps + 1])
        for decision, belief in zip(trial.decisions, maps, strict=True):
            assert int((~trial.planned_on(decision).unknown).sum()) == int((~belief.unknown).sum())


@pytest.mark.parametrize("lost", ["top", "right"])
def test_a_map_that_loses_a_part_is_refused(lost):
    """A window that moves with the robot: what was decided there before could not be told on it."""

    class Window(Rover):
        left = False

        @property
        def origin(self):
            return (1 if self.left and lost == "top" else 0), 0

        def observe(self):
            cells, letters = self.arrays()
            window = np.s_[self.origin[0] :, : -1 if self.left and lost == "right" else None]
            return (
                belief_from_numpy(cells[window], letters[window], propositions=PROPOSITIONS),
                (self.cell[0] - self.origin[0], self.cell[1]),
            )

        def advance(self, path, stop):
            leg = super().advance(path, stop)
            self.left = True
            return leg

    with pytest.raises(RobotError, match="loses no row or column"):
        driven(Window((3, 2)))


def test_the_record_says_which_estimator_was_asked_also_where_the_map_is_known():
    letters = np.where(FLOOR == "f", 1, np.where(FLOOR == "e", 2, 0))
    world = make_world(FLOOR == "#", letters, (1, 1), propositions=PROPOSITIONS)
    of_ones_own = TrueMapEstimator(world=world)
    config = TrialConfig()
    asked, not_asked = (
        potlp_jax.run_robot(
            SimulatedRobot(world, config), TASK, policy, KEY, config, world=world, estimator=of_ones_own
        )
        for policy in ("potlp", "baseline")
    )
    assert "TrueMapEstimator" in asked.versions["estimator"]
    assert "estimator" not in not_asked.versions


def test_what_the_oracle_asked_is_not_in_the_record_of_a_robots_drive(tmp_path):
    """The record's world is the last map: its answers would be others, and the search another."""
    letters = np.where(FLOOR == "f", 1, np.where(FLOOR == "e", 2, 0))
    world = make_world(FLOOR == "#", letters, (1, 1), propositions=PROPOSITIONS)
    config = TrialConfig()
    trial = potlp_jax.run_robot(SimulatedRobot(world, config), TASK, "oracle", KEY, config, world=world)
    said = "the oracle asked the true map, which is not in the record of a robot's drive"
    with pytest.raises(RecordError, match=said):
        replay_decision(trial, 0)
    trial.save(tmp_path / "trial.json")
    drawn = CliRunner().invoke(app, ["explain", f"{tmp_path}:0", "--out", str(tmp_path / "tree.png")])
    assert (drawn.exit_code, " ".join(drawn.stderr.split())) == (2, f"potlp: {said}")
    assert CliRunner().invoke(app, ["explain", f"{tmp_path}:0"]).exit_code == 0
    assert CliRunner().invoke(app, ["view", str(tmp_path), "--no-open"]).exit_code == 0


def test_a_late_leg_is_noted():
    trial, _ = driven(Rover(), seconds_per_cell=0.0)
    assert len(trial.notes) == len(trial.decisions)
    assert "late" in trial.notes[0]
    assert not driven(Rover())[0].notes


def test_what_a_robot_notices_is_noted():
    class Doubtful(Rover):
        noticed = ("exit: in a wall",)

    assert driven(Doubtful())[0].notes == ("exit: in a wall",)


def test_another_map_is_no_reason_to_give_up():
    """A robot that knows no move stands, and its map arrives a moment later."""

    class Slow(Rover):
        waited = 0

        def sense(self):
            super().sense()
            if self.waited < 1:
                self.cells[self.cells == BeliefMap.UNKNOWN] = BeliefMap.OCCUPIED

        def advance(self, path, stop):
            if not int(path.length):
                self.waited += 1
                self.cells[:] = BeliefMap.UNKNOWN
                self.sense()
                return Leg(cells=())
            return super().advance(path, stop)

    trial, _ = driven(Slow())
    assert trial.decisions[0].kind == "none"
    assert trial.outcome == "satisfied"
