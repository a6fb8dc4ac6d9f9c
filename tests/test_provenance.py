"""What stands below tables of results: command, commit and versions, as the file behind the table holds them."""

import json
import re

import pytest

from eval.provenance import RESULTS, lines_of, made_by_of, made_line
from potlp_jax.sweep.rows import provenance

# The summary quotes the other pages, and what was dropped is a list.
PAGES = sorted(page for page in RESULTS.glob("*.md") if page.name not in ("index.md", "dropped.md"))
TABLE = re.compile(r"(?:^\|.*\n)+", re.M)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_below_every_table_stands_how_it_was_made(page):
    text = page.read_text("utf-8")
    tables = list(TABLE.finditer(text))
    assert tables
    for table in tables:
        assert text.startswith("\n<!-- made: ", table.end()), f"{page.name}: {table[0].splitlines()[0]}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_it_is_what_the_data_say(page):
    text = page.read_text("utf-8")
    assert lines_of(text) == text, "python -m eval.provenance writes it"


def test_a_line_that_the_data_contradict_is_renewed(tmp_path):
    (tmp_path / "a.json").write_text(json.dumps({"provenance": provenance(), "rows": []}))
    mark = "| a |\n|---|\n\n<!-- made: a.json -->\n"
    renewed = lines_of(mark, tmp_path)
    assert f"`{provenance()['commit'].rstrip('+')[:7]}`" in renewed
    assert provenance()["versions"]["jax"] in renewed
    assert lines_of(renewed, tmp_path) == renewed
    assert lines_of(mark + "*Made by another.*\n", tmp_path) == renewed


def test_files_of_one_table_are_all_named(tmp_path):
    for name, commit, version in (("a", "1" * 40, "0.1.0"), ("b", "2" * 40 + "+", "0.2.0")):
        versions = {"jax": "0.10.1", "potlp-jax": version}
        made_by = {"command": f"python -m {name}", "commit": commit, "versions": versions}
        (tmp_path / f"{name}.json").write_text(json.dumps({"provenance": made_by}))
    (line,) = [line for line in lines_of("<!-- made: a.json, b.json -->\n", tmp_path).splitlines() if "Made" in line]
    assert line == (
        "*Made by command: not recorded; commit: `1111111`, `2222222` with changes; "
        "versions: jax 0.10.1, potlp-jax 0.1.0 and 0.2.0.*"
    )


def test_commits_of_rows_count_wherever_they_stand():
    found = made_by_of({"groups": {"a": {"commits": ["22"]}, "b": [{"commits": ["11", "22"]}]}, "provenance": {}})
    assert found["commits"] == ["11", "22"]


def test_what_was_never_recorded_is_said_to_be_so():
    assert made_line(made_by_of({"rows": []})) == "*Made before results kept their command, commit and versions.*"
    assert "commit: not recorded" in made_line({"command": "python -m a", "versions": {}})
