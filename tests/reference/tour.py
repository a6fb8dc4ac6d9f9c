"""A tour through two rooms, as the simulator knows it and as bags, and how such a bag is changed."""

import jax
import jax.numpy as jnp
import numpy as np
from rosbags.rosbag1 import Reader as Rosbag1Reader
from rosbags.rosbag1 import Writer as Rosbag1Writer

from potlp_jax.environments.ros.places import load_places
from potlp_jax.environments.toy import Toy, ToyConfig
from potlp_jax.logs import writing
from potlp_jax.logs.drive import read_drive
from potlp_jax.logs.log import SECOND, Log, LogConfig, typestore
from potlp_jax.logs.working_grid import GridConfig
from potlp_jax.logs.writing import BagFormat, labels_text, write_drive
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.record import NEVER_SEEN
from potlp_jax.trials.robot import photograph
from potlp_jax.world.camera import CameraConfig, Disturbance
from potlp_jax.world.grid import BeliefMap
from potlp_jax.world.sensing import SensorConfig, observe

TOY = Toy(ToyConfig(door_row=4, start=(4, 2), goal=(2, 12), hazard=(6, 9)))
WORLD = TOY.generate(jax.random.key(0))
NEAR = TrialConfig(sensor=SensorConfig(range_cells=3.0))
CAMERA = CameraConfig(height=16, width=64, horizon=6.0, fold=2.0)
FORMATS = list(BagFormat)

_look = jax.jit(observe, static_argnames="config")


def tour() -> list[tuple[int, int]]:
    """Cells from which, with a range of 3, everything but the outermost corners of the rooms is seen."""
    left = [(4, 2), (3, 3), (2, 4), (3, 5), (4, 5), (5, 5), (6, 4), (6, 3), (5, 4), (4, 5), (4, 6), (4, 7), (4, 8)]
    right = [(3, 9), (2, 10), (2, 11), (3, 12), (4, 12), (5, 12), (6, 11), (6, 10)]
    return left + right


def first_seen_along(world, path, sensor=NEAR.sensor):
    belief, seen = BeliefMap.unobserved(world), np.full(world.shape, NEVER_SEEN, np.int32)
    for step, cell in enumerate(path):
        belief = _look(belief, world, jnp.asarray(cell, jnp.int32), config=sensor)
        seen[~np.asarray(belief.unknown) & (seen == NEVER_SEEN)] = step
    return seen


def panorama_of(step):
    cell = jnp.asarray(tour()[step], jnp.int32)
    return np.asarray(photograph(WORLD, cell, jax.random.key(0), CAMERA, Disturbance()))


def write_tour(folder):
    """The tour as a bag of each format, and the labels."""
    seen = first_seen_along(WORLD, tour())
    for kind in FORMATS:
        write_drive(folder / name_of(kind), kind, WORLD, tour(), seen, panorama_of, CAMERA, height=180)
    (folder / "labels.yaml").write_text(labels_text(WORLD))
    return folder


def name_of(kind):
    return "tour.bag" if kind is BagFormat.ROS1 else f"tour-{kind}"


def places_of(bags):
    return load_places(bags / "labels.yaml")


def drive_of(path, places, config=None, grid=None):
    return read_drive(Log(path, config or LogConfig()), places, grid or GridConfig())


def rewrite(bags, out, edit, compress=False):
    """Copy the tour, message by message: ``edit(topic, message, time)`` changes it in place; False leaves it out."""
    store = typestore(True)
    with Rosbag1Reader(bags / "tour.bag") as reader, Rosbag1Writer(out) as writer:
        if compress:
            writer.chunk_threshold = 4000
        copies = {
            each.id: writer.add_connection(each.topic, each.msgtype, typestore=store) for each in reader.connections
        }
        for connection, time, data in reader.messages():
            message = store.deserialize_ros1(data, connection.msgtype)
            changed = edit(connection.topic, message, time)
            if changed is not False:
                raw = changed if isinstance(changed, bytes) else store.serialize_ros1(message, connection.msgtype)
                writer.write(copies[connection.id], time, raw)
    return out


def without(*topics):
    return lambda topic, message, time: topic not in topics


def step_of(time):
    return round((time - writing.START) / writing.SECONDS_A_CELL / SECOND, 6)
