"""``eval.scale``: what is measured of the engine and of the store."""

import sys
import time

import pytest

from eval.scale.disturbed import Kept, require_same, rows_of
from eval.scale.fits import Way, curve, difference, draw
from eval.scale.overhead import efficiency, row, store_of
from eval.scale.reading import one_in
from potlp_jax.learning.dataset import finished_shards, samples_file, views_file, worlds_file
from potlp_jax.sweep.runner import RESULTS
from potlp_jax.sweep.store import Store


def test_efficiency_counts_what_workers_sleep_of_all_their_time():
    found = efficiency(workers=3, seconds=0.05, each=4)
    assert (found["workers"], found["units"]) == (3, 12)
    assert found["wall"] >= 4 * 0.05
    assert found["efficiency"] == pytest.approx(12 * 0.05 / (3 * found["wall"]))


def test_a_store_is_measured_with_all_its_rows():
    found = store_of(100, per_commit=32)
    assert found["rows"] == 100
    assert found["bytes_a_row"] > 300
    assert all(value > 0 for value in found.values())


def test_rows_that_are_lost_or_differ_are_noticed(tmp_path):
    store = Store(tmp_path / RESULTS)
    store.finish([row(number) for number in range(4)])
    store.close()
    whole = rows_of(tmp_path)
    assert len(whole) == 4
    require_same(whole, dict(whole), tmp_path)
    first, *rest = whole
    with pytest.raises(AssertionError, match="1 rows lost"):
        require_same({item: whole[item] for item in rest}, whole, tmp_path)
    with pytest.raises(AssertionError, match="rows differ"):
        require_same({**whole, first: whole[rest[0]]}, whole, tmp_path)


def test_what_is_kept_is_begun_again_when_it_was_killed():
    kept = Kept(sys.executable, "-c", "import time; time.sleep(60)", pause=0.0)
    try:
        first = kept.process
        kept.look()
        assert kept.process is first
        kept.kill()
        kept.look()
        time.sleep(0.05)
        assert kept.process is not first
        assert kept.process is not None
        assert kept.process.poll() is None
    finally:
        kept.kill()


def test_curves_of_fits_are_read_compared_and_drawn(tmp_path):
    (tmp_path / "log.csv").write_text("step,epoch,training_loss,validation_loss\n3,1,2.0,4.0\n6,2,1.0,2.0\n")
    found = curve(tmp_path)
    assert found == {"step": [3, 6], "training_loss": [2, 1], "validation_loss": [4, 2]}
    other = {**found, "validation_loss": [4.0, 2.5]}
    assert difference(found, found) == 0
    assert difference(other, found) == pytest.approx(0.25)
    with pytest.raises(AssertionError):
        difference({**found, "step": [3, 7]}, found)
    draw([{"run": str(Way(1)), "curve": found}, {"run": str(Way(1, 2)), "curve": other}], tmp_path / "curves.png")
    assert (tmp_path / "curves.png").stat().st_size > 1000
    assert [str(way) for way in (Way(1), Way(4), Way(1, 2))] == ["1 device", "4 devices", "2 processes, 1 device each"]


def test_a_part_of_a_data_set_has_one_shard_in_so_many(tmp_path):
    for shard in (0, 1, 2, 3, 7):
        for named in (worlds_file, views_file, samples_file):
            named(tmp_path / "whole", shard).parent.mkdir(exist_ok=True)
            named(tmp_path / "whole", shard).write_text(str(shard))
    # A shard that was not finished is in no part.
    worlds_file(tmp_path / "whole", 8).write_text("8")
    part = one_in(tmp_path / "whole", 2, tmp_path / "part")
    assert finished_shards(part) == {0, 2, 7}
    assert len(list(part.iterdir())) == 9
    assert views_file(part, 7).read_text() == "7"
