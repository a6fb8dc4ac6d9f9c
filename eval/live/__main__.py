"""Drive a simulated robot through perturbed streams of messages, and count how that ends.

    python -m eval.live --streams 1000 --out out/live.json
    python -m eval.live --streams 20 --first 300 --verbose       # some of them, one line each

Each stream has its own network (delay, loss, duplicates, another order, jumps of the pose, damaged messages, a clock
that begins anew) and its own robot (advised or commanded, maps that turn or come in parts, navigations that fail,
silences). No sockets: messages are handed over as rosbridge's JSON, in the simulation's time. What is checked:

- nothing raises;
- whatever the order in which messages arrived, the newest of each kind is what is known (compared with a search through
  all that was delivered, where stamps tell the order);
- the same map, cell and automaton state never lead to two decisions, in whichever stream they come up.

Exit code 1 where one of these fails.
"""

import argparse
import json
import time
import traceback
from collections import Counter
from pathlib import Path
from typing import Any

import jax
import numpy as np

from eval.live.perturbation import Network, Perturbation
from eval.live.simulator import FLOOR, Behaviour, SimulatedLink, SteppedInbox
from potlp_jax.cache import enable_compilation_cache
from potlp_jax.drive.config import DriveConfig, Mode
from potlp_jax.drive.driving import drive_robot
from potlp_jax.drive.messages import scan_of, stamp_of, transforms_of
from potlp_jax.errors import RobotError
from potlp_jax.sweep.rows import provenance
from potlp_jax.task.task import Task
from potlp_jax.trials.record import Decision
from potlp_jax.world.grid import BeliefMap

LONGEST = 900.0
"""Seconds of the simulation after which a drive hangs."""

FORMULA = "!fire U exit"

Known = dict[tuple[Any, ...], tuple[Any, ...]]
"""What was decided in a situation."""


class HungError(Exception):
    """A drive that does not end."""


class _Inbox(SteppedInbox):
    def wait(self, seconds: float) -> None:
        if self._link.time > LONGEST:
            raise HungError(f"not ended after {LONGEST:g} s")
        super().wait(seconds)


COMMAND = "python -m eval.live"


def behaviour_of(random: np.random.Generator) -> Behaviour:
    """A robot: most are ordinary."""
    begins = float(random.uniform(2, 8)) if random.random() < 0.2 else np.inf
    return Behaviour(
        turns=float(random.uniform(0, 0.03)) if random.random() < 0.3 else 0.0,
        updates=random.random() < 0.3,
        failures=int(random.integers(1, 5)) if random.random() < 0.3 else 0,
        silent=(begins, begins + float(random.uniform(1, 6))),
    )


def newest_by_stamp(link: SimulatedLink) -> tuple[Any, Any]:
    """Occupancy and position by the newest stamps among all messages that were delivered: the slow reference."""
    maps, poses = [], []
    for number, (topic, message) in enumerate(link.delivered):
        try:
            # Of two with one stamp the first that arrived counts.
            if topic == "/map":
                maps.append((stamp_of(message), -number, scan_of(message).occupancy))
            elif topic == "/tf":
                poses += [(stamp, -number, matrix[:2, 3]) for _, _, stamp, matrix in transforms_of(message)]
        except RobotError:
            continue
    return max(maps, key=lambda entry: entry[:2])[2], max(poses, key=lambda entry: entry[:2])[2]


def run_stream(seed: int, known: Known) -> dict[str, Any]:
    """One stream: how it ended, and what was wrong with it."""
    random = np.random.default_rng(seed)
    network, behaviour = Perturbation.drawn(random), behaviour_of(random)
    mode = (Mode.ADVISE, Mode.NAVIGATE, Mode.FOLLOW)[seed % 3]
    config = DriveConfig(mode=mode, resolution=FLOOR.resolution, radius=0.05, patience=60.0)
    task = Task.from_formula(FORMULA, FLOOR.propositions)
    link = SimulatedLink(FLOOR, behaviour, Network(network, random))
    inbox = _Inbox(link, config, task.propositions)
    wrong: list[str] = []

    def check(decision: Decision, belief: BeliefMap) -> None:
        situation = (np.asarray(belief.cells).tobytes(), np.asarray(belief.letters).tobytes(), belief.cells.shape)
        decided = (decision.kind, decision.target, decision.path)
        if known.setdefault((*situation, decision.cell, decision.state), decided) != decided:
            wrong.append(f"decision {decision.index} differs from that of another stream in the same situation")
        # Where a clock begins anew, or maps come in parts, stamps alone do not tell what is newest.
        if network.restart is None and not behaviour.updates:
            occupancy, position = newest_by_stamp(link)
            heard = inbox.heard
            if heard.scan is None or not np.array_equal(heard.scan.occupancy, occupancy):
                wrong.append(f"decision {decision.index}: the map is not the newest that was delivered")
            if heard.pose is None or not np.allclose(heard.pose[:2], position):
                wrong.append(f"decision {decision.index}: the pose is not the newest that was delivered")

    row: dict[str, Any] = {"seed": seed, "mode": str(mode), "perturbation": vars(network)}
    try:
        drive = drive_robot(
            link, task, "baseline", jax.random.key(0), config, listener=check, inbox=inbox, clock=link.clock
        )
        trial = next(drive)
        drive.close()
        row |= {"end": str(trial.outcome), "decisions": len(trial.decisions), "cost": trial.cost}
        row["failed_legs"] = sum(bool(decision.failure) for decision in trial.decisions)
        if "fire" in {FLOOR.propositions[0] for letter in trial.word if letter & 1} and trial.outcome == "satisfied":
            wrong.append("the robot went through the fire and was satisfied")
    except HungError as error:
        row |= {"end": "hung", "why": str(error)}
    # Whatever it is, it is what is counted here.
    except Exception as error:
        row |= {"end": "crash", "why": f"{type(error).__name__}: {error}", "where": traceback.format_exc()}
    row["wrong"] = wrong
    return row


def summary_of(rows: list[dict[str, Any]], situations: int, seconds: float) -> dict[str, Any]:
    """Counts of all streams."""
    return {
        "streams": len(rows),
        "ends": dict(Counter(row["end"] for row in rows)),
        "crashes": sum(row["end"] == "crash" for row in rows),
        "hung": sum(row["end"] == "hung" for row in rows),
        "disagreements": sum(len(row["wrong"]) for row in rows),
        "decisions": sum(row.get("decisions", 0) for row in rows),
        "situations": situations,
        "failed_legs": sum(row.get("failed_legs", 0) for row in rows),
        "by_mode": {mode: dict(Counter(row["end"] for row in rows if row["mode"] == mode)) for mode in Mode},
        "seconds": round(seconds, 1),
        "bad": [row for row in rows if row["end"] in ("crash", "hung") or row["wrong"]][:20],
    }


def main() -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(
        prog="python -m eval.live", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--streams", type=int, default=1000, help="how many")
    parser.add_argument("--first", type=int, default=0, help="number of the first one")
    parser.add_argument("--out", type=Path, help="JSON file for the counts")
    parser.add_argument("--verbose", action="store_true", help="a line for each stream")
    arguments = parser.parse_args()
    enable_compilation_cache()
    known: Known = {}
    rows, begun = [], time.monotonic()
    for seed in range(arguments.first, arguments.first + arguments.streams):
        rows.append(run_stream(seed, known))
        if arguments.verbose or rows[-1]["end"] in ("crash", "hung") or rows[-1]["wrong"]:
            print(json.dumps(rows[-1], default=str), flush=True)
        elif len(rows) % 50 == 0:
            print(f"{len(rows)} streams: {dict(Counter(row['end'] for row in rows))}", flush=True)
    found = summary_of(rows, len(known), time.monotonic() - begun)
    print(json.dumps({name: value for name, value in found.items() if name != "bad"}, indent=1))
    if arguments.out is not None:
        command = f"{COMMAND} --streams {arguments.streams}"
        data = {"provenance": provenance() | {"command": command}, **found}
        arguments.out.write_text(json.dumps(data, indent=1, default=str) + "\n", "utf-8")
    return int(bool(found["crashes"] or found["hung"] or found["disagreements"]))


if __name__ == "__main__":
    raise SystemExit(main())
