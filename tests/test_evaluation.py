"""The estimator's report: figures against slow formulas, ablations, groups, pictures, and the command line."""

import dataclasses
import importlib.util
import json
import math
from collections import Counter
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from typer.testing import CliRunner

from potlp_jax.cli import app
from potlp_jax.codec import config_from_dict
from potlp_jax.errors import EvaluationError, PropositionsError
from potlp_jax.learning.ablations import INTACT, ablated
from potlp_jax.learning.building_config import BuildingConfig
from potlp_jax.learning.dataset import Samples, decode, encode, view_id, write_shard
from potlp_jax.learning.dataset_metadata import DatasetMetadata
from potlp_jax.learning.estimator import estimator_file, shipped_files
from potlp_jax.learning.map_images import without_painting
from potlp_jax.learning.metrics import (
    BINS,
    DISTANCE_BANDS,
    Prior,
    cost_bins,
    evaluate,
    figures_of,
    groups_of,
    prior_of,
    reliability,
    roc_auc,
)
from potlp_jax.learning.network import EstimatorNetwork, NetworkConfig
from potlp_jax.learning.panorama_learner import PanoramaLearner
from potlp_jax.learning.predictions import Predictions, check_fit, most_confident, predict
from potlp_jax.learning.serialization import save_estimator
from potlp_jax.view.calibration import cost_bin_table, draw_costs, draw_reliability, probability_table
from potlp_jax.view.predictions import class_in_words, draw_predictions
from potlp_jax.view.style import CHOSEN, rgb
from potlp_jax.world.camera import CameraConfig
from tests.reference import data_sets as blank
from tests.reference.data_sets import blank_columns, blank_fields, world_columns

SHAPE = (64, 128)
SIGMA = ("fire", "alarm", "exit")
METADATA = DatasetMetadata(
    propositions=SIGMA,
    environment="synthetic",
    family="synthetic",
    generator={},
    split="validation",
    camera=dataclasses.asdict(CameraConfig(height=SHAPE[0], width=SHAPE[1])),
    disturbance={},
    encoding={"format": "png"},
    weights={"low": 1.0, "high": 50.0},
    collection={},
    versions={},
    shape=blank.SHAPE,
)
CONFIG = NetworkConfig(
    propositions=SIGMA,
    image_shape=SHAPE,
    first_widths=(2, 2, 2, 3),
    second_widths=(3,) * 8,
    dense_widths=(4, 4, 4, 4),
)
NETWORK = EstimatorNetwork(CONFIG)
LEARNER = PanoramaLearner(CONFIG)


def make_samples(views: int, count: int, seed: int, soft: bool = False) -> Samples:
    """Random samples whose views are in no order; some views have more samples than a batch takes of one."""
    draw = np.random.default_rng(seed)
    success = draw.uniform(size=count) if soft else (draw.uniform(size=count) < 0.4)
    success = success.astype(np.float32)
    cost = draw.uniform(1, 90, count).astype(np.float32)
    return Samples(
        images=[encode(draw.integers(0, 256, (*SHAPE, 3)).astype(np.uint8), "png") for _ in range(views)],
        view_of=(draw.integers(0, views, count) ** 2 // views).astype(np.int32),
        bearing=draw.uniform(-math.pi, math.pi, count).astype(np.float32),
        distance=draw.uniform(0, 150, count).astype(np.float32),
        phi_stay=draw.integers(-1, 1, (count, len(SIGMA))).astype(np.int8),
        phi_go=draw.integers(-1, 2, (count, len(SIGMA))).astype(np.int8),
        success=success,
        success_cost=np.where(success > 0, cost, np.nan).astype(np.float32),
        failure_cost=draw.uniform(0, 90, count).astype(np.float32),
        success_weight=np.ones(count, np.float32),
        failure_weight=np.ones(count, np.float32),
        metadata=METADATA,
        **blank_fields(views, count),
    )


def make_predictions(count: int, seed: int, decimals: int = 1) -> Predictions:
    """Random ones, rounded so that ties occur."""
    draw = np.random.default_rng((seed, 1))
    return Predictions(
        success_logit=draw.normal(0, 2, count).round(decimals).astype(np.float32),
        success_cost=draw.uniform(1, 90, count).astype(np.float32),
        failure_cost=draw.uniform(0, 90, count).astype(np.float32),
    )


def _only(samples: Samples, chosen) -> Samples:
    arrays = {f.name: getattr(samples, f.name) for f in dataclasses.fields(samples)}
    of_samples = {k: v[chosen] for k, v in arrays.items() if isinstance(v, np.ndarray) and k != "world_of"}
    return dataclasses.replace(samples, **of_samples)


@settings(max_examples=30, deadline=None)
@given(count=st.integers(2, 40), seed=st.integers(0, 10**6), soft=st.booleans(), prior=st.floats(0.05, 0.95))
def test_figures_equal_the_formulas_written_out(count, seed, soft, prior):
    samples, predictions = make_samples(1, count, seed, soft), make_predictions(count, seed)
    found = figures_of(samples, predictions, Prior(prior, "training"))
    y = [float(value) for value in samples.success]
    p = [1 / (1 + math.exp(-float(value))) for value in predictions.success_logit]
    rate = sum(y) / count
    brier = sum((a - b) ** 2 for a, b in zip(p, y, strict=True)) / count
    assert found.samples == count
    assert found.success_rate == pytest.approx(rate)
    assert found.brier == pytest.approx(brier)
    assert found.skill == pytest.approx(1 - brier / (sum((prior - b) ** 2 for b in y) / count))
    entropy = -sum(b * math.log(a) + (1 - b) * math.log(1 - a) for a, b in zip(p, y, strict=True))
    assert found.log_loss == pytest.approx(entropy / count, rel=1e-5)
    won = pairs = 0.0
    for i in range(count):
        for j in range(count):
            pairs += y[i] * (1 - y[j])
            won += y[i] * (1 - y[j]) * (1.0 if p[i] > p[j] else 0.5 if p[i] == p[j] else 0.0)
    assert found.auc == (pytest.approx(won / pairs) if pairs > 0 else pytest.approx(math.nan, nan_ok=True))
    gap = 0.0
    for low in range(BINS):
        inside = [k for k in range(count) if low <= p[k] * BINS < low + 1]
        gap += abs(sum(p[k] - y[k] for k in inside))
    assert found.calibration_error == pytest.approx(gap / count, abs=1e-9)
    for errors, said, true, share in (
        (found.success_cost, predictions.success_cost, samples.success_cost, y),
        (found.failure_cost, predictions.failure_cost, samples.failure_cost, [1 - b for b in y]),
    ):
        kept = [(float(a), float(b), w) for a, b, w in zip(said, true, share, strict=True) if w > 0]
        assert errors.samples == len(kept)
        if not kept:
            assert math.isnan(errors.rmse)
            continue
        total = sum(w for _, _, w in kept)
        mean = sum(w * b for _, b, w in kept) / total
        squared = sum(w * (a - b) ** 2 for a, b, w in kept) / total
        spread = sum(w * (b - mean) ** 2 for _, b, w in kept) / total
        assert errors.mae == pytest.approx(sum(w * abs(a - b) for a, b, w in kept) / total)
        assert errors.rmse == pytest.approx(math.sqrt(squared))
        assert errors.bias == pytest.approx(sum(w * (a - b) for a, b, w in kept) / total, abs=1e-9)
        if len(kept) > 1:
            assert errors.r2 == pytest.approx(1 - squared / spread, rel=1e-5)
        assert sum(entry.samples for entry in errors.bins) == len(kept)
        gap = 0.0
        for entry in errors.bins:
            inside = [(a, b, w) for a, b, w in kept if entry.low <= a <= entry.high]
            assert len(inside) == entry.samples
            weight = sum(w for _, _, w in inside)
            assert entry.predicted == pytest.approx(sum(w * a for a, _, w in inside) / weight)
            assert entry.true == pytest.approx(sum(w * b for _, b, w in inside) / weight)
            variance = sum(w * (b - entry.true) ** 2 for _, b, w in inside) / weight
            assert entry.spread == pytest.approx(math.sqrt(variance), abs=1e-6)
            gap += weight * abs(entry.predicted - entry.true)
        assert errors.calibration_error == pytest.approx(gap / total, abs=1e-9)


def test_bins_of_costs_have_equally_many_samples_and_equal_predictions_share_one():
    true, weight = np.arange(1000.0), np.ones(1000)
    bins, weights = cost_bins(true, true + 5, weight)
    assert [entry.samples for entry in bins] == [100] * BINS
    np.testing.assert_array_equal(weights, 100.0)
    assert [entry.predicted - entry.true for entry in bins] == pytest.approx([5.0] * BINS)
    constant, _ = cost_bins(true, np.full(1000, 7.0), weight)
    assert [(entry.low, entry.high, entry.samples) for entry in constant] == [(7.0, 7.0, 1000)]
    # Half of the predictions are one number: it fills its bins alone.
    ties, _ = cost_bins(true, np.maximum(true, 500.0), weight)
    assert ties[0].samples == 501
    assert all(abs(entry.samples - 100) <= 1 for entry in ties[1:])


def test_what_is_too_low_far_away_shows_as_a_bias_of_that_distance():
    samples, predictions = make_samples(2, 400, 31), make_predictions(400, 31)
    far = samples.distance >= 120
    said = np.where(far, samples.failure_cost - 8, samples.failure_cost).astype(np.float32)
    predictions = dataclasses.replace(predictions, failure_cost=said)
    report = evaluate(samples, predictions, prior_of({}, samples))
    bias = {band: figures.failure_cost.bias for band, figures in report.groups["distance"].items()}
    assert bias.pop("over 120") == pytest.approx(-8, abs=1e-4)
    assert max(map(abs, bias.values())) < 1e-4
    table = cost_bin_table(report, "t")
    assert table.row_count == len(report.overall.success_cost.bins) + len(report.overall.failure_cost.bins)
    axes = draw_costs(samples, predictions, report, "t").axes[-1]
    widths = {
        label.get_text().split(" (")[0]: float(np.sum(bar.get_extents().width))
        for label, bar in zip(axes.get_yticklabels(), axes.patches, strict=True)
    }
    assert widths["distance over 120"] > 0
    assert widths["distance 0 to 15"] < 0.01 * widths["distance over 120"]


def test_figures_equal_those_of_scikit_learn():
    metrics = pytest.importorskip("sklearn.metrics")
    samples, predictions = make_samples(1, 500, 3), make_predictions(500, 3)
    found = figures_of(samples, predictions, Prior(0.5, "training"))
    won = samples.success > 0
    assert found.auc == pytest.approx(metrics.roc_auc_score(won, predictions.success))
    assert found.brier == pytest.approx(metrics.brier_score_loss(won, predictions.success))
    assert found.log_loss == pytest.approx(metrics.log_loss(won, predictions.success))
    assert found.success_cost.r2 == pytest.approx(
        metrics.r2_score(samples.success_cost[won], predictions.success_cost[won]), rel=1e-5
    )
    assert found.failure_cost.mae == pytest.approx(
        metrics.mean_absolute_error(samples.failure_cost[~won], predictions.failure_cost[~won]), rel=1e-5
    )


def test_a_perfect_predictor_has_skill_one_and_the_constant_prior_skill_zero():
    samples = make_samples(3, 300, 5)
    sure = np.where(samples.success > 0, 60, -60).astype(np.float32)
    perfect = Predictions(sure, np.nan_to_num(samples.success_cost, nan=7.0), samples.failure_cost)
    prior = prior_of({}, samples)
    report = evaluate(samples, perfect, prior)
    for figures in (report.overall, *(entry for parts in report.groups.values() for entry in parts.values())):
        assert figures.skill == pytest.approx(1)
        assert figures.auc == 1
        assert figures.calibration_error == pytest.approx(0)
        assert figures.success_cost.rmse == figures.failure_cost.bias == 0
        assert figures.success_cost.r2 == figures.failure_cost.r2 == 1
    same = np.full(300, math.log(prior.value / (1 - prior.value)), np.float32)
    won = samples.success > 0
    means = samples.success_cost[won].mean(), samples.failure_cost[~won].mean()
    constant = evaluate(samples, Predictions(same, *(np.full(300, mean) for mean in means)), prior)
    assert constant.overall.skill == pytest.approx(0, abs=1e-6)
    assert constant.overall.own_skill == pytest.approx(0, abs=1e-6)
    assert constant.overall.auc == 0.5
    assert constant.overall.success_cost.r2 == pytest.approx(0, abs=1e-6)
    assert constant.overall.failure_cost.bias == pytest.approx(0, abs=1e-4)
    # The prior is one for all: a part with another rate is answered no better than by the prior, but worse than by
    # that part's own mean.
    for figures in constant.groups["distance"].values():
        assert figures.skill == pytest.approx(0, abs=1e-6)
        assert figures.own_skill < 0


def test_what_is_not_defined_is_nan():
    samples = _only(make_samples(1, 50, 6), np.arange(20))
    samples = dataclasses.replace(samples, success=np.zeros(20, np.float32))
    figures = figures_of(samples, make_predictions(20, 6), prior_of({}, samples))
    for value in (figures.auc, figures.skill, figures.own_skill, figures.success_cost.mae):
        assert math.isnan(value)
    assert figures.success_cost.samples == 0
    assert math.isfinite(figures.log_loss)


def test_bins_cover_all_answers_from_zero_to_one():
    said = np.array([0.0, 0.05, 0.1, 0.95, 1.0, 1.0])
    bins = reliability(np.array([0.0, 1.0, 1.0, 1.0, 1.0, 0.0]), said)
    assert [entry.samples for entry in bins] == [2, 1, 0, 0, 0, 0, 0, 0, 0, 3]
    assert (bins[0].low, bins[-1].high) == (0.0, 1.0)
    assert bins[0].predicted == pytest.approx(0.025)
    assert bins[-1].observed == pytest.approx(2 / 3)
    assert math.isnan(bins[4].observed)


def test_auc_of_one_kind_is_nan():
    assert math.isnan(roc_auc(np.ones(3), np.arange(3.0)))


def test_every_sample_gets_its_own_answer():
    samples = make_samples(6, 150, 7)
    counts = np.bincount(samples.view_of, minlength=6)
    assert counts.max() > 32
    assert np.any(np.diff(samples.view_of) < 0)
    params = NETWORK.init(jax.random.key(1))
    seen = []
    predictions = predict(LEARNER, params, samples, seen.append)
    assert seen[-1] == 150

    @jax.jit
    def one(image, bearing, distance, phi_stay, phi_go):
        centred = NETWORK.centre(NETWORK.encode(params, image), bearing, distance)
        return NETWORK.answer(params, centred, phi_stay, phi_go)

    for k in range(0, 150, 7):
        image = jnp.asarray(decode(samples.images[samples.view_of[k]]))
        columns = (samples.bearing[k], samples.distance[k], samples.phi_stay[k], samples.phi_go[k])
        answer = one(image, *map(jnp.asarray, columns))
        for name in ("success_logit", "success_cost", "failure_cost"):
            assert getattr(predictions, name)[k] == pytest.approx(float(getattr(answer, name)), rel=1e-4, abs=1e-5)
    assert len(np.unique(predictions.success_logit)) > 100


def test_ablations_take_away_what_they_say_and_nothing_else():
    samples = make_samples(4, 80, 8)
    assert ablated(samples, INTACT) is samples
    dark, mixed = ablated(samples, "image"), ablated(samples, "phi")
    assert len(dark.images) == 4
    for image in dark.images:
        np.testing.assert_array_equal(decode(image), np.zeros((*SHAPE, 3), np.uint8))
    assert dark.maps == [without_painting(view) for view in samples.maps]
    pairs = [
        [(*stay, *go) for stay, go in zip(some.phi_stay.tolist(), some.phi_go.tolist(), strict=True)]
        for some in (samples, mixed)
    ]
    assert Counter(pairs[0]) == Counter(pairs[1])
    assert sum(a != b for a, b in zip(*pairs, strict=True)) > 40
    for other, changed in ((dark, {"images", "maps"}), (mixed, {"phi_stay", "phi_go"})):
        for field in dataclasses.fields(Samples):
            if field.name not in changed:
                assert getattr(other, field.name) is getattr(samples, field.name)
    np.testing.assert_array_equal(ablated(samples, "phi").phi_go, mixed.phi_go)
    with pytest.raises(EvaluationError, match=r"sound.*image, phi"):
        ablated(samples, "sound")


def test_groups_are_what_the_report_says():
    samples = make_samples(2, 200, 9)
    samples = dataclasses.replace(samples, metadata=dataclasses.replace(METADATA, resolution=0.5, unit="metres"))
    groups = groups_of(samples)
    assert list(groups["proposition"]) == list(SIGMA)
    edges = [0.5 * bound for bound in DISTANCE_BANDS]
    for k in range(200):
        assert [name for name, held in groups["proposition"].items() if held[k]] == [
            p for p, entry in zip(SIGMA, samples.phi_go[k], strict=True) if entry == 1
        ]
        (avoided,) = (int(name) for name, held in groups["avoided"].items() if held[k])
        assert avoided == samples.phi_stay[k].tolist().count(-1)
        (band,) = (place for place, held in enumerate(groups["distance"].values()) if held[k])
        assert band == sum(samples.distance[k] >= edge for edge in edges)
    report = evaluate(samples, make_predictions(200, 9), Prior(0.4, "training"))
    chosen = groups["proposition"]["alarm"]
    part = make_predictions(200, 9)
    part = Predictions(part.success_logit[chosen], part.success_cost[chosen], part.failure_cost[chosen])
    assert report.groups["proposition"]["alarm"] == figures_of(_only(samples, chosen), part, Prior(0.4, "training"))
    few = _only(samples, samples.distance < 5)
    assert list(evaluate(few, make_predictions(len(few.success), 1), Prior(0.4, "x")).groups["distance"]) == [
        "0 to 7.5"
    ]


def test_the_prior_is_the_training_datas_where_it_is_known():
    samples = make_samples(1, 40, 10)
    assert prior_of({"prior": 0.3}, samples) == Prior(0.3, "training")
    found = prior_of({"figures": {}}, samples)
    assert (found.value, found.source) == (pytest.approx(samples.success.mean()), "evaluated")


def test_an_estimator_is_evaluated_on_data_of_its_own_kind_only():
    samples = make_samples(1, 5, 11)
    learned = METADATA.domain
    check_fit(CONFIG, learned, samples, "net", "data")
    check_fit(CONFIG, dataclasses.replace(learned, family="another"), samples, "net", "data")
    other = dataclasses.replace(CONFIG, propositions=("alarm", "fire", "exit"))
    with pytest.raises(PropositionsError, match=r"^data has .* net \(alarm, fire, exit\)"):
        check_fit(other, learned, samples, "net", "data")
    with pytest.raises(EvaluationError, match=r"\(64, 128\).*\(64, 192\)"):
        check_fit(dataclasses.replace(CONFIG, image_shape=(64, 192)), learned, samples, "net", "data")
    low = dataclasses.replace(learned, camera=dataclasses.replace(learned.camera, eye_height=0.3))
    with pytest.raises(EvaluationError, match=r"data is not what net learned from: .* eye_height \(0.3, here 1.5\)"):
        check_fit(CONFIG, low, samples, "net", "data")
    with pytest.raises(EvaluationError, match="counts in metres"):
        check_fit(CONFIG, dataclasses.replace(learned, unit="metres"), samples, "net", "data")
    building = BuildingConfig(propositions=CONFIG.propositions, image_shape=CONFIG.image_shape, glances=False)
    check_fit(building, learned, samples, "net", "data")
    with pytest.raises(EvaluationError, match=r"data was painted without glances.*from with;.*--set glances=true"):
        check_fit(dataclasses.replace(building, glances=True), learned, samples, "net", "data")
    with pytest.raises(EvaluationError, match=r"data has maps with cells of 1, net learned from cells of 0\.5"):
        check_fit(dataclasses.replace(building, step=0.5), learned, samples, "net", "data")
    with pytest.raises(EvaluationError, match="no panoramas"):
        check_fit(CONFIG, learned, dataclasses.replace(samples, images=[]), "net", "data")


def _labelled(collection) -> dict:
    return {"data": {"collection": collection}}


def test_an_estimator_is_evaluated_on_labels_of_its_own_kind_only():
    samples = make_samples(1, 5, 11)
    near = dataclasses.replace(samples, metadata=dataclasses.replace(METADATA, collection={"nearest": True}))
    for data, made in (
        (samples, _labelled({"nearest": False})),
        (samples, _labelled({})),
        (near, _labelled({"nearest": True})),
        # A file that does not say how its labels were made may be of either kind.
        (near, {"data": None}),
        (near, {}),
    ):
        check_fit(CONFIG, METADATA.domain, data, "net", "data", made)
    with pytest.raises(EvaluationError, match=r"data does not ask what net answers: .* --set nearest=true"):
        check_fit(CONFIG, METADATA.domain, samples, "net", "data", _labelled({"nearest": True}))
    # Data sets of before could be labelled in one way alone.
    with pytest.raises(EvaluationError, match="collect with --set nearest=false"):
        check_fit(CONFIG, METADATA.domain, near, "net", "data", _labelled({}))


def test_the_most_confident_right_and_wrong_answers_are_found():
    samples, predictions = make_samples(12, 200, 12), make_predictions(200, 12, decimals=6)
    chosen = most_confident(samples, predictions, 3)
    assert {*chosen} == {f"{right} {said}" for right in ("true", "false") for said in ("positives", "negatives")}
    logit = predictions.success_logit
    for name, indices in chosen.items():
        said = name.endswith("positives")
        right = name.startswith("true")
        able = [k for k in range(200) if (logit[k] >= 0) == said and (samples.success[k] > 0) == (said == right)]
        best = {}
        for k in sorted(able, key=lambda k: -abs(logit[k])):
            best.setdefault(int(samples.view_of[k]), k)
        assert indices.tolist() == list(best.values())[:3]


@pytest.mark.parametrize(
    ("stay", "go", "words"),
    [
        ((-1, 0, 0), (0, 1, 0), ("stay: not fire", "go: alarm")),
        ((-1, 0, -1), (-1, 0, 1), ("stay: not fire, not exit", "go: exit, not fire")),
        ((0, 0, 0), (1, 1, 0), ("stay: anything", "go: fire, alarm")),
    ],
)
def test_classes_in_words(stay, go, words):
    assert class_in_words(np.array(stay, np.int8), np.array(go, np.int8), SIGMA) == words


def test_panoramas_have_their_subgoal_in_the_centre_and_texts_keep_to_their_column():
    samples, predictions = make_samples(9, 60, 13), make_predictions(60, 13)
    # A pixel column looks along 2 pi (c + 1/2) / W - pi: white there, black elsewhere.
    columns = np.arange(9) * 13 + 5
    samples = dataclasses.replace(
        samples,
        phi_stay=np.full_like(samples.phi_stay, -1),
        bearing=(2 * math.pi * (columns[samples.view_of] + 0.5) / SHAPE[1] - math.pi).astype(np.float32),
        images=[encode(np.uint8(255) * np.tile(np.arange(SHAPE[1]) == c, (64, 1))[..., None].repeat(3, 2), "png")
                for c in columns.tolist()],
    )  # fmt: skip
    chosen = most_confident(samples, predictions, 3)
    figure = draw_predictions(samples, predictions, chosen, "title")
    assert len(figure.axes) == sum(map(len, chosen.values())) > 4
    for axes in figure.axes:
        shown = np.asarray(axes.images[0].get_array())
        (column,) = np.flatnonzero(shown[0, :, 0])
        assert abs(column - axes.lines[0].get_xdata()[0]) <= 0.5
        assert tuple(rgb(axes.lines[0].get_color())) == tuple(rgb(CHOSEN))
    renderer = figure.canvas.get_renderer()
    boxes = [text.get_window_extent(renderer) for text in figure.texts] + [a.get_window_extent() for a in figure.axes]
    assert all(box.x0 >= 0 and box.x1 <= figure.bbox.x1 and box.y0 >= 0 for box in boxes)
    for one in range(len(boxes)):
        assert not any(boxes[one].overlaps(other) for other in boxes[one + 1 :])


def test_pictures_of_data_without_one_kind_are_drawn():
    samples, predictions = make_samples(2, 30, 14), make_predictions(30, 14)
    samples = dataclasses.replace(samples, success=np.ones(30, np.float32))
    report = evaluate(samples, predictions, prior_of({}, samples))
    figures = (
        draw_costs(samples, predictions, report, "t"),
        draw_reliability({INTACT: report}, "t"),
        draw_predictions(samples, predictions, most_confident(samples, predictions, 2), "t"),
    )
    for figure in figures:
        figure.canvas.draw()
    assert any("none" in text.get_text() for text in figures[2].texts)
    assert probability_table(report, "t").row_count == 1 + sum(map(len, report.groups.values()))


def _potlp(*arguments):
    return CliRunner().invoke(app, ["estimator", *map(str, arguments)])


@pytest.fixture(scope="module")
def estimator(tmp_path_factory):
    """An untrained estimator as a file."""
    path = tmp_path_factory.mktemp("estimator") / "tiny.npz"
    figures = {"validation_brier": 0.125, "validation_success_rmse": math.nan}
    data = {"environment": "synthetic", "split": "training", "camera": {"width": SHAPE[1]}, "unit": "cells"}
    metadata = {"data": data, "prior": 0.25, "figures": figures, "steps": 1200, "best_step": 900, "panoramas": 77}
    save_estimator(path, NETWORK.init(jax.random.key(2)), CONFIG, METADATA.domain, metadata)
    return path


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """A data set of one shard, with the samples it was written from."""
    samples = make_samples(3, 50, 15)
    folder = tmp_path_factory.mktemp("dataset")
    views = {"view": [view_id(0, i) for i in range(3)], "image": samples.images, "format": ["png"] * 3}
    views |= {name: [0] * 3 for name in ("world", "step", "row", "column")} | blank_columns(3)
    names = {"success_probability": "success"}
    columns = ("bearing", "distance", "success_probability", "success_cost", "failure_cost", "success_weight")
    rows = {name: getattr(samples, names.get(name, name)) for name in (*columns, "failure_weight")}
    rows |= {"view": [view_id(0, view) for view in samples.view_of.tolist()], "task": ["F exit"] * 50}
    rows |= {name: getattr(samples, name).tolist() for name in ("phi_stay", "phi_go")}
    rows |= {name: [0] * 50 for name in ("outcome_class", "row", "column")} | {"in_view": [True] * 50}
    write_shard(folder, 0, world_columns(0), views, rows, METADATA)
    return folder, samples


def test_evaluate_reports_what_the_library_computes(estimator, dataset, tmp_path):
    folder, samples = dataset
    result = _potlp("evaluate", estimator, folder, "--ablate", "all", "--out", tmp_path, "--json")
    assert result.exit_code == 0, result.stderr
    report = json.loads(result.stdout)
    params = NETWORK.init(jax.random.key(2))
    assert (report["prior"], report["prior_source"]) == (0.25, "training")
    assert list(report["figures"]) == ["intact", "image", "phi"]
    for name, found in report["figures"].items():
        expected = evaluate(samples, predict(LEARNER, params, ablated(samples, name)), Prior(0.25, "training"))
        assert found["overall"]["brier"] == expected.overall.brier
        assert found["overall"]["failure_cost"]["rmse"] == expected.overall.failure_cost.rmse
        assert found["groups"].keys() == expected.groups.keys()
        assert found["groups"]["proposition"]["exit"]["skill"] == expected.groups["proposition"]["exit"].skill
    briers = {found["overall"]["brier"] for found in report["figures"].values()}
    assert len(briers) == 3
    assert json.loads((tmp_path / "evaluation.json").read_text()) == report
    table = (tmp_path / "table.txt").read_text()
    for part in ("image blacked out: P_S", "phi shuffled: costs", "asks for exit", "ablations", "constant prior 0.250"):
        assert part in table
    for name in ("reliability", "costs", "predictions"):
        with Image.open(tmp_path / f"{name}.png") as picture:
            assert min(picture.size) > 400


def test_evaluate_prints_tables_and_warns_of_worlds_it_was_trained_on(estimator, dataset, tmp_path):
    result = _potlp("evaluate", estimator, dataset[0])
    assert result.exit_code == 0, result.stderr
    assert "intact: P_S" in result.stdout
    assert "ablations" not in result.stdout
    assert "trained on" not in result.stderr
    own = tmp_path / "own.npz"
    metadata = {"data": {"environment": "synthetic", "split": "validation"}}
    save_estimator(own, NETWORK.init(jax.random.key(2)), CONFIG, METADATA.domain, metadata)
    result = _potlp("evaluate", own, dataset[0])
    assert "trained on synthetic/validation" in result.stderr
    assert "the mean P_S of these samples" in result.stdout
    # Also where the estimator that it goes on from was.
    source = {"environment": "synthetic", "split": "validation"}
    metadata = {"training_data": {"0": {**source, "split": "training"}}, "earlier_data": {"0": source}}
    save_estimator(own, NETWORK.init(jax.random.key(2)), CONFIG, METADATA.domain, metadata)
    assert "trained on synthetic/validation" in _potlp("evaluate", own, dataset[0]).stderr


def test_info_shows_what_the_file_says(estimator):
    shown = _potlp("info", estimator)
    assert shown.exit_code == 0, shown.stderr
    for part in ("fire, alarm, exit", "64 × 128", "synthetic/training", "0.1250", "1,200 steps", "0.2500"):
        assert part in shown.stdout
    assert "nan" not in shown.stdout
    data = json.loads(_potlp("info", estimator, "--json").stdout)
    assert config_from_dict(NetworkConfig, data["network"], "network") == CONFIG
    assert data["bytes"] == estimator.stat().st_size
    assert data["metadata"]["figures"]["validation_success_rmse"] is None


@pytest.mark.parametrize(
    ("metadata", "shown"),
    [
        ({"steps": 5}, "5 steps\n"),
        ({"steps": 5, "seconds": "long", "best_step": 3}, "5 steps; best at step 3"),
        ({"steps": "many", "initial": 7, "prior": True, "panoramas": None, "samples": 12}, "12 samples"),
        ({"training_data": [{"environment": "x"}]}, "architecture"),
        ({"training_data": {"0": 3, "1": {"environment": "x", "worlds": 4}}}, "x/not named, 4 worlds"),
        ({"figures": {"validation_brier": None, "validation_loss": 0.5}}, "validation loss"),
        ({"figures": [0.5], "versions": "new"}, "architecture"),
        ({"data": None}, "architecture"),
        ({"data": {"shape": None, "environment": 3, "split": "training"}}, "not named/training"),
        ({"data": {"shape": [5, "wide"]}, "earlier_data": {"0": None}}, "architecture"),
    ],
)
def test_metadata_of_another_form_are_left_out(metadata, shown, dataset, tmp_path):
    save_estimator(tmp_path / "e.npz", NETWORK.init(jax.random.key(0)), CONFIG, METADATA.domain, metadata)
    result = _potlp("info", tmp_path / "e.npz")
    assert result.exit_code == 0, result.exception
    assert shown in "\n".join(line.strip() for line in result.stdout.splitlines()) + "\n"
    assert "None" not in result.stdout
    assert _potlp("info", tmp_path / "e.npz", "--json").exit_code == 0


def test_an_estimator_whose_metadata_have_another_form_is_evaluated(dataset, tmp_path):
    metadata = {"training_data": [3], "earlier_data": 4, "data": None}
    save_estimator(tmp_path / "e.npz", NETWORK.init(jax.random.key(0)), CONFIG, METADATA.domain, metadata)
    assert _potlp("evaluate", tmp_path / "e.npz", dataset[0]).exit_code == 0


@pytest.mark.parametrize(("fovea", "words"), [(0, "nothing"), (5, "11 columns × 48 rows")])
def test_info_says_how_closely_a_subgoal_is_looked_at(tmp_path, fovea, words):
    config = dataclasses.replace(CONFIG, fovea=fovea)
    save_estimator(tmp_path / "e.npz", EstimatorNetwork(config).init(jax.random.key(0)), config, METADATA.domain, {})
    assert words in _potlp("info", tmp_path / "e.npz").stdout


def test_a_file_goes_before_a_shipped_estimator_of_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert estimator_file("parcels") == shipped_files()["parcels"]
    assert estimator_file("mine.npz") == Path("mine.npz")
    Path("parcels").touch()
    assert estimator_file("parcels") == Path("parcels")


@pytest.mark.parametrize("command", ["info", "evaluate"])
def test_a_shipped_estimator_is_known_by_its_name(dataset, command):
    result = _potlp(*{"info": ("info", "firefighting"), "evaluate": ("evaluate", "firefighting", dataset[0])}[command])
    if command == "info":
        assert result.exit_code == 0, result.stderr
        assert "fire, alarm, extinguisher, exit" in result.stdout
    else:  # It was found: what is wrong is that these data are about other propositions.
        assert "(fire, alarm, extinguisher, exit)" in result.stderr


def test_bad_input_is_one_clear_message(estimator, dataset, tmp_path, monkeypatch):
    folder = dataset[0]
    other = tmp_path / "other.npz"
    config = dataclasses.replace(CONFIG, propositions=("goal",))
    save_estimator(other, EstimatorNetwork(config).init(jax.random.key(0)), config, METADATA.domain, {})
    near = tmp_path / "near.npz"
    save_estimator(near, NETWORK.init(jax.random.key(0)), CONFIG, METADATA.domain, _labelled({"nearest": True}))
    broken = tmp_path / "broken.npz"
    broken.write_bytes(estimator.read_bytes()[:500])
    for arguments, part in (
        (("info", tmp_path / "none.npz"), "there is no estimator"),
        (("info", broken), "damaged"),
        (("evaluate", broken, folder), "damaged"),
        (("evaluate", estimator, tmp_path), "there is no dataset"),
        (("evaluate", other, folder), "has the propositions (fire, alarm, exit)"),
        (("evaluate", near, folder), "collect with --set nearest=true"),
        (("evaluate", estimator, folder, "--ablate", "sound"), "unknown ablation 'sound'"),
    ):
        result = _potlp(*arguments)
        assert result.exit_code == 2, arguments
        assert part in result.stderr
        assert result.stdout == ""
        assert "Traceback" not in result.stderr
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *more: None if name == "pyarrow" else find(name))
    result = _potlp("evaluate", estimator, folder)
    assert result.exit_code == 1
    assert "pip install 'potlp-jax[train]'" in result.stderr
    assert _potlp("info", estimator).exit_code == 0
