"""Small whole files of every kind that is read, by the library's own writers, to be damaged."""

import json
import shutil
from collections.abc import Callable
from dataclasses import asdict
from functools import cache
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from potlp_jax.environments.ros.grid_frame import GridFrame
from potlp_jax.environments.ros.places import Disc, Places, Polygon, save_places
from potlp_jax.world.grid import BeliefMap, belief_from_numpy, make_world

Tree = dict[str, bytes]
"""Contents of files by their path within a folder."""

RESOLUTION = 0.1
"""Metres a pixel of all maps here."""

_RING_FREE = 254
_SECOND = 1_000_000_000


def read_tree(folder: Path) -> Tree:
    """All files of a folder."""
    return {str(file.relative_to(folder)): file.read_bytes() for file in sorted(folder.rglob("*")) if file.is_file()}


def write_tree(tree: Tree, folder: Path) -> None:
    """Write files into a folder."""
    for name, contents in tree.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(contents)


def kept(scratch: Path, name: str, make: Callable[[Path], None]) -> Tree:
    """Files that are expensive to make, made once a run beside its scratch folder.

    Args:
        scratch: the folder of a case.
        name: of what is made.
        make: writes it into a folder.

    Returns:
        The files.
    """
    folder = scratch.parent / "seeds" / name
    if not folder.exists():
        part = folder.with_suffix(".part")
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        make(part)
        part.rename(folder)
    return read_tree(folder)


@cache
def picture() -> np.ndarray:
    """A map of 40 x 60 pixels: two rooms, a door between them, unknown space outside."""
    pixels = np.full((40, 60), 205, np.uint8)
    pixels[5:35, 5:55] = 0
    pixels[7:33, 7:53] = _RING_FREE
    pixels[7:33, 29:31] = 0
    pixels[17:23, 29:31] = _RING_FREE
    return pixels


def frame() -> GridFrame:
    """Where that map lies."""
    height, width = picture().shape
    return GridFrame(height, width, RESOLUTION, -1.0, -2.0)


def map_yaml(image: str) -> str:
    """The settings of that map."""
    return (
        f"image: {image}\nresolution: {RESOLUTION}\norigin: [-1.0, -2.0, 0.0]\nnegate: 0\nmode: trinary\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )


def encoded(kind: str) -> bytes:
    """The map as an image: ``pgm`` (binary), ``ascii``, ``png``, ``bmp`` or ``jpg``."""
    pixels = picture()
    head = f"{pixels.shape[1]} {pixels.shape[0]}\n# made by hand\n255\n"
    if kind == "pgm":
        return b"P5\n" + head.encode() + pixels.tobytes()
    if kind == "ascii":
        return b"P2\n" + head.encode() + "\n".join(" ".join(map(str, row)) for row in pixels).encode()
    return cv2.imencode(f".{kind}", pixels)[1].tobytes()


def places() -> Places:
    """Two places in those rooms."""
    return Places(
        (
            ("document", (Disc((0.5, -0.5), 0.3),)),
            ("package", (Polygon(((2.5, -1.0), (3.5, -1.0), (3.5, 0.0), (2.5, 0.0))),)),
        ),
        start=(0.5, 0.5),
        tasks=(("1", "F document & F package"), ("2", "!package U document")),
    )


def places_yaml(folder: Path) -> str:
    """Those places as a file."""
    save_places(places(), folder / "made.yaml")
    return (folder / "made.yaml").read_text("utf-8")


ROOMS_YAML = """rooms:
  "1.01": [{polygon: [[-0.3, -1.3], [1.9, -1.3], [1.9, -0.4], [-0.3, -0.4]]}]
  "1.02": [{polygon: [[2.1, -1.3], [4.3, -1.3], [4.3, 1.3], [2.1, 1.3]]}]
"""

KINDS_YAML = "hallway: [CORRIDOR, HALL]\noffice: [OFFICE]\nother: [KITCHEN, wc]\n"


def floor_plan_xml() -> str:
    """Three rooms in a row, with doors between them."""
    spaces = []
    for number, label in enumerate(("OFFICE", "CORRIDOR", "KITCHEN")):
        left, right = 100 * number, 100 * number + 100
        points = ((left, 0), (right, 0), (right, 100), (left, 100))
        outline = "".join(f'<point x="{x}" y="{y}"/>' for x, y in points)
        lines, portals = [], []
        for door in (number - 1, number):
            if 0 <= door < 2:
                x = 100 * door + 100
                lines.append(
                    f'<linesegment id="d{door}"><class>PORTAL</class><type>EXPLICIT</type><features>NORMAL</features>'
                    f'<point x="{x}" y="50"/><point x="{x}" y="50"/></linesegment>'
                )
                target = f"<target><id>r{door}</id><id>r{door + 1}</id></target>"
                portals.append(f"<portal><linesegment>d{door}</linesegment>{target}</portal>")
        spaces.append(
            f'<space id="r{number}"><labels><label>{label}</label></labels><bounding_polygon>{outline}'
            f"</bounding_polygon><space_representation>{''.join(lines)}</space_representation>"
            f"<portals>{''.join(portals)}</portals></space>\n"
        )
    scale = (
        "<scale><represented_distance><value>100</value></represented_distance>"
        "<real_distance><value>5</value><um>m</um></real_distance></scale>\n"
    )
    return f"<building>{scale}<floor><spaces>\n{''.join(spaces)}</spaces></floor></building>\n"


def make_bag(folder: Path, name: str) -> None:
    """A log of a robot that crosses the map, as ``ros1``, ``ros2`` or ``mcap``."""
    # Here, because rosbags comes with an extra that other kinds of files do not need.
    from potlp_jax.logs.transforms import quaternion_of
    from potlp_jax.logs.writing import BagFormat, Recorder

    still = quaternion_of(0.0)
    image = np.random.default_rng(0).integers(0, 255, (8, 16, 3)).astype(np.uint8)
    cells = np.where(picture() == 205, -1, np.where(picture() == 0, 1, 0))
    with Recorder(folder / ("drive.bag" if name == "ros1" else "drive"), BagFormat(name)) as recorder:
        recorder.transforms("/tf_static", _SECOND, [("base_link", "panorama", (0.0, 0.0, 1.0), still)])
        for step in range(12):
            time, x = (step + 1) * _SECOND, 0.3 * step
            seen = np.where(np.arange(cells.shape[1]) < 10 + 5 * step, cells, -1)
            if step % 4 == 0 or step == 11:
                belief = belief_from_numpy(_belief_codes(seen), np.zeros(cells.shape, np.int32), RESOLUTION)
                recorder.map(time, frame(), belief)
            recorder.transforms("/tf", time, [("map", "odom", (0.0, 0.0, 0.0), still)])
            recorder.transforms("/tf", time + 1, [("odom", "base_link", (x, 0.0, 0.0), still)])
            recorder.odometry(time, (x, 0.0, 0.0), still)
            recorder.picture(time, image)


def _belief_codes(cells: np.ndarray) -> np.ndarray:
    from potlp_jax.world.grid import BeliefMap

    return np.select([cells < 0, cells > 0], [BeliefMap.UNKNOWN, BeliefMap.OCCUPIED], BeliefMap.FREE)


def make_record(folder: Path) -> None:
    """The record of a trial."""
    from potlp_jax.environments.registry import make
    from potlp_jax.environments.splits import Split, world_key
    from potlp_jax.planning.policies import Policy
    from potlp_jax.trials.config import trial_config_for
    from potlp_jax.trials.run import run_trial

    generator = make("toy")
    world = generator.generate(world_key(Split.VALIDATION, 0, generator.name))
    trial = run_trial(world, generator.task("2"), Policy.ORACLE, jax.random.key(0), trial_config_for(generator))
    trial.save(folder / "trial.json")


def make_estimator(folder: Path) -> None:
    """An estimator that was never trained, of a small network."""
    from potlp_jax.learning.domain import Domain
    from potlp_jax.learning.network import EstimatorNetwork, NetworkConfig
    from potlp_jax.learning.serialization import save_estimator
    from potlp_jax.world.camera import CameraConfig

    config = NetworkConfig(("fire", "extinguisher"), (64, 64), (1,) * 4, (1,) * 8, (1,) * 4)
    # Zeros of the right shapes: initialising compiles for seconds.
    like = jax.eval_shape(EstimatorNetwork(config).init, jax.random.key(0))
    params = jax.tree.map(lambda leaf: jnp.full(leaf.shape, 0.5, leaf.dtype), like)
    domain = Domain.of_cells("firefighting", CameraConfig(), 1.0)
    save_estimator(folder / "estimator.npz", params, config, domain, {"made": "for damage"})


CHECKPOINT_IDENTITY = {"training": {"seed": 1}}


def checkpoint_state() -> dict[str, jax.Array]:
    """What the checkpoint holds."""
    return {"w": jnp.arange(12.0).reshape(3, 4), "step": jnp.int32(3)}


def make_checkpoint(folder: Path) -> None:
    """A training's checkpoint."""
    from potlp_jax.learning.checkpoints import save_checkpoint

    save_checkpoint(folder, 3, checkpoint_state(), CHECKPOINT_IDENTITY, {"seconds": 1.5})


def make_dataset(folder: Path) -> None:
    """A dataset of two shards."""
    from potlp_jax.learning.dataset import encode, view_id, write_shard
    from potlp_jax.learning.dataset_metadata import DatasetMetadata
    from potlp_jax.learning.map_images import encode_view, encode_world
    from potlp_jax.learning.painting import blank_painting

    random = np.random.default_rng(0)
    metadata = DatasetMetadata(
        ("fire", "extinguisher"), "toy", "toy", {}, "training", {}, {}, {}, {"low": 1.0, "high": 2.0}, {}, {}, (5, 6)
    )
    walls = np.pad(np.zeros((3, 4), bool), 1, constant_values=True)
    world = make_world(walls, np.zeros(walls.shape, np.int32), (1, 1), propositions=metadata.propositions)
    view = asdict(encode_view(BeliefMap.unobserved(world), blank_painting(*world.shape)))
    worlds = {"world": [0], **{name: [value] for name, value in asdict(encode_world(world)).items()}}
    for shard in range(2):
        images = [encode(random.integers(0, 255, (16, 32, 3)).astype(np.uint8)) for _ in range(3)]
        views = {
            "view": [view_id(shard, index) for index in range(3)],
            **{name: [0] * 3 for name in ("world", "step", "row", "column")},
            "format": ["jpeg"] * 3,
            "image": images,
            **{name: [image] * 3 for name, image in view.items()},
        }
        numbers = ("bearing", "distance", "success_probability", "success_cost", "failure_cost")
        samples = {
            "view": [view_id(shard, index % 3) for index in range(8)],
            "task": ["F fire"] * 8,
            **{name: [0] * 8 for name in ("outcome_class", "row", "column")},
            "in_view": [True, False] * 4,
            **{name: random.uniform(0.1, 1.0, 8).astype(np.float32) for name in numbers},
            "phi_stay": [[0, 1]] * 8,
            "phi_go": [[1, -1]] * 8,
            **{name: np.ones(8, np.float32) for name in ("success_weight", "failure_weight")},
        }
        write_shard(folder, shard, worlds, views, samples, metadata)


def make_export(folder: Path) -> None:
    """The search, exported."""
    from potlp_jax.export import ExportConfig, export_planner
    from potlp_jax.task.task import Task

    export_planner(Task.from_formula("!fire U extinguisher & F fire", ("fire", "extinguisher")), folder, ExportConfig())


def make_store(folder: Path) -> None:
    """The store of a finished sweep."""
    from potlp_jax.sweep.runner import RESULTS
    from potlp_jax.sweep.store import Item, Row, Store

    store = Store(folder / RESULTS)
    store.agree({"specification": {"worlds": 40}})
    for policy in ("known-map", "baseline"):
        items = [Item("toy", "F goal", policy, world) for world in range(40)]
        rest = (100.0, 30, 2, 0, 0, (0, 7), "2,3:70", "abc", {"jax": "1"}, "", 0.5, "0123456789abcdef")
        store.finish([Row(item, "satisfied", item.world / 7, *rest) for item in items])
    store.set_possible("toy", "F goal", dict.fromkeys(range(40), True))
    store.close()


def make_plan(folder: Path) -> None:
    """The plan and the table of a training."""
    asked = {"epochs": 2, "minutes": None, "seed": 0}
    (folder / "plan.json").write_text(json.dumps({"asked": asked, "steps": 20}))
    (folder / "log.csv").write_text("step,epoch,loss\n10,1.0,0.5\n20,2.0,0.25\n")


SWEEP_YAML = """environments: [toy]
tasks: [1, "!hazard U goal"]
policies: [baseline, oracle]
worlds: 3
split: validation
first_world: 0
settings:
  replan_distance: 4
  decision: {search: {simulations: 30}}
seed: 1
"""

RECIPE_YAML = """environment: firefighting
training_worlds: 3
validation_worlds: 2
collect: {seed: 4}
fit:
  epochs: 2
  training: {seed: 1, learning_rate: 0.001}
"""
