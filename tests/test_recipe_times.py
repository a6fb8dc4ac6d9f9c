"""Times of a recipe's steps: of all runs together, also of those that ended in the middle of a step."""

import subprocess
import sys
import time

import pytest

from potlp_jax.errors import TrainingError
from potlp_jax.recipes.times import TIMES, Times, read_times


def test_steps_have_a_line_each_in_the_order_in_which_they_began(tmp_path):
    file = tmp_path / "new" / TIMES
    times = Times(file)
    with times.of(0, "training"):
        time.sleep(0.2)
    with times.of(0, "fit"):
        pass
    found = read_times(file)
    assert list(found) == [(0, "training"), (0, "fit")]
    assert 0.2 <= found[0, "training"] < 60


def test_what_earlier_runs_spent_counts(tmp_path):
    file = tmp_path / TIMES
    file.write_text("0,training,100.0\n0,fit,7.0\n0,training,50.0\n")
    with Times(file).of(0, "training"):
        pass
    assert read_times(file)[0, "training"] == pytest.approx(150, abs=5)
    assert read_times(file)[0, "fit"] == 7


@pytest.mark.parametrize("contents", [b"0,fit\n", b"\x00" * 40, b"stage,step,seconds\n", b"\xff\xfe"])
def test_times_that_are_damaged_are_named(tmp_path, contents):
    file = tmp_path / TIMES
    file.write_bytes(contents)
    with pytest.raises(TrainingError, match=r"times\.csv"):
        Times(file)


def test_a_step_that_fails_took_its_time(tmp_path):
    file = tmp_path / TIMES

    @Times(file).of(1, "explored")
    def fail():
        time.sleep(0.2)
        raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert read_times(file)[1, "explored"] >= 0.2


def test_a_run_that_is_killed_leaves_what_it_spent(tmp_path):
    file = tmp_path / TIMES
    program = f"""
import time
from pathlib import Path
from potlp_jax.recipes.times import Times
with Times(Path({str(file)!r}), every=0.1).of(0, "fit"):
    time.sleep(600)
"""
    process = subprocess.Popen([sys.executable, "-c", program])
    deadline = time.monotonic() + 120
    while not (file.is_file() and read_times(file)[0, "fit"] >= 0.2):
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.05)
    process.kill()
    process.wait()
    assert read_times(file)[0, "fit"] >= 0.2
