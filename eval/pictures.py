"""The pictures of the README and the documentation, from this commit's code: ``python -m eval.pictures``.

What each picture shows is in ``PICTURES``; beside them ``pictures.json`` keeps what they were made from: the command,
the content's hash, and the digest of the trials, which ``tests/test_pictures.py`` runs again. Pages are photographed by
Chromium; where there is none those pictures stay as they are, and the script says so. ``map.png`` needs a map that does
not ship and is made by the command in docs/maps.md.
"""

import argparse
import hashlib
import io
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from PIL import Image

import potlp_jax
from eval import contact_sheet, delivery_sheet
from potlp_jax.trials.record import Trial
from potlp_jax.trials.replay import views_of
from potlp_jax.view.maps import draw_side_by_side, draw_trial
from potlp_jax.view.replay_page import replay_page
from potlp_jax.view.style import save_figure

FOLDER = Path(__file__).parents[1] / "docs" / "images"
FACTS = "pictures.json"

ENVIRONMENT, TASK, WORLD = "firefighting", 2, 2
"""The trial of the pictures: PO-TLP soon turns to the alarm's hallway, the baseline to the nearest frontier."""

POLICIES = {"baseline": "nearest frontier (baseline)", "potlp": "PO-TLP"}
"""Policies that are drawn, with their titles."""

MAX_BYTES: int = 220_000
"""Of a picture. Larger ones are stored with fewer colours (PNG) or at lower quality (JPEG), as little as needed."""

MAX_WIDTH: int = 1200
"""Pixels of a photograph (JPEG): what a page shows. Above it lower quality costs more than lower resolution."""

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--virtual-time-budget=8000")
"""Time for images and scripts to settle, in milliseconds of the page's own clock."""


def picture_trial(policy: str) -> Trial:
    """The trial that the pictures show, run now."""
    return potlp_jax.run(ENVIRONMENT, TASK, policy, world=WORLD)


def trial_digest(trial: Trial) -> str:
    """A hash of what a picture shows of a trial: where it went, in which states, how it ended."""
    shown = [str(trial.outcome), list(map(list, trial.path)), list(trial.states)]
    return hashlib.sha256(json.dumps(shown).encode()).hexdigest()


def draw_trial_picture(file: Path) -> list[Trial]:
    """PO-TLP's trial with its legend."""
    trial = picture_trial("potlp")
    save_figure(draw_trial(trial), file)
    return [trial]


def draw_comparison(file: Path) -> list[Trial]:
    """The baseline and PO-TLP in one world."""
    trials = [picture_trial(policy) for policy in POLICIES]
    save_figure(draw_side_by_side(trials, list(POLICIES.values())), file)
    return trials


def photograph_replay(file: Path) -> list[Trial]:
    """The replay of PO-TLP's trial, at a decision with several actions to weigh, the task not yet in reach."""
    trial = picture_trial("potlp")
    exploring = [decision for decision in trial.decisions if decision.kind == "action"]
    decision = max(exploring[len(exploring) // 3 :], key=lambda decision: len(decision.actions))
    page = replay_page(trial, views_of(trial))
    # The page's slider moves as if a person had drawn it there.
    move = (
        'const slider = document.querySelector("input");'
        f'slider.value = {decision.step}; slider.dispatchEvent(new Event("input", {{bubbles: true}}));'
    )
    photograph(page.replace("</body>", f"<script>{move}</script></body>"), file, (1150, 900))
    return [trial]


def photograph_report(file: Path) -> list[Trial]:
    """The report of a sweep over a few worlds, from its top."""
    with tempfile.TemporaryDirectory() as folder:
        specification = Path(folder) / "sweep.yaml"
        specification.write_text(
            f"environments: [{ENVIRONMENT}]\ntasks: [{TASK}]\nworlds: 8\nsplit: validation\n"
            "policies: [known-map, baseline, potlp]\n"
        )
        command("sweep", str(specification), "--out", f"{folder}/sweep")
        command("report", f"{folder}/sweep", "--replays", "1")
        photograph((Path(folder) / "sweep" / "report.html").read_text(), file, (1280, 1000))
    return []


def command(*arguments: str) -> None:
    """Run ``potlp`` in a process of its own, as a person would; what it prints goes on."""
    subprocess.run([sys.executable, "-c", "from potlp_jax.cli import main; main()", *arguments], check=True)


def photograph(page: str, file: Path, size: tuple[int, int]) -> None:
    """The page as a browser of this size in pixels shows it. Raises FileNotFoundError where there is no browser."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        raise FileNotFoundError(f"no browser: {', '.join(BROWSERS)}")
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "page.html"
        source.write_text(page, "utf-8")
        window = f"--window-size={size[0]},{size[1]}"
        profile, target = f"--user-data-dir={folder}/profile", f"--screenshot={file}"
        subprocess.run([browser, *FLAGS, window, profile, target, source.as_uri()], check=True, capture_output=True)


def draw_panoramas(file: Path) -> list[Trial]:
    """Panoramas of training worlds beside their maps."""
    contact_sheet.draw_sheet(contact_sheet.choose_scenes(20), file)
    return []


def draw_delivery(file: Path) -> list[Trial]:
    """Generated floors from above, and what a robot sees of them."""
    shown = list(delivery_sheet.generated(["delivery"], 12))
    delivery_sheet.draw_sheet(shown, list(delivery_sheet.choose_views(shown[0])), file)
    return []


def draw_campus(file: Path) -> list[Trial]:
    """Generated campus buildings of all sizes from above."""
    families = ["campus-small", "campus-medium", "campus-large"]
    delivery_sheet.draw_sheet(list(delivery_sheet.generated(families, 12)), [], file)
    return []


PICTURES: dict[str, Callable[[Path], list[Trial]]] = {
    "trial.png": draw_trial_picture,
    "comparison.png": draw_comparison,
    "replay.png": photograph_replay,
    "report.png": photograph_report,
    "panoramas.jpg": draw_panoramas,
    "delivery.jpg": draw_delivery,
    "campus.jpg": draw_campus,
}
"""Files and what makes them; each returns the trials that it shows."""


def make_pictures(folder: Path, names: Iterable[str]) -> list[str]:
    """Make pictures and note what they were made from.

    Args:
        folder: where pictures and ``pictures.json`` are.
        names: of ``PICTURES``.

    Returns:
        Why a picture could not be made, one line each.
    """
    facts_file, missing = folder / FACTS, []
    facts = json.loads(facts_file.read_text()) if facts_file.exists() else {}
    for name in names:
        file = folder / name
        try:
            trials = PICTURES[name](file)
        except FileNotFoundError as error:
            missing.append(f"{name} stays as it is: {error}")
            continue
        shrink(file)
        facts[name] = picture_facts(file, {trial.policy: trial_digest(trial) for trial in trials})
        # After each picture, so that a run that is stopped leaves the facts of those it made.
        facts_file.write_text(json.dumps(dict(sorted(facts.items())), indent=1) + "\n")
    return missing


def picture_facts(file: Path, trials: dict[str, str]) -> dict[str, Any]:
    """What is kept of a picture: how to make it, its content's hash, and the digests of the trials that it shows."""
    content = hashlib.sha256(file.read_bytes()).hexdigest()
    return {"command": f"python -m eval.pictures {file.name}", "sha256": content, "trials": trials}


def shrink(file: Path) -> None:
    """Store a picture within ``MAX_BYTES``: as it is, or else with the most colours or the highest quality that fit."""
    image = Image.open(file).convert("RGB")
    if file.suffix == ".jpg" and image.width > MAX_WIDTH:
        image = image.resize((MAX_WIDTH, MAX_WIDTH * image.height // image.width), Image.Resampling.LANCZOS)
    for step in (256, 128, 64) if file.suffix == ".png" else (84, 74, 64, 54, 44):
        if file.stat().st_size <= MAX_BYTES:
            return
        buffer = io.BytesIO()
        if file.suffix == ".png":
            image.quantize(step, method=Image.Quantize.MEDIANCUT).save(buffer, "PNG", optimize=True)
        else:
            image.save(buffer, "JPEG", quality=step, optimize=True, progressive=True)
        file.write_bytes(buffer.getvalue())


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="PICTURE", help=f"default: all of {', '.join(PICTURES)}")
    parser.add_argument("--out", type=Path, default=FOLDER, help="folder of the pictures")
    arguments = parser.parse_args()
    unknown = set(arguments.names) - PICTURES.keys()
    if unknown:
        parser.error(f"no such picture: {', '.join(sorted(unknown))}")
    for line in make_pictures(arguments.out, arguments.names or PICTURES):
        print(line, file=sys.stderr)


if __name__ == "__main__":
    main()
