"""The documentation's pictures are those of this commit: files as they were made, trials as they run now."""

import hashlib
import json
from pathlib import Path

import pytest

from eval.pictures import FACTS, FOLDER, MAX_BYTES, PICTURES, picture_trial, trial_digest

ROOT = Path(__file__).parents[1]

MADE_BY_HAND = {"map.png"}
"""Needs a map that does not ship (docs/maps.md)."""

REMEDY = "make it again: python -m eval.pictures"


@pytest.fixture(scope="module")
def facts() -> dict:
    return json.loads((FOLDER / FACTS).read_text())


def test_every_picture_is_made_by_the_script(facts):
    there = {file.name for file in FOLDER.iterdir() if file.suffix in (".png", ".jpg", ".gif")}
    assert there - MADE_BY_HAND == facts.keys() == PICTURES.keys()


@pytest.mark.parametrize("name", PICTURES)
def test_a_picture_is_as_it_was_made_and_not_too_large(name, facts):
    content = (FOLDER / name).read_bytes()
    assert hashlib.sha256(content).hexdigest() == facts[name]["sha256"], f"{name} was changed by hand; {REMEDY}"
    assert len(content) <= MAX_BYTES


@pytest.mark.long
@pytest.mark.parametrize(("policy", "words"), [("baseline", "the baseline's path costs"), ("potlp", "PO-TLP's")])
def test_trials_of_the_pictures_go_the_same_way_today(policy, words, facts):
    trial = picture_trial(policy)
    for page in (ROOT / "README.md", ROOT / "docs" / "index.md"):
        assert f"{words} {trial.cost:.0f}" in page.read_text(), page
    digest = trial_digest(trial)
    for name, fact in facts.items():
        assert fact["trials"].get(policy, digest) == digest, f"{name} shows another path than today's; {REMEDY} {name}"
