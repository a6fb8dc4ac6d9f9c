"""What an estimator shows of what it painted and imagines: made again from a record, on the page and as a picture."""

import base64
import dataclasses
import io
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from PIL import Image
from typer.testing import CliRunner

from potlp_jax.cli import app
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import world_key
from potlp_jax.errors import EstimatorError
from potlp_jax.learning.building_config import BuildingConfig
from potlp_jax.learning.building_estimator import BuildingEstimator
from potlp_jax.learning.building_network import BuildingNetwork
from potlp_jax.learning.labels import TrueMapEstimator
from potlp_jax.learning.overlays import (
    Imagined,
    Overlay,
    Painted,
    imagined_overlay,
    overlays_of,
    painting_overlays,
)
from potlp_jax.learning.painting import Painting, blank_painting, paint
from potlp_jax.learning.squares import SQUARE
from potlp_jax.planning.estimates import Estimates
from potlp_jax.planning.policies import Policy
from potlp_jax.planning.search.config import BestFirstConfig
from potlp_jax.planning.situation import DecisionConfig
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.loop import run_trial
from potlp_jax.trials.replay import Views, panorama_at, replay_decision, views_of
from potlp_jax.view.overlays import draw_overlays, pack_overlay, strength
from potlp_jax.view.replay_page import replay_data, replay_page
from potlp_jax.view.style import IMAGINED_FREE, IMAGINED_WALL, area_colour, rgb
from potlp_jax.world.camera import CameraConfig
from potlp_jax.world.grid import BeliefMap, belief_from_numpy
from potlp_jax.world.sensing import SensorConfig
from tests.reference.browser import BROWSER, dump_page

TOY = make("toy")
CAMERA = CameraConfig(height=32, width=64, horizon=12.0, fold=4.0)
CONFIG = TrialConfig(
    sensor=SensorConfig(range_cells=4.0),
    camera=CAMERA,
    decision=DecisionConfig(search=BestFirstConfig(simulations=30)),
)


@struct.dataclass
class Painter:
    """Remembers what the camera saw; its answers depend on it, and it imagines the hazard ahead everywhere."""

    memory: Painting

    def encode(self, panorama):
        return panorama

    def remember(self, seen, belief, cell):
        return dataclasses.replace(self, memory=paint(self.memory, seen, belief, cell, CAMERA))

    def overlays(self, belief: BeliefMap) -> tuple[Overlay, ...]:
        rows, columns = (-(-size // 3) for size in belief.cells.shape)
        free = jnp.full((rows, columns), 0.25).at[0].set(1.0)
        holds = jnp.zeros((rows, columns, len(belief.propositions))).at[:, :, 1].set(0.5)
        return (*painting_overlays(self.memory), imagined_overlay(free, holds, belief, 3))

    def __call__(self, belief, subgoals, task):
        shape = (subgoals.mask.shape[0], task.class_mask.shape[0])
        bright = jnp.mean(self.memory.floor.astype(jnp.float32)) / 255
        chance = jnp.where(task.class_mask[None, :], jnp.broadcast_to(0.1 + bright, shape), 0.0)
        return Estimates(
            success_probability=chance, success_cost=jnp.full(shape, 9.0), failure_cost=jnp.full(shape, 5.0)
        )


WORLD = TOY.generate(world_key("validation", 1, "toy"))
# Found by its name on the command line.
painter = Painter(memory=blank_painting(*WORLD.shape))


@pytest.fixture(scope="module")
def trial():
    """PO-TLP asking the painter."""
    task = TOY.task("2")
    return run_trial(WORLD, task, Policy.POTLP, jax.random.key(0), CONFIG, environment="toy", estimator=painter)


@pytest.fixture(scope="module")
def views(trial) -> Views:
    return views_of(trial, painter)


@struct.dataclass
class FirstLook(Painter):
    """Says that all it answers comes from the first panorama."""

    def observations(self, subgoals):
        return jnp.where(subgoals.mask, 0, -1)


@struct.dataclass
class FirstLookOfMany(FirstLook):
    """Looks on the way, too: its panoramas are not those of decisions."""

    looks_on_the_way = True


def test_what_was_seen_on_the_way_has_no_number_in_the_record():
    asked = FirstLookOfMany(memory=blank_painting(*WORLD.shape))
    found = run_trial(WORLD, TOY.task("2"), Policy.POTLP, jax.random.key(0), CONFIG, environment="toy", estimator=asked)
    assert not any(decision.observations for decision in found.decisions)
    assert views_of(found, asked)


def test_an_estimator_of_ones_own_says_which_panorama_it_answers_from(trial):
    first = FirstLook(memory=blank_painting(*WORLD.shape))
    found = run_trial(WORLD, TOY.task("2"), Policy.POTLP, jax.random.key(0), CONFIG, environment="toy", estimator=first)
    assert [decision.observations for decision in found.decisions] == [
        (0,) * len(decision.subgoals) for decision in trial.decisions
    ]
    assert set(views_of(found, first).panoramas) == {0}
    # One that does not say is not asked.
    assert not any(decision.observations for decision in trial.decisions)


def test_the_views_of_a_trial_are_those_of_its_decisions(trial, views):
    assert len(trial.decisions) > 2
    assert sorted(views.panoramas) == sorted(views.overlays) == [decision.index for decision in trial.decisions]
    memory = blank_painting(*WORLD.shape)
    for decision in trial.decisions:
        seen = panorama_at(trial, decision)
        np.testing.assert_array_equal(views.panoramas[decision.index], seen)
        memory = paint(memory, seen, trial.belief_at(decision.step), jnp.asarray(decision.cell), CAMERA)
        floors, _, imagined = views.overlays[decision.index]
        assert isinstance(floors, Painted)
        np.testing.assert_array_equal(floors.colours, memory.floor)
        np.testing.assert_array_equal(floors.mask, np.isfinite(memory.distance))
        assert isinstance(imagined, Imagined)
    first, last = views.overlays[0][0], views.overlays[len(trial.decisions) - 1][0]
    assert isinstance(first, Painted)
    assert isinstance(last, Painted)
    assert np.any(np.asarray(first.colours) != np.asarray(last.colours))


def test_an_estimator_that_remembers_remembers_in_a_replay(trial):
    # Its answers depend on the painting: with a blank one the values would differ.
    decision = [entry for entry in trial.decisions if any(act.subgoal is not None for act in entry.actions)][-1]
    assert decision.index > 0
    _, plan, _ = replay_decision(trial, decision.index, painter)
    assert float(plan.value) == decision.value


def test_without_its_estimator_nothing_is_shown_and_the_log_says_so(trial, caplog):
    assert views_of(trial) == Views()
    assert "was made with the estimator tests.test_overlays:Painter: give that one" in caplog.text
    with pytest.raises(EstimatorError, match="which is not one of those that are shipped"):
        replay_decision(trial, 0)


def test_policies_and_estimators_with_nothing_to_show_show_nothing():
    walked = run_trial(WORLD, TOY.task("2"), Policy.BASELINE, jax.random.key(0), CONFIG)
    assert views_of(walked) == Views()
    belief = walked.belief_at(0)
    assert overlays_of(None, belief) == overlays_of(TrueMapEstimator(world=WORLD), belief) == ()
    data = replay_data(walked, Views())
    assert data["overlays"] == []
    assert data["overlays_at"] == {}


def test_the_building_network_shows_its_painting_and_its_squares():
    config = BuildingConfig(
        propositions=("goal", "hazard"), image_shape=(32, 64), widths=(4, 4, 4), blocks=(0, 0, 0), decoder=4, head=4
    )
    params = BuildingNetwork(config).init(jax.random.key(0))
    cells = np.full((10, 14), BeliefMap.UNKNOWN, np.int8)
    cells[:4, :6] = BeliefMap.FREE
    letters = np.zeros(cells.shape, np.int32)
    letters[2, 5] = 2
    belief = belief_from_numpy(cells, letters, propositions=config.propositions)
    asked = BuildingEstimator(params=params, memory=blank_painting(10, 14), config=config)
    floors, eyes, imagined = overlays_of(asked, belief)
    assert [overlay.name for overlay in (floors, eyes, imagined)] == [
        "painted: floors",
        "painted: at eye height",
        "imagined",
    ]
    assert isinstance(imagined, Imagined)
    said = jax.tree.map(jax.nn.sigmoid, asked.imagine(belief).squares)
    np.testing.assert_allclose(imagined.free, said.free, rtol=1e-5)
    np.testing.assert_allclose(imagined.holds[..., 0], said.holds[..., 0], rtol=1e-5)
    # The hazard's square is known to have it, so there is nothing to imagine.
    expected = np.array(said.holds[..., 1])
    expected[2 // SQUARE, 5 // SQUARE] = 0.0
    np.testing.assert_allclose(imagined.holds[..., 1], expected, rtol=1e-5)


def test_what_a_page_holds_is_what_was_shown(trial, views):
    rows, columns = WORLD.occupied.shape
    floors, _, imagined = views.overlays[1]
    text = pack_overlay(floors, (rows, columns))
    pixels = np.asarray(Image.open(io.BytesIO(base64.b64decode(text.split(",")[1]))))
    np.testing.assert_array_equal(pixels[:, :, 3] == 255, floors.mask)
    np.testing.assert_array_equal(pixels[floors.mask][:, :3], np.asarray(floors.colours)[floors.mask])
    # Cropped to the squares that have a cell within the extent: of 3 cells, 2 by 3 squares hold 4 by 7 cells.
    data = np.frombuffer(base64.b64decode(pack_overlay(imagined, (4, 7))), np.uint8).reshape(2, 3, 3)
    np.testing.assert_array_equal(data[:, :, 0], [[255] * 3, [64] * 3])
    np.testing.assert_array_equal(data[:, :, 1], 0)
    page = replay_data(trial, views)
    assert [entry["kind"] for entry in page["overlays"]] == ["painted", "painted", "imagined"]
    assert len(page["overlays_at"]) == len(trial.decisions)


def test_a_picture_has_the_map_where_it_is_known_and_what_is_imagined_elsewhere(trial, views):
    decision = trial.decisions[0]
    figure = draw_overlays(trial, decision, views.overlays[0])
    assert [axes.get_title(loc="left") for axes in figure.axes] == [overlay.name for overlay in views.overlays[0]]
    picture = np.asarray(figure.axes[2].get_images()[0].get_array())
    scale = picture.shape[0] // WORLD.occupied.shape[0]
    unknown = np.asarray(trial.belief_at(decision.step).unknown)
    below = 0.75 * np.array(rgb(IMAGINED_WALL)) + 0.25 * np.array(rgb(IMAGINED_FREE))
    weight = strength(np.array(0.5))
    hazard = (1 - weight) * below + weight * np.array(rgb(area_colour(1)))
    row, column = np.argwhere(unknown & (np.arange(unknown.shape[0]) > 3)[:, None])[-1]
    np.testing.assert_allclose(picture[row * scale, column * scale], hazard, atol=1)
    known = np.argwhere(~unknown & ~np.asarray(WORLD.occupied) & (np.asarray(WORLD.letters) == 0))[0]
    np.testing.assert_array_equal(picture[known[0] * scale, known[1] * scale], 255)


def test_chances_that_are_too_small_are_not_drawn():
    np.testing.assert_allclose(strength(np.array([0.0, 0.019, 0.04, 1.0])), [0.0, 0.0, 0.2, 1.0])


def test_the_commands_take_the_estimator_and_show_what_it_shows(trial, tmp_path):
    trial.save(tmp_path / "trial.json")
    named = ["--estimator", "tests.test_overlays:painter"]
    told = CliRunner().invoke(app, ["view", str(tmp_path), "--no-open", *named])
    assert told.exit_code == 0, told.stderr
    assert "painted: floors" in (tmp_path / "replay.html").read_text("utf-8")
    told = CliRunner().invoke(app, ["explain", f"{tmp_path}:0", "--out", str(tmp_path / "tree.png"), *named])
    assert told.exit_code == 0, told.stderr
    assert (tmp_path / "tree-map.png").stat().st_size > 0
    assert not (tmp_path / "tree-panoramas.png").exists()


TOUR = """<script>
const shown = [];
const select = document.querySelector("select");
const context = document.querySelector("canvas").getContext("2d");
const colours = () => {
  const found = {}, pixels = context.getImageData(0, 0, context.canvas.width, context.canvas.height).data;
  for (let i = 0; i < pixels.length; i += 4) {
    const colour = `${pixels[i]},${pixels[i + 1]},${pixels[i + 2]}`;
    found[colour] = (found[colour] ?? 0) + 1;
  }
  return found;
};
const choose = (index) => { select.selectedIndex = index; select.dispatchEvent(new Event("change")); };
const note = () => shown.push({
  name: select.options[select.selectedIndex].text, colours: colours(),
  scale: document.querySelector(".scale").textContent, reading: document.querySelector(".reading").textContent,
});
addEventListener("load", () => {
  choose(1);
  setTimeout(() => {
    for (const index of [0, 1, 3, 4]) { choose(index); note(); }
    // Of the list itself an arrow is the browser's; on the slider it goes a step on.
    const where = [select, document.querySelector("input")].map((part) => {
      part.dispatchEvent(new KeyboardEvent("keydown", {key: "ArrowRight", bubbles: true}));
      return document.querySelector(".where").textContent;
    });
    const result = document.createElement("pre");
    result.id = "result";
    const options = [...select.options].map((option) => option.text);
    const images = [...document.querySelectorAll("figure img")].map((image) => image.src.slice(0, 15));
    result.textContent = JSON.stringify({options, shown, images, where});
    document.body.append(result);
  }, 500);
});
</script></body>"""


@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed to look at the page with")
def test_a_browser_shows_what_was_painted_and_imagined(trial, views, tmp_path):
    page = tmp_path / "page.html"
    page.write_text(replay_page(trial, views).replace("</body>", TOUR), "utf-8")
    result = dump_page(page, tmp_path / "profile")
    names = ["free space", *trial.propositions]
    painted = ["painted: floors", "painted: at eye height"]
    assert result["options"] == ["what is known", *painted, "imagined", *(f"imagined: {name}" for name in names)]
    known, floors, imagined, free = result["shown"]
    mask = np.asarray(views.overlays[0][0].mask)
    some = ",".join(map(str, np.asarray(views.overlays[0][0].colours)[mask][0]))
    assert some in floors["colours"]
    assert some not in known["colours"]
    below = 0.75 * np.array(rgb(IMAGINED_WALL)) + 0.25 * np.array(rgb(IMAGINED_FREE))
    weight = 0.5**0.5
    hazard = (1 - weight) * below + weight * np.array(rgb(area_colour(1)))
    drawn = np.array([list(map(int, colour.split(","))) for colour in imagined["colours"]])
    assert np.min(np.max(np.abs(drawn - hazard), axis=1)) <= 2
    # Known floor stays as it is, but for the line around what is known.
    assert imagined["colours"]["255,255,255"] > 0.7 * known["colours"]["255,255,255"]
    assert re.search(rf"{trial.propositions[1]} 50 % near row \d+, column \d+", imagined["reading"])
    assert trial.propositions[0] not in imagined["reading"]
    assert known["scale"] == known["reading"] == ""
    assert free["scale"] == "0 %5 %10 %25 %50 %100 %"
    # The estimator does not say from which panorama it judges a subgoal: that of the decision is shown.
    assert result["images"] == ["data:image/jpeg"]
    assert [text.partition(" of ")[0] for text in result["where"]] == ["step 0", "step 1"]
