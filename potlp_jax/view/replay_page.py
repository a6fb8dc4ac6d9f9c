"""A trial as one page that a browser opens: the map as it was revealed, and what was weighed at each decision."""

import base64
import dataclasses
import html
import io
import json
import math
from importlib import resources
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from potlp_jax.task.task import Task
from potlp_jax.task.words import state_words, transition_words
from potlp_jax.trials.record import ActionRecord, Decision, Trial
from potlp_jax.trials.replay import Views
from potlp_jax.view.decisions import FIGURES, action_names, describe_move, figure_texts, rank_actions, task_of
from potlp_jax.view.labels import map_extent, place_labels
from potlp_jax.view.maps import NAMELESS
from potlp_jax.view.overlays import LEAST_CHANCE, describe_overlay, pack_overlay
from potlp_jax.view.style import IMAGINED_FREE, IMAGINED_WALL, area_colour, state_colour

MAP_PIXELS: tuple[int, int] = (1100, 640)
"""Width and height of the map on a page, at most: with its controls and table it fits most screens."""

PIXELS_PER_INCH: int = 96
"""Of a browser, by definition of CSS."""

# A page embeds a panorama for each observation; as PNG they would be three times as large.
_JPEG_QUALITY: int = 80


def replay_page(trial: Trial, views: Views) -> str:
    """A self-contained page. ``views`` may be empty."""
    title = f"{trial.environment or 'trial'}: {trial.task_text}"
    data = embed_json(replay_data(trial, views))
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{html.escape(title)}</title>
<style>{page_style()}</style>
</head>
<body>
<h1><code>{html.escape(trial.task_text)}</code></h1>
<main id="replay"></main>
<script type="application/json" id="data">{data}</script>
<script>{replay_script()}
mountReplay(document.getElementById("replay"), JSON.parse(document.getElementById("data").textContent));</script>
</body>
</html>
"""


def embed_json(data: Any) -> str:
    """JSON that may stand within a script element, whatever texts it holds."""
    # "</script" within a text would end the script; "<" as an escape cannot.
    return json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def page_style() -> str:
    """The style sheet of replays, for light and dark screens."""
    return packaged_text("replay.css")


def replay_script() -> str:
    """Defines ``mountReplay(element, data)``."""
    return packaged_text("replay.js")


def packaged_text(name: str) -> str:
    """A file that comes with this package."""
    return resources.files("potlp_jax.view").joinpath("data", name).read_text("utf-8")


def replay_data(trial: Trial, views: Views) -> dict[str, Any]:
    """What ``mountReplay`` shows, JSON-able."""
    task = task_of(trial)
    letters = np.asarray(trial.world.letters)
    # Labelled cells are few: a list is shorter than a raster.
    labelled = np.argwhere(letters > 0)
    rows, columns = map_extent(trial.world)
    # Whole pixels a cell, so that no thin wall vanishes; where a map is too large the browser scales it.
    pixels = int(np.clip(min(MAP_PIXELS[0] // columns, MAP_PIXELS[1] // rows), 2, 24))
    labels = place_labels(trial.world, trial.propositions, trial.path, inches_per_cell=pixels / PIXELS_PER_INCH)
    return {
        "facts": _facts(trial),
        "extent": [rows, columns],
        "cell_pixels": pixels,
        "labels": [dataclasses.asdict(label) for label in labels],
        "width": int(letters.shape[1]),
        "occupied": _base64(np.asarray(trial.world.occupied, np.uint8)),
        # Little-endian, as JavaScript's typed arrays are on every machine that runs a browser.
        "first_seen": _base64(np.asarray(trial.first_seen, "<i4")),
        "corrections": _corrections(trial),
        "letters": [[int(row), int(column), int(letters[row, column])] for row, column in labelled],
        "propositions": list(trial.propositions),
        "area_colours": [area_colour(bit) for bit in range(len(trial.propositions))],
        "state_names": [f"state {state}: {state_words(task, state)}" for state in range(task.dfa.num_states)],
        "state_colours": [state_colour(state) for state in range(task.dfa.num_states)],
        "path": [list(cell) for cell in trial.path],
        "states": list(trial.states),
        "figures": dict(FIGURES),
        "decisions": [_decision(trial, decision) for decision in trial.decisions],
        "panoramas": {number: _jpeg(image) for number, image in views.panoramas.items()},
        **_overlays(views, (rows, columns)),
    }


def _corrections(trial: Trial) -> list[list[int]]:
    """Index of a cell, the steps from and until which it was shown otherwise, and what it was taken for."""
    steps = [*(decision.step for decision in trial.decisions), len(trial.path)]
    width = trial.world.shape[1]
    return [
        [entry.cell[0] * width + entry.cell[1], steps[entry.first], steps[entry.until], entry.value, entry.letter]
        for entry in trial.corrections
    ]


def _overlays(views: Views, extent: tuple[int, int]) -> dict[str, Any]:
    # Which overlays there are is the same at every decision.
    first = next(iter(views.overlays.values()), ())
    return {
        "overlays": [describe_overlay(overlay, extent) for overlay in first],
        "overlays_at": {
            number: [pack_overlay(overlay, extent) for overlay in shown] for number, shown in views.overlays.items()
        },
        "least_chance": LEAST_CHANCE,
        "imagined_colours": [IMAGINED_WALL, IMAGINED_FREE],
    }


def _facts(trial: Trial) -> str:
    world = "" if trial.world_number is None else f", world {trial.world_number}"
    return (
        f"{trial.environment or NAMELESS}{world}; policy {trial.policy}: {trial.outcome} at cost "
        f"{trial.cost:.1f} after {len(trial.path) - 1} steps and {len(trial.decisions)} decisions"
    )


def _decision(trial: Trial, decision: Decision) -> dict[str, Any]:
    names = action_names(decision, task_of(trial))
    return {
        "index": decision.index,
        "step": decision.step,
        "state": decision.state,
        "cell": list(decision.cell),
        "text": f"Decision {decision.index}: {describe_move(trial, decision)}",
        # A policy that does not search has no expected cost, and JSON no infinity; the script then leaves it out.
        "value": decision.value if decision.actions and math.isfinite(decision.value) else None,
        "target": None if decision.target is None else list(decision.target),
        "subgoals": [list(cell) for cell in decision.subgoals],
        "observations": list(decision.observations),
        "path": [list(cell) for cell in decision.path],
        "actions": [
            {
                "name": names[action.index],
                "meaning": _meaning(task_of(trial), action),
                "subgoal": action.subgoal,
                "chosen": action.index == decision.choice,
                # As texts: rounded once, here, as the table of ``potlp explain`` has them.
                "figures": figure_texts(action, digits=3),
            }
            for action in rank_actions(decision)
        ],
    }


def _meaning(task: Task, action: ActionRecord) -> str:
    """What is tried, whole: the transition by its states and with what must be avoided."""
    if action.from_state is None or action.to_state is None:
        return "the rest of the task, in known space"
    words = transition_words(task, action.from_state, action.to_state)
    return f"{words} (state {action.from_state} to state {action.to_state})"


def _base64(array: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()


def _jpeg(image: UInt8[np.ndarray, "rows columns 3"]) -> str:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "JPEG", quality=_JPEG_QUALITY)
    return f"data:image/jpeg;base64,{base64.b64encode(buffer.getvalue()).decode()}"
