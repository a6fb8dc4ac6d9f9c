"""Datasets on disk: what is written is read back, by this library and by pandas; what is damaged is named."""

import dataclasses
import errno
import subprocess
import sys
import tempfile
import tracemalloc
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from potlp_jax.errors import DatasetError
from potlp_jax.learning import dataset
from potlp_jax.learning.dataset import (
    decode,
    encode,
    finished_shards,
    read_metadata,
    remove_unfinished_files,
    samples_file,
    view_id,
    views_file,
    worlds_file,
    write_shard,
)
from potlp_jax.learning.dataset_metadata import SCHEMA_VERSION, DatasetMetadata
from potlp_jax.learning.dataset_reading import joined, read_dataset
from tests.reference.data_sets import SHAPE, blank_columns, world_columns

ROOT = Path(__file__).parents[1]
METADATA = DatasetMetadata(
    propositions=("fire", "exit", "alarm"),
    environment="somewhere",
    family="somewhere",
    generator={"rooms": 2, "sizes": [3, 4]},
    split="training",
    camera={"height": 4},
    disturbance={},
    encoding={"format": "png"},
    weights={"low": 1.0, "high": 9.0},
    collection={"seed": 3},
    versions={"numpy": "2"},
    shape=SHAPE,
)


def _image(seed):
    return np.random.default_rng(seed).integers(0, 256, (4, 8, 3)).astype(np.uint8)


def _shard(shard, views=3, seed=0):
    """Columns of a shard with two samples a view; the samples name the views in reverse order."""
    rng = np.random.default_rng([shard, seed])
    ids = [view_id(shard, index) for index in range(views)]
    count = 2 * views
    success = rng.integers(0, 2, count).astype(float)
    numbers = {name: rng.random(count) + 1 for name in ("distance", "failure_cost", "success_weight", "failure_weight")}
    view_columns = {
        "view": ids,
        "world": [7] * views,
        "step": list(range(views)),
        "row": [1] * views,
        "column": [2] * views,
        "format": ["png"] * views,
        "image": [encode(_image(shard * 100 + index), "png") for index in range(views)],
        **blank_columns(views),
    }
    sample_columns = {
        "view": ids[::-1] * 2,
        "task": ["F exit"] * count,
        "outcome_class": [0] * count,
        "row": [3] * count,
        "column": [4] * count,
        "in_view": rng.integers(0, 2, count) > 0,
        "bearing": rng.uniform(-3, 3, count),
        "phi_stay": rng.integers(-1, 2, (count, 3)).tolist(),
        "phi_go": rng.integers(-1, 2, (count, 3)).tolist(),
        "success_probability": success,
        "success_cost": np.where(success > 0, 2.5, np.nan),
        **numbers,
    }
    return view_columns, sample_columns


def _write(folder, shards, metadata=METADATA):
    columns = {shard: _shard(shard) for shard in shards}
    for shard, (views, samples) in columns.items():
        write_shard(folder, shard, world_columns(7), views, samples, metadata)
    return columns


def test_what_is_written_is_read_back(tmp_path):
    columns = _write(tmp_path, [4, 0])
    samples = read_dataset(tmp_path)
    assert samples.metadata == read_metadata(tmp_path)
    assert samples.metadata.differences(METADATA) == []
    row = 0
    for shard in (0, 4):
        views, expected = columns[shard]
        for index, view in enumerate(expected["view"]):
            image = samples.images[samples.view_of[row]]
            assert image == views["image"][views["view"].index(view)]
            assert samples.in_view[row] == expected["in_view"][index]
            assert samples.cells[row].tolist() == [3, 4]
            assert samples.bearing[row] == np.float32(expected["bearing"][index])
            assert samples.distance[row] == np.float32(expected["distance"][index])
            assert samples.phi_stay[row].tolist() == expected["phi_stay"][index]
            assert samples.phi_go[row].tolist() == expected["phi_go"][index]
            assert samples.success[row] == expected["success_probability"][index]
            assert np.isnan(samples.success_cost[row]) == (samples.success[row] == 0)
            assert samples.failure_cost[row] == np.float32(expected["failure_cost"][index])
            assert samples.success_weight[row] == np.float32(expected["success_weight"][index])
            assert samples.failure_weight[row] == np.float32(expected["failure_weight"][index])
            row += 1
    assert row == len(samples.success)
    assert len(samples.images) == len(samples.maps) == 6
    # Each shard has its own true maps, also of a world that both have.
    assert samples.world_of.tolist() == [0, 0, 0, 1, 1, 1]
    assert len(samples.worlds) == 2


def test_pandas_reads_it_without_this_library(tmp_path):
    columns = _write(tmp_path, [2])
    views = pd.read_parquet(views_file(tmp_path, 2))
    samples = pd.read_parquet(samples_file(tmp_path, 2))
    together = samples.merge(views, on="view", suffixes=("", "_of_robot"), validate="many_to_one")
    assert len(together) == len(columns[2][1]["view"])
    assert [list(phi) for phi in samples["phi_go"]] == columns[2][1]["phi_go"]
    np.testing.assert_array_equal(decode(views["image"].iloc[1]), _image(201))


def test_colours_survive_encoding():
    red_left_blue_right = np.zeros((16, 16, 3), np.uint8)
    red_left_blue_right[:, :8, 0] = 200
    red_left_blue_right[:, 8:, 2] = 200
    np.testing.assert_array_equal(decode(encode(red_left_blue_right, "png")), red_left_blue_right)
    jpeg = encode(red_left_blue_right, "jpeg")
    assert jpeg[:2] == b"\xff\xd8"
    assert np.abs(decode(jpeg).astype(int) - red_left_blue_right).mean() < 20


def test_no_image_and_no_format():
    with pytest.raises(DatasetError, match="not an image"):
        decode(b"abc")
    with pytest.raises(DatasetError, match="not an image"):
        decode(b"")
    with pytest.raises(DatasetError, match="jpeg or png"):
        encode(_image(0), "gif")


def test_a_shard_exists_when_its_samples_do(tmp_path):
    _write(tmp_path, [0, 1])
    samples_file(tmp_path, 1).unlink()
    half_written = tmp_path / "views-00002.parquet.123.tmp"
    half_written.write_bytes(b"PAR1")
    assert finished_shards(tmp_path) == {0}
    assert len(read_dataset(tmp_path).images) == 3
    remove_unfinished_files(tmp_path)
    assert not half_written.exists()
    assert finished_shards(tmp_path / "nowhere") == set()


def test_more_shards_than_five_digits_can_number_are_found(tmp_path):
    _write(tmp_path, [7, 100_000])
    assert finished_shards(tmp_path) == {7, 100_000}
    assert len(read_dataset(tmp_path).images) == 6


def test_an_empty_folder_is_no_dataset(tmp_path):
    with pytest.raises(DatasetError, match="no finished shard"):
        read_dataset(tmp_path)


@pytest.mark.parametrize("file", [worlds_file, views_file, samples_file])
def test_a_truncated_file_is_named(tmp_path, file):
    _write(tmp_path, [0, 1])
    path = file(tmp_path, 1)
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(DatasetError, match=f"{path.name}: is not a shard of a dataset, or is damaged"):
        read_dataset(tmp_path)


def test_damage_inside_of_a_file_is_named(tmp_path):
    _write(tmp_path, [0])
    path = views_file(tmp_path, 0)
    data = path.read_bytes()
    path.write_bytes(data[:8] + b"\xff" * 200 + data[208:])
    with pytest.raises(DatasetError, match=path.name):
        read_dataset(tmp_path)


def test_missing_views_are_named(tmp_path):
    _write(tmp_path, [0])
    views_file(tmp_path, 0).unlink()
    with pytest.raises(DatasetError, match=r"views-00000.parquet is missing"):
        read_dataset(tmp_path)


def test_shards_of_different_datasets_do_not_mix(tmp_path):
    _write(tmp_path, [0])
    other = dataclasses.replace(METADATA, split="test", generator={"rooms": 5, "sizes": [3, 4]})
    _write(tmp_path, [1], other)
    with pytest.raises(DatasetError, match=r"generator.rooms was 2, is 5; split was \"training\", is \"test\""):
        read_dataset(tmp_path)


def test_another_schema_version_is_refused(tmp_path):
    _write(tmp_path, [0], dataclasses.replace(METADATA, schema_version=SCHEMA_VERSION + 1))
    with pytest.raises(DatasetError, match=f"schema version {SCHEMA_VERSION + 1}"):
        read_dataset(tmp_path)
    # Also where it lacks files that this version has, as the first one lacks maps.
    worlds_file(tmp_path, 0).unlink()
    with pytest.raises(DatasetError, match=f"schema version {SCHEMA_VERSION + 1}"):
        read_dataset(tmp_path)


def test_other_columns_are_refused(tmp_path):
    _write(tmp_path, [0])
    path = samples_file(tmp_path, 0)
    table = pq.read_table(path)
    wrong = table.set_column(table.schema.get_field_index("distance"), "distance", pa.array([1] * len(table)))
    pq.write_table(wrong.drop_columns(["phi_go"]), path)
    with pytest.raises(DatasetError, match="distance, phi_go"):
        read_dataset(tmp_path)


def test_a_foreign_file_has_no_metadata(tmp_path):
    _write(tmp_path, [0])
    pq.write_table(pa.table({"a": [1]}), samples_file(tmp_path, 0))
    with pytest.raises(DatasetError, match="no metadata"):
        read_dataset(tmp_path)


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("view", view_id(0, 99), "which is not in the shard"),
        ("phi_go", [1, 0], "phi_go whose length"),
        ("phi_go", [1, 0, 7], "samples-00000.parquet, row 1: phi_go must have entries -1, 0 and 1"),
        ("phi_stay", [-128, 0, 1], "row 1: phi_stay must have entries"),
        ("phi_stay", [None, 0, 1], "samples-00000.parquet has missing values"),
        ("row", 6, "samples-00000.parquet, row 1: row and column must be of a cell"),
        ("column", -1, "row 1: row and column must be of a cell"),
        ("success_probability", 1.5, "row 1: success_probability"),
        ("failure_weight", 0.0, "row 1: failure_weight"),
        ("failure_cost", -1.0, "row 1: failure_cost"),
        ("distance", np.inf, "row 1: distance"),
        ("bearing", np.nan, "row 1: bearing"),
    ],
)
def test_values_out_of_range_are_named(tmp_path, column, value, message):
    views, samples = _shard(0)
    samples[column] = list(samples[column])
    samples[column][1] = value
    write_shard(tmp_path, 0, world_columns(7), views, samples, METADATA)
    with pytest.raises(DatasetError, match=message):
        read_dataset(tmp_path)


def test_of_missing_values_it_is_said_once_what_to_do(tmp_path):
    views, samples = _shard(0)
    samples["phi_stay"] = [[None, 0, 1], *samples["phi_stay"][1:]]
    write_shard(tmp_path, 0, world_columns(7), views, samples, METADATA)
    with pytest.raises(DatasetError) as error:
        read_dataset(tmp_path)
    assert str(error.value).count("delete all files of the shard") == 1


def test_a_shard_that_cannot_be_written_leaves_nothing(tmp_path, monkeypatch):
    def full(_descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("potlp_jax.files.os.fsync", full)
    views, samples = _shard(0)
    with pytest.raises(OSError, match="No space left"):
        write_shard(tmp_path, 0, world_columns(7), views, samples, METADATA)
    assert not list(tmp_path.iterdir())


def test_a_success_has_a_cost(tmp_path):
    views, samples = _shard(0)
    samples["success_probability"] = [1.0] * 6
    samples["success_cost"] = [2.0] * 5 + [np.nan]
    write_shard(tmp_path, 0, world_columns(7), views, samples, METADATA)
    with pytest.raises(DatasetError, match="row 5: success_cost"):
        read_dataset(tmp_path)


def test_views_are_unique(tmp_path):
    views, samples = _shard(0)
    write_shard(tmp_path, 0, world_columns(7), {**views, "view": [0, 1, 0]}, {**samples, "view": [0] * 6}, METADATA)
    with pytest.raises(DatasetError, match="twice"):
        read_dataset(tmp_path)


def test_views_are_of_worlds_in_their_shard(tmp_path):
    views, samples = _shard(0)
    write_shard(tmp_path, 0, world_columns(8), views, samples, METADATA)
    with pytest.raises(DatasetError, match="rows of world 7, which is not in the shard"):
        read_dataset(tmp_path)


def test_data_sets_of_one_family_are_joined(tmp_path):
    _write(tmp_path / "one", [0])
    _write(tmp_path / "two", [1, 2], dataclasses.replace(METADATA, collection={"estimator": "mine"}))
    one, two = read_dataset(tmp_path / "one"), read_dataset(tmp_path / "two")
    both = joined([one, two])
    assert list(both.images) == [*one.images, *two.images]
    assert list(both.maps) == [*one.maps, *two.maps]
    assert both.images[-2] == two.images[4]
    with pytest.raises(IndexError):
        both.images[9]
    assert both.view_of.tolist() == one.view_of.tolist() + (two.view_of + 3).tolist()
    assert both.world_of.tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    np.testing.assert_array_equal(both.distance, np.concatenate([one.distance, two.distance]))
    larger = dataclasses.replace(two, metadata=dataclasses.replace(two.metadata, shape=(5, 90)))
    assert METADATA.shape == (6, 8)
    assert joined([one, larger]).metadata == dataclasses.replace(one.metadata, shape=(6, 90))
    other = dataclasses.replace(two, metadata=dataclasses.replace(two.metadata, resolution=0.5))
    with pytest.raises(DatasetError, match=r"differ in resolution cannot be joined: 1\.0 and 0\.5"):
        joined([one, other])
    # A data set that does not say it was painted without.
    painted = dataclasses.replace(two.metadata, collection={"glances": True})
    with pytest.raises(DatasetError, match="differ in glances cannot be joined: False and True"):
        joined([one, dataclasses.replace(two, metadata=painted)])
    labelled = dataclasses.replace(two.metadata, collection={"nearest": True})
    with pytest.raises(DatasetError, match="differ in nearest cannot be joined: False and True"):
        joined([one, dataclasses.replace(two, metadata=labelled)])


def test_images_stay_on_disk(tmp_path):
    # An image need not be one to be kept.
    images = [np.random.default_rng(index).bytes(1 << 20) for index in range(16)]
    views, samples = _shard(0, views=16)
    write_shard(tmp_path, 0, world_columns(7), {**views, "image": images, "floor": images}, samples, METADATA)
    del views["image"]
    tracemalloc.start()
    try:
        both = joined([read_dataset(tmp_path), read_dataset(tmp_path)])
        held, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert held < 1 << 20
    assert pa.total_allocated_bytes() < 1 << 20
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(both.images.__getitem__, range(32))) == images * 2
        assert [view.floor for view in pool.map(both.maps.__getitem__, range(32))] == images * 2


@pytest.mark.parametrize("sorted_by_view", [True, False])
def test_the_most_that_a_view_is_asked_is_found_in_pieces(tmp_path, monkeypatch, sorted_by_view):
    draw = np.random.default_rng(3)
    _write(tmp_path, [0])
    view_of = draw.integers(0, 40, 400).astype(np.int32)
    read, rows = read_dataset(tmp_path), draw.integers(0, 6, 400)
    arrays = {name: value for name, value in vars(read).items() if isinstance(value, np.ndarray)}
    columns = {name: array[rows] for name, array in arrays.items() if name != "world_of"}
    columns |= {
        "view_of": np.sort(view_of) if sorted_by_view else view_of,
        "cells": draw.integers(0, 3, (400, 2)).astype(np.int32),
        "phi_stay": draw.integers(-1, 1, (400, 3)).astype(np.int8),
    }
    samples = dataclasses.replace(read, **columns)
    monkeypatch.setattr(dataset, "_SAMPLES", 16)
    views = [set(samples.view_of[block].tolist()) for block in samples._blocks()]
    assert (len(views) > 10) == sorted_by_view
    assert sum(map(len, views)) == len(set.union(*views)) == len(set(view_of.tolist()))
    asked = zip(samples.view_of.tolist(), samples.cells.tolist(), samples.phi_stay.tolist(), strict=True)
    asked = {(view, tuple(cell), tuple(stay)) for view, cell, stay in asked}
    lanes = Counter(view for view, _, _ in asked)
    subgoals = Counter(view for view, _ in {(view, cell) for view, cell, _ in asked})
    assert samples.most_lanes == max(lanes.values())
    assert samples.most_subgoals == max(subgoals.values())


READER = """
import resource, sys
from potlp_jax.learning.batches import Batches
from potlp_jax.learning.dataset_reading import read_dataset
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
samples = read_dataset(sys.argv[1])
batches = Batches(samples, lambda samples, choice: [samples.images[view] for view in choice.views], 8, 2, 0)
for step in range(batches.per_epoch):
    batches.training_batch(step)
print(batches.per_epoch, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""


@pytest.mark.long
def test_a_data_set_larger_than_the_memory_allowed_is_read_and_shown_whole(tmp_path):
    """One shard of 160 MB, which does not compress; the reader's memory must not grow by half of it."""
    draw, count = np.random.default_rng(0), 1600
    views, samples = _shard(0, views=count)
    images = [draw.bytes(100_000) for _ in range(count)]
    write_shard(tmp_path, 0, world_columns(7), {**views, "image": images}, samples, METADATA)
    assert views_file(tmp_path, 0).stat().st_size > 150e6
    del images, views
    done = subprocess.run([sys.executable, "-c", READER, tmp_path], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    steps, kilobytes = map(int, done.stdout.split())
    assert steps == count // 8
    assert kilobytes < 80_000


def test_a_shard_may_have_no_views(tmp_path):
    columns = _shard(0, views=0)
    for shard in (0, 1):
        write_shard(tmp_path, shard, world_columns(7), *columns, METADATA)
    samples = read_dataset(tmp_path)
    assert (len(samples.images), len(samples.maps), len(samples.success)) == (0, 0, 0)


def test_a_full_temporary_folder_is_named(tmp_path, monkeypatch):
    _write(tmp_path, [0])
    # Writes to it fail as those to a full disk do.
    monkeypatch.setattr(tempfile, "TemporaryFile", lambda: Path("/dev/full").open("wb", buffering=0))  # noqa: SIM115 - its user closes it
    with pytest.raises(DatasetError, match=r"cannot be kept in .* \(No space left on device\): .*TMPDIR"):
        read_dataset(tmp_path)
