"""``potlp log``: robots' logs inspected, turned into datasets, replayed, and written by the simulator.

Imports of this module need the extra ``logs``.
"""

import importlib.util
import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import typer
from rich.box import SIMPLE_HEAD
from rich.table import Table

from potlp_jax.cli.inputs import read_policy, read_task, read_trained_estimator, trial_config
from potlp_jax.cli.output import BAD_INPUT, FAILED, console, fail, note, output_folder, print_json, progress_bar
from potlp_jax.cli.run import RECORD
from potlp_jax.cli.view import PAGE
from potlp_jax.environments.ros.places import load_places
from potlp_jax.learning.estimator import TrainedEstimator, shipped_estimator
from potlp_jax.logs.drive import Drive, read_drive
from potlp_jax.logs.inspection import inspect
from potlp_jax.logs.log import Log, LogConfig
from potlp_jax.logs.replaying import replay
from potlp_jax.logs.working_grid import GridConfig
from potlp_jax.logs.writing import BagFormat, write_trial
from potlp_jax.planning.policies import Policy
from potlp_jax.trials.record import load_trial
from potlp_jax.view.maps import draw_trial
from potlp_jax.view.replay_page import replay_page
from potlp_jax.view.style import save_figure


@dataclass(frozen=True)
class Reading:
    """How a log is read, in the words of the command line."""

    map_topic: str | None
    image_topic: str | None
    base_frame: str | None
    free: int
    occupied: int
    resolution: float | None
    radius: float
    camera_yaw: float | None
    vertical_field: float | None

    def log(self, bag: Path) -> Log:
        """The log of a bag."""
        return Log(
            bag,
            LogConfig(
                map_topic=self.map_topic,
                image_topic=self.image_topic,
                base_frame=self.base_frame,
                free=self.free,
                occupied=self.occupied,
                camera_yaw=self.camera_yaw,
                vertical_field=self.vertical_field,
            ),
        )

    def drive(self, bag: Path, labels: Path) -> Drive:
        """The drive of a bag; what was lost is noted on stderr."""
        drive = read_drive(self.log(bag), load_places(labels), GridConfig(self.resolution, self.radius))
        for remark in drive.notes:
            note(f"{bag}: {remark}")
        return drive


def inspect_log(
    bag: Path,
    map_topic: str | None,
    image_topic: str | None,
    base_frame: str | None,
    free: int,
    occupied: int,
    vertical_field: float | None,
    json: bool,
) -> None:
    """Print what is in a log; leave with exit code 1 if it is damaged or of no use."""
    log = Log(
        bag,
        LogConfig(
            map_topic=map_topic,
            image_topic=image_topic,
            base_frame=base_frame,
            free=free,
            occupied=occupied,
            vertical_field=vertical_field,
        ),
    )
    found = inspect(log)
    if json:
        print_json(found)
    else:
        _print_inspection(found)
    if log.bag.damaged or not any(use.startswith("yes") for use in found["uses"].values()):
        raise typer.Exit(FAILED)


def _print_inspection(found: dict[str, Any]) -> None:
    out = console()
    out.print(f"{found['bag']}  {found['format']}", markup=False, style="bold")
    out.print(f"{found['seconds']:.1f} s, {found['messages']} messages", markup=False)
    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for name in ("topic", "type", "used for"):
        table.add_column(name)
    for name in ("messages", "a second", "gaps", "longest"):
        table.add_column(name, justify="right")
    for topic in found["topics"]:
        rate, gaps = topic["rate"], topic["gaps"]
        table.add_row(
            topic["name"],
            topic["type"].replace("/msg/", "/"),
            topic["use"],
            str(topic["count"]),
            "" if rate is None else f"{rate:.1f}",
            str(len(gaps)) if gaps else "",
            f"{max(gap['seconds'] for gap in gaps):.1f} s" if gaps else "",
        )
    out.print(table)
    for name, value in _facts(found):
        out.print(f"{name:10} {value}", markup=False)
    for name, answer in found["uses"].items():
        good = answer.startswith("yes")
        out.print(f"{name}: {answer}", markup=False, style="green" if good else "red")
    for problem in found["problems"]:
        out.print(f"problem: {problem}", markup=False, style="yellow")


def _facts(found: dict[str, Any]) -> list[tuple[str, str]]:
    facts = []
    if found["map"] is not None:
        last = found["map"]
        (height, width), (x, y, yaw) = last["cells"], last["origin"]
        facts.append(
            (
                "last map",
                f"{height} x {width} cells of {last['resolution']:g} m, origin [{x:.2f}, {y:.2f}, {yaw:.2f}], "
                f"{last['free']:.0%} free, {last['obstacles']:.0%} obstacles, {last['unknown']:.0%} unknown",
            )
        )
    pose = found["pose"]
    facts.append(
        ("pose", f"{pose['base_frame']} in {pose['map_frame']}; frames: {', '.join(pose['frames']) or 'none'}")
    )
    if found["pictures"] is not None:
        sizes = ", ".join(f"{width} x {height}" for width, height in found["pictures"]["sizes"])
        facts.append(("pictures", f"{sizes} pixels, frame {found['pictures']['frame']!r}"))
    return facts


def logs_to_dataset(
    bags: list[Path],
    labels: Path,
    out: Path,
    environment: str | None,
    split: str,
    views: int,
    seed: int,
    reading: Reading,
    json: bool,
) -> None:
    """Write the samples of some drives."""
    if importlib.util.find_spec("pyarrow") is None:
        fail("datasets are Parquet files, and pyarrow is not installed: pip install 'potlp-jax[train]'", FAILED)
    from potlp_jax.errors import DatasetError
    from potlp_jax.learning.dataset import read_dataset
    from potlp_jax.learning.questions import HELD_OUT
    from potlp_jax.logs.collecting import LogCollectConfig, collect_drives

    name = labels.name.split(".")[0] if environment is None else environment
    config = LogCollectConfig(views_per_world=views, seed=seed, held_out=HELD_OUT.get(name, ()))
    try:
        with progress_bar() as progress:
            progress.add_task("reading and labelling (the first view compiles)", total=None)
            drives = [reading.drive(bag, labels) for bag in bags]
            counts = collect_drives(drives, load_places(labels), out, name, split, config)
        samples = read_dataset(out)
    except DatasetError as error:
        fail(str(error))
    holds = samples.success > 0
    summary = {
        "dataset": str(out),
        "views": dict(zip(map(str, bags), counts, strict=True)),
        "samples": len(holds),
        "successes": int(holds.sum()),
        "propositions": list(samples.metadata.propositions),
    }
    if json:
        print_json(summary)
    else:
        out_console = console()
        for bag, count in summary["views"].items():
            out_console.print(f"{bag}: {count} views", markup=False)
        out_console.print(f"{len(holds)} samples, {int(holds.sum())} successes", markup=False)
        out_console.print(f"wrote {out}", markup=False)
    if not len(holds):
        note(
            "no sample: nowhere a subgoal was in view whose answer the final map gives; drive on until the building is "
            "mapped"
        )
        raise typer.Exit(FAILED)


def replay_log(
    bag: Path,
    labels: Path,
    task_text: str,
    out: Path,
    policy_name: str | None,
    simulations: int | None,
    estimator: Path | None,
    reading: Reading,
    open_it: bool,
    json: bool,
) -> None:
    """Write the decisions of a policy along a drive as a record, a picture and a page."""
    drive = reading.drive(bag, labels)
    task = read_task(drive.tasks.get(task_text, task_text), drive.propositions)
    trained = read_trained_estimator(estimator)
    policy = _default_policy(drive, trained) if policy_name is None else read_policy(policy_name)
    folder = output_folder(out)
    assert folder is not None
    with progress_bar() as progress:
        progress.add_task("deciding along the drive (the first decision compiles)", total=None)
        trial, panoramas = replay(drive, task, policy, jax.random.key(0), trial_config(simulations), trained)
    files = [folder / RECORD, folder / "trial.png", folder / PAGE]
    trial.save(files[0])
    save_figure(draw_trial(trial), files[1])
    files[2].write_text(replay_page(trial, panoramas), "utf-8")
    if json:
        print_json({**trial.summary(), "files": [str(file) for file in files]})
    else:
        console().print(
            f"{trial.outcome}: {len(trial.decisions)} decisions of {policy} along {trial.cost:.2f} m", markup=False
        )
        for file in files:
            console().print(f"wrote {file}", markup=False)
    if open_it and not webbrowser.open(files[2].resolve().as_uri()):
        note("there is no browser to open it with")


def _default_policy(drive: Drive, trained: TrainedEstimator | None) -> Policy:
    """PO-TLP where an estimator knows the propositions and there are pictures, else the baseline, with a note."""
    if trained is None and shipped_estimator(drive.propositions) is None:
        note(f"no estimator is shipped for {', '.join(drive.propositions)}: the policy is {Policy.BASELINE}")
        return Policy.BASELINE
    if not drive.pictures:
        note(f"the log has no panorama: the policy is {Policy.BASELINE}")
        return Policy.BASELINE
    return Policy.POTLP


def write_log(trial: Path, out: Path, kind_name: str | None, height: int) -> None:
    """Write a recorded trial as a bag, and its labels."""
    if kind_name is None:
        kind = BagFormat.ROS1 if out.suffix == ".bag" else BagFormat.ROS2
    elif kind_name in list(BagFormat):
        kind = BagFormat(kind_name)
    else:
        fail(f"unknown format {kind_name!r}; choose from: {', '.join(BagFormat)}", BAD_INPUT)
    if (kind is BagFormat.ROS1) != (out.suffix == ".bag"):
        fail(f"--out {out}: a ROS 1 bag is a file that ends in .bag, and a ROS 2 bag a folder that does not")
    labels = out.with_suffix(".labels.yaml")
    count = write_trial(load_trial(trial / RECORD if trial.is_dir() else trial), out, kind, labels, height)
    console().print(f"wrote {out}: {count} messages", markup=False)
    console().print(f"wrote {labels}", markup=False)
    console().print(f"next: potlp log inspect {out}", markup=False, style="dim")
