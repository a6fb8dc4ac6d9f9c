"""Large maps: a working resolution is chosen and said, and memory is stated before it is taken."""

import logging
import tracemalloc
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from potlp_jax import images
from potlp_jax.cli import app
from potlp_jax.environments.ros import working_grid
from potlp_jax.environments.ros.buildings import load_building
from potlp_jax.environments.ros.cleaning import clean_map
from potlp_jax.environments.ros.working_grid import BYTES_A_PIXEL, DOOR, MOST_CELLS, choose_cell
from potlp_jax.errors import MapError, MapWarning

SIDE = 4000
"""Pixels of 0.05 m: 200 m."""

PIXEL, RADIUS = Fraction(1, 20), Fraction(1, 10)


def write_large(folder: Path, side: int = SIDE) -> Path:
    """Two halls and a door of a metre between them."""
    pixels = np.full((side, side), 254, np.uint8)
    pixels[[0, -1]] = pixels[:, [0, -1]] = pixels[:, side // 2] = 0
    pixels[side // 4 : side // 4 + 20, side // 2] = 254
    (folder / "large.pgm").write_bytes(b"P5 %d %d 255\n" % (side, side) + pixels.tobytes())
    file = folder / "large.yaml"
    text = (
        "image: large.pgm\nresolution: 0.05\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    file.write_text(text)
    return file


@pytest.fixture(scope="module")
def large(tmp_path_factory):
    return write_large(tmp_path_factory.mktemp("maps"))


@pytest.mark.long
def test_a_map_of_4000_squared_pixels_is_planned_on_the_finest_multiple_that_fits(large):
    image_map = load_building(large)
    with pytest.warns(
        MapWarning, match=r"4,000 x 4,000 pixels of 0\.05 m become 444,889 cells of 0\.3 m, because with"
    ):
        clean = clean_map(image_map)
    assert clean.frame.resolution == 0.3
    assert clean.free.size <= MOST_CELLS
    assert not clean.cut_off, "the door is open"
    # Another is taken as it is given.
    assert clean_map(image_map, 0.4).frame.resolution == 0.4


def test_the_command_says_what_was_chosen_and_what_memory_it_takes(large):
    result = CliRunner().invoke(app, ["map", "clean", str(large), "--out", str(large.parent / "out.yaml")])
    assert result.exit_code == 0, result.stderr
    said = " ".join(result.stderr.split())
    assert "large.pgm: 4,000 x 4,000 pixels: reading and cleaning takes about" in said
    assert "GiB of memory" in said
    assert "become 444,889 cells of 0.3 m" in said
    assert "passages narrower than 0.8 m may be closed" in said
    assert "cells of 0.3 m" in result.stdout
    assert said.index("GiB") < said.index("become"), "before it is taken"


def test_what_does_not_fit_the_memory_is_refused_before_it_is_read(large, monkeypatch):
    monkeypatch.setattr(working_grid, "available_memory", lambda: 1 << 28)
    monkeypatch.setattr(images, "MOST_IMAGE", SIDE**2 + 100)
    tracemalloc.start()
    with pytest.raises(MapError, match=r"takes about 1\.0 GiB of memory; 0\.2 GiB are available\. Crop the image"):
        load_building(large)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2.5 * SIDE**2, "the file's bytes, and no pixels"


def test_the_memory_that_is_stated_suffices(tmp_path, monkeypatch):
    file = write_large(tmp_path, 1000)
    # A read reserves what a file may have at most; the system gives what is filled.
    monkeypatch.setattr(images, "MOST_IMAGE", 1000**2 + 100)
    tracemalloc.start()
    clean_map(load_building(file))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert 0.4 * BYTES_A_PIXEL < peak / 1000**2 < BYTES_A_PIXEL


def test_small_maps_are_as_they_were_and_nothing_is_said(tmp_path, caplog, recwarn):
    with caplog.at_level(logging.WARNING):
        clean = clean_map(load_building(write_large(tmp_path, 1000)))
    assert clean.frame.resolution == 0.2
    assert not caplog.records
    assert not recwarn.list


@pytest.mark.parametrize(
    ("side", "pixel", "expected"),
    [
        (2000, PIXEL, "1/5"),
        (2896, PIXEL, "1/5"),
        (2897, PIXEL, "1/4"),
        (4000, PIXEL, "3/10"),
        (5700, PIXEL, "7/20"),
        (2000, Fraction(3, 100), "1/5"),
        (5500, Fraction(3, 100), "6/25"),
        (100, Fraction(2, 5), "2/5"),
    ],
)
@pytest.mark.filterwarnings("ignore::potlp_jax.errors.MapWarning")
def test_the_choice(side, pixel, expected):
    """The finest that fits; never so coarse that an ordinary door could be closed, unless the pixels are."""
    cell = choose_cell(Path("map.yaml"), (side, side), pixel, RADIUS)
    assert cell == Fraction(expected)
    assert cell == pixel or 2 * (RADIUS + cell) <= DOOR
