"""How a robot is reached and listened to."""

from dataclasses import dataclass
from enum import StrEnum

from potlp_jax.checks import FINITE, NOT_NEGATIVE, POSITIVE, require_fields
from potlp_jax.errors import RobotError


class Mode(StrEnum):
    """Who moves the robot."""

    ADVISE = "advise"
    """Somebody else: decisions are published, and nothing is commanded."""
    NAVIGATE = "navigate"
    """Nav2, to the end of each path: ``NavigateToPose``."""
    FOLLOW = "follow"
    """Nav2, along each path: ``FollowPath``."""
    DRY = "dry"
    """Nobody: one decision is taken, and nothing is published."""


@dataclass(frozen=True)
class Topics:
    """Names on the robot. An empty name: not subscribed.

    Attributes:
        map: ``nav_msgs/OccupancyGrid``.
        map_updates: ``map_msgs/OccupancyGridUpdate``, for maps and costmaps that send what has changed.
        pose: ``geometry_msgs/PoseStamped`` in the frame of the map; empty: the pose comes from ``tf``.
        tf, tf_static: ``tf2_msgs/TFMessage``.
        image: ``sensor_msgs/CompressedImage``, or ``Image`` where it does not end in ``compressed``; an equirectangular
            panorama.
        places: ``std_msgs/String``, JSON: where propositions hold by what the robot sees, all of them anew each time.
        task: ``std_msgs/String``: another formula over the same propositions.
        advice: prefix of what is published.
        action: of the navigation stack; empty: ``/navigate_to_pose`` or ``/follow_path``.
    """

    map: str = "/map"
    map_updates: str = "/map_updates"
    pose: str = ""
    tf: str = "/tf"
    tf_static: str = "/tf_static"
    image: str = ""
    places: str = "/potlp/places"
    task: str = "/potlp/task"
    advice: str = "/potlp"
    action: str = ""


@dataclass(frozen=True)
class DriveConfig:
    """Settings of a drive.

    Attributes:
        mode: who moves the robot.
        topics: names on the robot.
        base_frame: of the robot's body, in ``tf``.
        resolution: metres a cell of the planner.
        radius: metres by which obstacles grow; 0 for costmaps, which are inflated already.
        free, occupied: occupancy in percent: free is at most ``free``, an obstacle at least ``occupied``.
        camera_yaw: degrees, counter-clockwise, from the robot's heading to where the middle of a picture looks.
        silence: seconds without a pose after which the robot is stopped.
        patience: seconds for which a map, a pose, or the end of a silence is waited for.
        seconds_per_cell: time that a leg may take for each cell of its path, beside ``silence``; a leg that takes
            longer is cancelled and has failed. Nobody hurries a robot that is only advised.
    """

    mode: Mode = Mode.ADVISE
    topics: Topics = Topics()
    base_frame: str = "base_link"
    resolution: float = 0.2
    radius: float = 0.1
    free: int = 25
    occupied: int = 65
    camera_yaw: float = 0.0
    silence: float = 2.0
    patience: float = 30.0
    seconds_per_cell: float = 5.0

    def __post_init__(self) -> None:
        require_fields(self, ("resolution", "silence", "patience", "seconds_per_cell"), POSITIVE, RobotError)
        require_fields(self, ("radius",), NOT_NEGATIVE, RobotError)
        require_fields(self, ("camera_yaw",), FINITE, RobotError)
        if not 0 <= self.free < self.occupied <= 100:
            raise RobotError(
                f"thresholds are percent with 0 <= free < occupied <= 100, found {self.free} and {self.occupied}"
            )
