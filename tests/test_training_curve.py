"""What the stages of a recipe took, as its folder says."""

import pytest

from eval.training_curve import Stage, draw, markdown, stages_of
from potlp_jax.errors import EvaluationError

TIMES = "0,training,60.0\n0,validation,30.0\n0,fit,120.0\n1,training,300.0\n1,fit,90.0\n"


@pytest.fixture
def recipe(tmp_path):
    """A recipe of two stages that both ended."""
    (tmp_path / "times.csv").write_text(TIMES)
    for folder in (tmp_path / "round-0", tmp_path):
        folder.mkdir(exist_ok=True)
        (folder / "estimator.npz").write_bytes(b"")
        (folder / "log.csv").write_text("step,seconds,validation_skill\n5,30.0,0.5\n10,60.0,0.75\n")
    return tmp_path


def test_stages_count_from_nothing(recipe):
    assert stages_of(recipe) == [Stage(recipe / "round-0", 90.0, 210.0), Stage(recipe, 510.0, 600.0)]


def test_rounds_are_in_the_order_of_their_numbers(recipe):
    for number in range(1, 11):
        folder = recipe / f"round-{number}"
        folder.mkdir()
        (folder / "estimator.npz").write_bytes(b"")
    assert [stage.folder.name for stage in stages_of(recipe)][:-1] == [f"round-{number}" for number in range(11)]


def test_stages_that_did_not_end_are_left_out(recipe):
    (recipe / "estimator.npz").unlink()
    assert [stage.folder.name for stage in stages_of(recipe)] == ["round-0"]
    (recipe / "round-0" / "estimator.npz").unlink()
    with pytest.raises(EvaluationError, match="no estimator"):
        stages_of(recipe)


def test_another_folder_is_refused(tmp_path):
    with pytest.raises(EvaluationError, match="times"):
        stages_of(tmp_path)


def test_skills_are_over_minutes_from_nothing(recipe):
    assert stages_of(recipe)[1].skills() == [(9.0, 0.5), (9.5, 0.75)]


def test_table_and_picture_show_each_stage(recipe):
    share = {"pairs": 60, "attainable_share": 0.5, "attainable_low": 0.25, "attainable_high": 0.75}
    found = [
        {"minutes": stage.ended / 60, "skills": stage.skills(), "tasks": {"1": share}} for stage in stages_of(recipe)
    ]
    assert markdown(found).splitlines()[2:] == [
        "| 0 | 4 | 0.750 | 50.0 % (25 to 75) |",
        "| 1 | 10 | 0.750 | 50.0 % (25 to 75) |",
    ]
    draw(found, recipe / "curve.png")
    assert (recipe / "curve.png").read_bytes().startswith(b"\x89PNG")
