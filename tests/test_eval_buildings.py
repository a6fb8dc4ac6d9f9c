"""The table of buildings: any file that can be read is a world, and nothing that went wrong is left out."""

import json
import sys

import numpy as np
import pytest

from eval import buildings
from eval.buildings import FoundPlaces, markdown, report, sources
from eval.large_map import write_large_map
from potlp_jax.environments.ros.buildings import load_building
from potlp_jax.environments.ros.cleaning import clean_map
from potlp_jax.environments.splits import Split, world_key
from tests.test_buildings import TWO_ROOMS


@pytest.fixture
def data(tmp_path):
    folder = tmp_path / "buildings" / "rmf"
    folder.mkdir(parents=True)
    for index, padding in enumerate((0, 10, 2000, 30)):
        text = TWO_ROOMS.replace("DOOR", "hinged") + "#" * padding + "\n"
        (folder / f"{index}.building.yaml").write_text(text)
    return tmp_path


def test_two_places_lie_where_the_robot_can_go(data):
    generator = FoundPlaces(data / "buildings" / "rmf" / "0.building.yaml")
    worlds = [generator.generate(world_key(Split.TEST, number, generator.name)) for number in range(3)]
    for world in worlds:
        letters, occupied = np.asarray(world.letters), np.asarray(world.occupied)
        assert not letters[occupied].any()
        for bit in range(2):
            assert ((letters >> bit) & 1).any()
        assert world.family == "parcels"
        assert world.settings["decision"]["frontiers"]["min_size"] == 1
    assert len({tuple(world.start.tolist()) for world in worlds}) > 1
    near = FoundPlaces(data / "buildings" / "rmf" / "0.building.yaml", within=1.5).generate(
        world_key(Split.TEST, 0, generator.name)
    )
    # A place's middle is 1.5 m away at most, and half a metre around it belongs to it.
    apart = (np.argwhere(np.asarray(near.letters)) - np.asarray(near.start)) * float(near.resolution)
    assert np.hypot(*apart.T).max() <= 1.5 + np.hypot(0.5, 0.5)
    # Of two levels the first.
    two = data / "two.building.yaml"
    level = TWO_ROOMS.replace("DOOR", "hinged").partition("levels:")[2]
    # The second is twice as large.
    larger = level.replace("L1", "L2").replace("distance: [3, 10]", "distance: [3, 20]")
    two.write_text(f"levels:{level}{larger}")
    assert FoundPlaces(two).generate(world_key(Split.TEST, 0, "found:two.building")).shape == worlds[0].shape


def test_buildings_are_spread_over_their_sizes(data):
    generated = [("generated", name) for name in (*buildings.GENERATED, buildings.LARGE_MAP)]
    assert list(sources(None, None)) == generated
    files = [source for family, source in sources(data, None) if family == "Open-RMF"]
    assert files == [f"buildings/rmf/{index}.building.yaml" for index in (0, 1, 3, 2)]
    assert [source for family, source in sources(data, 2) if family == "Open-RMF"] == [files[0], files[-1]]


def test_the_large_map_is_rooms_of_ten_metres_that_doors_join(tmp_path):
    clean = clean_map(load_building(write_large_map(tmp_path, pixels=1000)))
    side = 50.0
    # All but the walls, 0.3 m in every 10, and perhaps a room or two that are shut.
    share = np.count_nonzero(clean.free) * clean.frame.resolution**2 / side**2
    assert 0.8 < share < 0.97**2
    # Rooms are apart: within the outer walls no line of cells is free from one side to the other.
    inner = clean.free[10:-10, 10:-10]
    assert not inner.all(axis=1).any()
    assert not inner.all(axis=0).any()


def _row(source, family, cells, flags=()):
    trial = {"outcome": "satisfied", "status": list(flags), "decisions": 3, "subgoals": 7, "seconds": 0.004}
    slow = {**trial, "seconds": 0.5}
    policies = {"baseline": [slow, trial], "potlp": [slow, {**trial, "outcome": "infeasible"}]}
    return {
        "source": source,
        "family": family,
        "cells": cells,
        "memory_mib": 512.0,
        "policies": policies,
        "commit": "abc",
    }


def test_a_family_is_summed_up_with_what_was_cut_off_and_what_could_not_be_read():
    rows = [
        _row("delivery", "generated", [10, 10]),
        _row("a", "ROS maps", [10, 10], flags=["dead_end"]),
        _row("b", "ROS maps", [30, 10], flags=["subgoal_overflow"]),
        {"source": "c", "family": "ROS maps", "error": "MapError: no"},
    ]
    delivery, maps = report(rows)
    assert (delivery["family"], delivery["flagged"]) == ("delivery", 0)
    # A dead end is no loss; the other four trials are flagged.
    assert (maps["buildings"], maps["trials"], maps["satisfied"], maps["flagged"]) == (2, 8, 6, 4)
    assert maps["cells"] == [200, 300]
    assert maps["seconds"]["potlp"] == [0.004, 0.004]
    assert maps["not read"] == {"c": "MapError: no"}
    assert "| ROS maps | 2 | 200, 300 | 7, 7 | 4, 4 | 4, 4 | 0.5, 0.5 | 8 | 6 | 4 |" in markdown([delivery, maps])


def test_the_command_goes_on_where_it_was_stopped(data, monkeypatch, capsys):
    asked = []

    def told(source, worlds):
        asked.append(source)
        return {key: value for key, value in _row("", "", [10, 10]).items() if key not in ("source", "family")}

    monkeypatch.setattr(buildings, "in_own_process", told)
    out = data / "rows.jsonl"
    command = ["buildings", "--data", str(data), "--out", str(out), "--report", str(data / "found")]
    monkeypatch.setattr(sys, "argv", [*command, "--most", "1"])
    buildings.main()
    assert len(asked) == len(buildings.GENERATED) + 2
    monkeypatch.setattr(sys, "argv", command)
    buildings.main()
    assert len(asked) == len(set(asked)) == len(buildings.GENERATED) + 5
    families = json.loads((data / "found.json").read_text())["families"]
    assert [entry["family"] for entry in families] == [*buildings.GENERATED, buildings.LARGE_MAP, "Open-RMF"]
    assert "| Open-RMF | 4 |" in capsys.readouterr().out
