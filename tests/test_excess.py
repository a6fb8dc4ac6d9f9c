"""How far estimators are from an ideal observer: what belongs to which row of the table."""

import types

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from eval.limit import excess
from potlp_jax.errors import EvaluationError
from potlp_jax.learning.dataset import samples_file, views_file


def _samples(posterior=16):
    """Of three views, which stand in the second, the first and again the second shard of a folder."""
    return types.SimpleNamespace(
        view_of=np.array([0, 1, 1, 2]),
        world_of=np.array([0, 1, 1]),
        images=[b""] * 3,
        success=np.array([0.0, 0.5, 1.0, 0.25], np.float32),
        phi_go=np.array([[1, 0], [1, 1], [-1, 1], [0, -1]]),
        metadata=types.SimpleNamespace(propositions=("fire", "exit"), collection={"posterior": posterior}),
    )


@pytest.fixture
def folder(tmp_path):
    for shard, steps in ((0, [3]), (5, [39, 250])):
        pq.write_table(pa.table({"step": steps}), views_file(tmp_path, shard))
        samples_file(tmp_path, shard).touch()
    return tmp_path


def test_questions_are_counted_where_they_belong(monkeypatch, folder):
    answers = {"sure": np.array([0.0, 0.5, 0.0, 0.25]), "even": np.full(4, 0.5)}
    monkeypatch.setattr(excess, "read_dataset", lambda _: _samples())
    monkeypatch.setattr(excess, "excess_of", lambda name, samples: (answers[name] - samples.success) ** 2)
    results = excess.results_of(["sure", "even"], folder)
    rows = {row["group"]: row for row in results["rows"]}
    assert (results["views"], results["worlds"]) == (3, 2)
    counts = {name: row["questions"] for name, row in rows.items()}
    assert counts == {
        **{"all": 4, "0 to 9 moves": 1, "10 to 39 moves": 2, "40 to 99 moves": 0, "100 moves or more": 1},
        **{"for fire": 2, "for exit": 2},
    }
    assert rows["all"]["doubt"] == pytest.approx((0.25 + 0.1875) / 4)
    assert rows["10 to 39 moves"]["excess"] == pytest.approx({"sure": 0.5, "even": 0.125})
    assert rows["for fire"]["excess"]["even"] == pytest.approx(0.125)
    text = excess.markdown(results)
    assert "| questions | number | doubt | excess of sure | excess of even |" in text
    assert "| 100 moves or more | 1 | 0.1875 | 0.0000 | 0.0625 |" in text
    assert "| 40 to 99 moves | 0 | - | - | - |" in text


def test_labels_of_single_buildings_are_refused(monkeypatch, folder):
    monkeypatch.setattr(excess, "read_dataset", lambda _: _samples(posterior=0))
    with pytest.raises(EvaluationError, match="single buildings"):
        excess.results_of(["sure"], folder)
