"""The robot that the loop of a trial knows: what was heard from a machine, and legs that somebody drives there."""

import math
import time
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int8, Int32, UInt8

from potlp_jax.drive.config import DriveConfig, Mode
from potlp_jax.drive.inbox import Heard, Inbox, Pose
from potlp_jax.drive.lattice import Lattice, LatticeConfig
from potlp_jax.drive.movers import Mover
from potlp_jax.drive.rejoining import rest_of_path
from potlp_jax.environments.ros.grid_frame import GridFrame
from potlp_jax.environments.ros.places import Places, Region, free_cell_beside
from potlp_jax.environments.ros.poses import FARTHEST_SNAP, shortest
from potlp_jax.errors import RobotError
from potlp_jax.planning.distances.paths import KnownPath
from potlp_jax.trials.robot import Leg
from potlp_jax.trials.rules import Knowledge, Stop
from potlp_jax.world.camera import CameraConfig
from potlp_jax.world.equirectangular import from_equirectangular
from potlp_jax.world.grid import BeliefMap, belief_from_numpy
from potlp_jax.world.moves import Cell, as_cell, path_length

POLL: float = 0.1
"""Seconds after which the robot is looked after when nothing was heard."""

HYSTERESIS: float = 0.1
"""Cells beyond a cell's edge from which on the robot is in the next: a pose trembles."""

SETTLED: float = 1.0
"""Seconds after the end of a navigation for which its last poses may still be on their way."""

REASONS: int = 20
"""Reasons for which messages were refused that are told, at most: of damaged messages each may have its own."""

ASTRAY: int = 2
"""Cells from the path from which on a robot that somebody else drives goes elsewhere, and is advised anew."""


class InterruptionError(Exception):
    """Whoever drives has ended the drive before its first decision: there is nothing to record."""


class RemoteRobot:
    """A ``GrowingRobot`` behind an inbox. Where it was last observed is where it is until the next leg."""

    def __init__(
        self,
        inbox: Inbox,
        mover: Mover,
        config: DriveConfig,
        propositions: Sequence[str],
        *,
        places: Places | None = None,
        camera: CameraConfig = CameraConfig(),
        interrupted: Callable[[], bool] = lambda: False,
        replaced: Callable[[], bool] = lambda: False,
        say: Callable[[str], None] = lambda _text: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Wait for the first map and pose.

        Args:
            inbox: what is heard.
            mover: who drives.
            config: settings.
            propositions: of the task.
            places: where propositions hold that are known beforehand.
            camera: of the estimator.
            interrupted: whether the drive shall end; asked again and again.
            replaced: whether another task is wanted, to which a trial gives way that has begun; asked likewise.
            say: told in words what a person should know.
            clock: seconds.

        Raises:
            InterruptionError: ``interrupted`` before map and pose had come.
            RobotError: no map or no pose within ``config.patience``, or the robot is not on its map.
        """
        self._inbox, self._mover, self._config = inbox, mover, config
        self._propositions, self._places, self._camera = tuple(propositions), places, camera
        self._interrupted, self._replaced, self._say, self._clock = interrupted, replaced, say, clock
        self._noticed: list[str] = []
        self._told = set[str]()
        self._notice_unused_places()
        heard = self._await_first()
        assert heard.scan is not None
        self._lattice = Lattice(
            heard.scan.frame, LatticeConfig(config.resolution, config.radius, config.free, config.occupied)
        )
        # Cells entered since the last observation, and those with the one before: where it drove it is free, whatever
        # the map says a moment later.
        self._entered: list[Cell] = []
        self._sure: list[Cell] = []
        self._laid = -1
        # Since when no map could be laid, and why.
        self._useless_since, self._useless = math.inf, ""
        self._checked = set[Region]()
        self._cell = self._first_cell()
        self._sure.append(self._cell)
        self._inbox.take_poses()
        self._reported = self._lattice.origin
        self._end_noticed = math.inf

    @property
    def origin(self) -> Cell:
        """Of the map that was observed last."""
        return self._reported

    @property
    def noticed(self) -> tuple[str, ...]:
        """What was doubtful about its map, its places and its messages, in words."""
        return (*self._noticed, *(f"refused: {reason}" for reason in self._refusals(REASONS)))

    @property
    def frame(self) -> GridFrame:
        """Where the map that was observed last lies, in metres."""
        return self._lattice.frame

    @property
    def frame_id(self) -> str:
        """The map's frame."""
        return self._inbox.heard.frame_id

    def observe(self) -> tuple[BeliefMap, Cell]:
        """The newest map, and the cell where the last leg ended."""
        self._tell_refused()
        self._lay(self._inbox.heard)
        self._reported = self._lattice.origin
        belief = self._belief()
        self._entered, self._sure = [], [self._cell]
        return belief, self._in_window(self._cell)

    def panorama(self) -> UInt8[Array, "rows columns 3"]:
        """The newest picture, as the estimator's camera would have taken it. Raises RobotError."""
        heard = self._inbox.heard
        if heard.picture is None or heard.pose is None:
            raise RobotError(
                f"no picture was heard on {self._config.topics.image or 'any topic'}: this policy looks at panoramas; "
                f"name their topic, or choose the policy baseline. {self._refused()}"
            )
        height, width, _ = heard.picture.shape
        # Headings grow counter-clockwise with y upward, bearings clockwise with rows downward.
        looks = heard.pose[2] + math.radians(self._config.camera_yaw) - self._lattice.frame.yaw
        # Pixels are square; what reaches over more than a half circle is refused when it is heard.
        field = 2 * math.pi * height / width
        return jnp.asarray(from_equirectangular(heard.picture, self._camera, -looks, min(field, math.pi)))

    def advance(self, path: KnownPath, stop: Stop) -> Leg:
        """See the robot along a path, until it has arrived, a new decision is due, or it cannot go on."""
        if self._config.mode is Mode.DRY:
            return Leg(cells=(), ended=True)
        row, column = self._reported
        cells = [as_cell(cell) for cell in np.asarray(path.cells)[: int(path.length) + 1]]
        planned = [(there[0] + row, there[1] + column) for there in cells]
        if self._gives_way():
            # No goal is sent any more; what was driven while it was decided is known.
            self._follow(self._inbox.take_poses())
            leg = self._halt()
        else:
            leg = self._await_map() if len(planned) == 1 else self._travel(planned, stop)
        return Leg(tuple((r - row, c - column) for r, c in leg.cells), leg.ended, leg.failure)

    def _travel(self, planned: list[Cell], stop: Stop) -> Leg:
        """Along a path on the lattice; the cells of the leg are on it, too."""
        before, begun = Knowledge.of(self._belief()), self._clock()
        self._end_noticed = math.inf
        self._follow(self._inbox.take_poses())
        ahead = self._ahead(planned)
        if not ahead:
            # It is where it was to go; the goal before may lead beyond, and the next decision takes time.
            self._mover.stop()
            return Leg(tuple(self._entered))
        self._mover.begin([self._metres(cell) for cell in ahead], self.frame_id)
        while True:
            self._wait()
            heard = self._inbox.heard
            self._follow(self._inbox.take_poses())
            leg = tuple(self._entered)
            if self._gives_way():
                return self._halt()
            if failure := self._failure(heard, len(planned), begun, bool(leg)):
                self._mover.stop()
                return Leg(leg, ended=not self._is_heard_again(heard), failure=failure)
            if self._is_over(heard, planned, leg, before, stop):
                return Leg(leg)

    def _gives_way(self) -> bool:
        """Whether the trial ends here, whatever is left of its task."""
        return self._interrupted() or self._replaced()

    def _halt(self) -> Leg:
        """Stop, and move no more; the cells of the leg are on the lattice."""
        self._mover.stop()
        return Leg(tuple(self._entered), ended=True)

    def _ahead(self, planned: list[Cell]) -> list[Cell]:
        """What of a path on the lattice is left to a robot that drove on while it was decided."""
        values, (top, left) = self._shown(), self._lattice.origin
        path, entered = ([self._in_window_now(cell) for cell in part] for part in (planned, self._entered))
        rest = rest_of_path(path, entered, values == BeliefMap.FREE, self._letters(values))
        return [(row + top, column + left) for row, column in rest]

    def _failure(self, heard: Heard, cells: int, begun: float, moved: bool) -> str:
        """Why a robot that is commanded cannot go on, in words; empty where it can."""
        if not self._mover.commands:
            return ""
        now, ended = self._clock(), self._mover.ended()
        if now - heard.heard > self._config.silence:
            return f"no pose for {now - heard.heard:.1f} s: the robot was stopped"
        if ended is not None and not ended.succeeded:
            return ended.words
        # Nothing would change, and the same goal would be sent again.
        if not moved and ended is not None and self._has_settled(heard):
            return f"{ended.words}, and the robot has not moved"
        limit = self._config.silence + self._config.seconds_per_cell * cells
        return f"{cells - 1} cells took more than {limit:.0f} s: the robot is late" if now - begun > limit else ""

    def _has_settled(self, heard: Heard) -> bool:
        """Whether the navigation ended so long ago that the newest pose is the last one."""
        if self._mover.ended() is None:
            return False
        self._end_noticed = min(self._end_noticed, self._clock())
        return heard.heard >= self._end_noticed + SETTLED

    def _is_heard_again(self, heard: Heard) -> bool:
        """Whether poses come, now or within the time that one is patient and does not interrupt."""
        begun = self._clock()
        silent = begun - heard.heard > self._config.silence
        if silent:
            self._say("stopped: nothing is heard of the robot's pose")
        while self._clock() - self._inbox.heard.heard > self._config.silence:
            if self._interrupted() or self._clock() - begun > self._config.patience:
                return False
            self._wait()
        if silent:
            # The silence may have been that of the connection, over which nothing was taken back.
            self._mover.stop()
            self._say("the robot's pose is heard again")
        return True

    def _is_over(self, heard: Heard, planned: list[Cell], leg: tuple[Cell, ...], before: Knowledge, stop: Stop) -> bool:
        """Whether a leg that goes well ends here."""
        if leg and (self._cell == planned[-1] or self._has_settled(heard)):
            return True
        # Nobody's path is followed exactly; far from it another one may be better.
        if leg and not self._mover.commands and min(_distance(self._cell, cell) for cell in planned) > ASTRAY:
            return True
        if not self._lay(heard):
            return False
        row, column = self._lattice.origin
        target = jnp.asarray((planned[-1][0] - row, planned[-1][1] - column), jnp.int32)
        travelled = jnp.float32(path_length([planned[0], *leg]))
        due = bool(_is_due(stop, before, self._belief(), target, travelled))
        # Without a move the same would be decided again, unless more is known: a robot that is advised may wait.
        return due and (bool(leg) or not self._mover.commands)

    def _await_first(self) -> Heard:
        begun = self._clock()
        while (heard := self._inbox.heard).scan is None or heard.pose is None:
            if self._clock() - begun > self._config.patience:
                missing = "no map" if heard.scan is None else "no pose in the frame of the map"
                topics = self._config.topics
                raise RobotError(
                    f"{missing} within {self._config.patience:g} s: is {topics.map if heard.scan is None else 'the'} "
                    f"{'published' if heard.scan is None else topics.pose or topics.tf + ' published'}, and "
                    f"{self._config.base_frame!r} the robot's frame? {self._refused()}"
                )
            self._wait_for_the_first()
        return heard

    def _wait_for_the_first(self) -> None:
        if self._interrupted():
            raise InterruptionError
        self._wait()

    def _wait(self) -> None:
        """Let a moment pass, or less where something is heard, and say what was refused."""
        self._inbox.wait(POLL)
        self._tell_refused()

    def _tell_refused(self) -> None:
        """Say each new reason for which messages are refused, once; how often is in ``noticed``."""
        # A message of which one word is misspelt is left out as a whole, and nothing else would tell.
        new = [reason for reason in self._inbox.refused if reason not in self._told]
        for reason in new[: REASONS - len(self._told)]:
            self._told.add(reason)
            self._say(f"refused: {reason}")

    def _refusals(self, most: int) -> list[str]:
        """Reasons for which messages were refused, the most frequent ones, and how often."""
        refused = self._inbox.refused.most_common(most)
        return [f"{reason} ({'once' if count == 1 else f'{count} times'})" for reason, count in refused]

    def _refused(self) -> str:
        refused = self._refusals(3)
        return "Refused: " + "; ".join(refused) if refused else ""

    def _await_map(self) -> Leg:
        """Stand until more or something else is known, for there is nowhere to go."""
        # A leg that ended for a new decision has left its goal on its way.
        self._mover.stop()
        begun, known = self._clock(), self._known()
        # A map that came anew, or turned a little, may say the same once more: what is missing may still be on its way.
        while self._clock() - begun < self._config.patience and not self._has_changed(known):
            if self._gives_way():
                return self._halt()
            self._wait()
            self._follow(self._inbox.take_poses())
            # Somebody may carry it on.
            if self._entered:
                break
        return Leg(tuple(self._entered))

    def _known(self) -> tuple[Int8[np.ndarray, "H W"], Int32[np.ndarray, "H W"]]:
        values = self._shown()
        return values, self._letters(values)

    def _has_changed(self, known: tuple[Int8[np.ndarray, "H W"], Int32[np.ndarray, "H W"]]) -> bool:
        """Whether the newest map or places say something else than was known."""
        return self._lay(self._inbox.heard) and not all(map(np.array_equal, known, self._known()))

    def _first_cell(self) -> Cell:
        """Where the robot is at first. A pose that is not on the map may be an error of localisation: it waits."""
        begun = self._clock()
        while True:
            # A map in another frame takes the pose back.
            heard = self._await_first()
            assert heard.pose is not None
            self._lay(heard)
            cell = self._snapped(self._lattice.cell_of(*heard.pose[:2]))
            if cell is not None:
                return cell
            if self._clock() - begun > self._config.patience:
                raise RobotError(
                    f"the robot is at [{heard.pose[0]:.2f}, {heard.pose[1]:.2f}], where its map has no free cell "
                    f"within {FARTHEST_SNAP:g} cells: is it localised, and is the radius of {self._config.radius:g} m "
                    "right?"
                )
            self._wait_for_the_first()

    def _follow(self, poses: Sequence[Pose]) -> None:
        """Enter the cells that the poses lie in; between cells that are no neighbours, along the shortest path."""
        for x, y, _ in poses:
            down, across = self._lattice.position_of(x, y)
            row, column = self._cell
            if max(abs(down - row - 0.5), abs(across - column - 0.5)) <= 0.5 + HYSTERESIS:
                continue
            cell = self._snapped((math.floor(down), math.floor(across)))
            if cell is not None and cell != self._cell:
                self._enter(cell)

    def _enter(self, cell: Cell) -> None:
        free = self._free()
        try:
            between = shortest(free, self._in_window_now(self._cell), self._in_window_now(cell))
        except KeyError:
            # No way leads there that is known: localisation has jumped, or a map is late. A later pose may tell.
            return
        row, column = self._lattice.origin
        cells = [(there[0] + row, there[1] + column) for there in between]
        self._entered += cells
        self._sure += cells
        self._cell = cell

    def _snapped(self, cell: Cell) -> Cell | None:
        """The free cell nearest to a cell of the lattice, if one is near."""
        reach = FARTHEST_SNAP + self._config.radius / self._config.resolution
        free, (row, column) = self._free(), self._in_window_now(cell)
        height, width = free.shape
        near = [
            (math.hypot(down, right), row + down, column + right)
            for down in range(-math.floor(reach), math.floor(reach) + 1)
            for right in range(-math.floor(reach), math.floor(reach) + 1)
            if 0 <= row + down < height and 0 <= column + right < width and math.hypot(down, right) <= reach
        ]
        found = min((entry for entry in near if free[entry[1:]]), default=None)
        top, left = self._lattice.origin
        return None if found is None else (found[1] + top, found[2] + left)

    def _lay(self, heard: Heard) -> bool:
        """Take the newest map and places; returns whether any came. Raises RobotError."""
        if self._laid == heard.maps:
            # The last map that came was of no use, and no other follows.
            self._check_patience()
            return False
        assert heard.scan is not None
        self._regions = heard.regions
        try:
            self._values = self._lattice.lay(heard.scan)
            self._useless_since = math.inf
        except RobotError as error:
            self._leave_out(error)
        self._laid = heard.maps
        self._check_patience()
        return True

    def _leave_out(self, error: RobotError) -> None:
        """Keep the map before, where there is one: the next may be right. Raises RobotError where there is none."""
        if self._laid < 0:
            raise error
        if self._useless_since == math.inf:
            self._useless_since = self._clock()
            self._notice(f"a map is left out, and the one before stays: {error}")
        self._useless = str(error)

    def _check_patience(self) -> None:
        """Raise RobotError where the map has been of no use for long."""
        since = self._clock() - self._useless_since
        if since > self._config.patience:
            raise RobotError(f"no map of use for {since:.0f} s: {self._useless}")

    def _free(self) -> Bool[np.ndarray, "H W"]:
        return self._shown() == BeliefMap.FREE

    def _shown(self) -> Int8[np.ndarray, "H W"]:
        """The map, with what was entered free."""
        values = self._values.copy()
        for cell in self._sure:
            values[self._in_window_now(cell)] = BeliefMap.FREE
        return values

    def _belief(self) -> BeliefMap:
        values, letters = self._known()
        return belief_from_numpy(values, letters, self._config.resolution, propositions=self._propositions)

    def _letters(self, values: Int8[np.ndarray, "H W"]) -> Int32[np.ndarray, "H W"]:
        letters, free = np.zeros(values.shape, np.int32), values == BeliefMap.FREE
        for name, region in (*self._known_regions(), *self._regions):
            covered = region.covers(free, self._lattice.frame)
            if not covered.any():
                self._notice_if_tiny(name, region)
                covered = self._moved(name, region, values)
            letters[covered] |= 1 << self._propositions.index(name)
        return letters

    def _moved(self, name: str, region: Region, values: Int8[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
        """The cell beside a place that lies in obstacles, where there is one, and a word on it."""
        free, obstacle = values == BeliefMap.FREE, values == BeliefMap.OCCUPIED
        cell, covered = free_cell_beside(region, free, obstacle, self._lattice.frame), np.zeros_like(free)
        if cell is None:
            own = region.covers(np.ones_like(free), self._lattice.frame)
            if own.any() and obstacle[own].all():
                self._notice(f"{name}: {region} lies in obstacles of the map, no free cell touches it: it is nowhere")
        else:
            covered[cell] = True
            x, y = self._lattice.frame.cell_to_metres(*cell)
            # Places keep their metres where a map that turns does not: one that was nowhere would end the task.
            self._notice(f"{name}: {region} lies in an obstacle of the map; it is taken to be at [{x:.2f}, {y:.2f}]")
        return covered

    def _notice_if_tiny(self, name: str, region: Region) -> None:
        if region not in self._checked:
            self._checked.add(region)
            if not self._lattice.has_centre_in(region):
                size = self._config.resolution
                self._notice(
                    f"{name}: {region} holds the centre of no cell of {size:g} m, and is nowhere: make it larger"
                )

    def _notice_unused_places(self) -> None:
        """Labels may be of more than a task is about; a name that is misspelt looks the same."""
        unused = () if self._places is None else [name for name in self._places.names if name not in self._propositions]
        if self._places is not None and unused:
            self._notice(
                f"{self._places.source}: not used are the places of {', '.join(unused)}: the propositions are "
                f"{', '.join(self._propositions)}"
            )

    def _notice(self, text: str) -> None:
        """Say something doubtful, once."""
        if text not in self._noticed:
            self._noticed.append(text)
            self._say(text)

    def _known_regions(self) -> list[tuple[str, Region]]:
        named = () if self._places is None else self._places.propositions
        return [(name, region) for name, regions in named if name in self._propositions for region in regions]

    def _metres(self, cell: Cell) -> tuple[float, float]:
        return self._lattice.frame.cell_to_metres(*self._in_window_now(cell))

    def _in_window(self, cell: Cell) -> Cell:
        return cell[0] - self._reported[0], cell[1] - self._reported[1]

    def _in_window_now(self, cell: Cell) -> Cell:
        row, column = self._lattice.origin
        return cell[0] - row, cell[1] - column


def _distance(one: Cell, other: Cell) -> int:
    return max(abs(one[0] - other[0]), abs(one[1] - other[1]))


_is_due = jax.jit(Stop.is_due)
