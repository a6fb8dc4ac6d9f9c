"""Pictures: the files are made, show what they should, and their texts do not cover each other."""

import dataclasses
import io
import itertools
import json
import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.colors import to_hex
from PIL import Image, ImageSequence
from rich.console import Console

from potlp_jax.cli.output import print_table
from potlp_jax.errors import PictureError, TaskWarning
from potlp_jax.sweep.statistics import Comparison, TrialResult
from potlp_jax.sweep.store import Item, Row
from potlp_jax.task.task import Task
from potlp_jax.task.words import transition_words
from potlp_jax.trials.record import NEVER_SEEN, ActionRecord, Decision, Outcome, Trial
from potlp_jax.types import Status
from potlp_jax.view.animation import frame_steps, save_animation
from potlp_jax.view.automata import draw_automaton, save_automaton, to_dot, to_mermaid
from potlp_jax.view.comparisons import comparison_table, draw_scatter, remark_lines
from potlp_jax.view.decisions import (
    FIGURES,
    action_name,
    action_names,
    action_table,
    decision_to_dict,
    describe_decision,
    describe_move,
    rank_actions,
    task_of,
    why_no_actions,
)
from potlp_jax.view.labels import place_labels
from potlp_jax.view.layers import cell_image
from potlp_jax.view.maps import describe_outcome, draw_side_by_side, draw_trial
from potlp_jax.view.style import (
    AREA_COLOURS,
    CHOSEN,
    FREE_SEEN,
    FREE_UNSEEN,
    HATCH,
    POLICY_COLOURS,
    STATE_COLOURS,
    WALL_SEEN,
    WALL_UNSEEN,
    area_colour,
    faded,
    new_figure,
    policy_styles,
    rgb,
    save_figure,
    state_colour,
)
from potlp_jax.view.trees import draw_tree
from potlp_jax.world.grid import make_world, pad_world

PROPOSITIONS = ("goal", "hazard")
HEIGHT, WIDTH = 12, 26
DOOR = (6, 12)


def _world(goal=(9, 22), hazard=(3, 20)):
    occupied = np.ones((HEIGHT, WIDTH), bool)
    occupied[1:-1, 1:12] = occupied[1:-1, 13:-1] = False
    occupied[DOOR] = False
    letters = np.zeros((HEIGHT, WIDTH), np.int32)
    letters[goal], letters[hazard] = 1, 2
    return make_world(occupied, letters, (6, 2), propositions=PROPOSITIONS)


def _action(index, q_value, subgoal: int | None = 0, **others):
    values = dict(success_probability=0.25, success_cost=12.5, failure_cost=7.0, distance=10.0, visits=40)
    finish = subgoal is None
    return ActionRecord(
        index=index,
        subgoal=subgoal,
        cell=None if finish else DOOR,
        from_state=None if finish else 0,
        to_state=None if finish else 1,
        q_value=q_value,
        **(values | others),
    )


def _decision(index, step, cell, actions=()):
    return Decision(
        index=index,
        step=step,
        cell=cell,
        state=0,
        key=(0, index),
        kind="action" if actions else "frontier",
        choice=actions[0].index if actions else None,
        target=DOOR,
        target_state=0,
        value=31.4,
        fallback=False,
        status=0,
        subgoals=(DOOR, (2, 11)),
        actions=actions,
        path=(cell, DOOR),
    )


@pytest.fixture(scope="module")
def trial() -> Trial:
    """A walk through the door to the goal, with the cells within six columns seen from each step."""
    world = _world()
    path = [(6, column) for column in range(2, 20)] + [(7, 20), (8, 21), (9, 22)]
    first_seen = np.full((HEIGHT, WIDTH), NEVER_SEEN, np.int32)
    for step, (_, column) in reversed(list(enumerate(path[:-1]))):
        first_seen[:, max(0, column - 6) : min(column + 2, 20)] = step
    task = Task.shipped("toy-2")
    actions = (_action(0, 31.4), _action(3, 48.25, subgoal=1), _action(8, 55.0, subgoal=None))
    decisions = [_decision(index, 4 * index, path[4 * index], actions if index < 3 else ()) for index in range(5)]
    return Trial(
        outcome=Outcome.SATISFIED,
        cost=21.2,
        path=tuple(path),
        word=tuple([0] * (len(path) - 1) + [1]),
        states=tuple([0] * (len(path) - 1) + [1]),
        decisions=tuple(decisions),
        first_seen=first_seen,
        world=world,
        task_text=task.text,
        task_hoa=task.to_hoa(),
        propositions=PROPOSITIONS,
        policy="oracle",
        environment="toy/validation",
        world_number=3,
        status=0,
        config={},
        versions={},
    )


def _colours(image) -> set[tuple[int, ...]]:
    return {tuple(colour) for colour in np.asarray(image.convert("RGB")).reshape(-1, 3).tolist()}


def _overlaps(figure, texts) -> list[tuple[str, str]]:
    renderer = figure.canvas.get_renderer()
    boxes = [(text.get_text(), text.get_window_extent(renderer)) for text in texts if text.get_text()]
    return [(a, b) for (a, first), (b, second) in itertools.combinations(boxes, 2) if first.overlaps(second)]


def test_picture_of_a_trial_shows_every_part(trial, tmp_path):
    figure = draw_trial(trial)
    save_figure(figure, tmp_path / "trial.png")
    colours = _colours(Image.open(tmp_path / "trial.png"))
    for part in (FREE_SEEN, WALL_SEEN, FREE_UNSEEN, HATCH, area_colour(0), state_colour(0), state_colour(1)):
        assert rgb(part) in colours, part
    (axes,) = figure.axes
    names = {text.get_text() for text in axes.texts}
    assert {"goal", "hazard", "1"} <= names
    heading = " ".join(text.get_text() for text in figure.texts)
    for part in (trial.task_text, "oracle", "21.2", "satisfied", "world 3"):
        assert part in heading
    texts = [text for legend in figure.legends for text in legend.get_texts()]
    legend = [text.get_text() for text in texts]
    assert {"state 0: find goal, avoiding hazard", "state 1: satisfied"} <= set(legend)
    assert {"never seen", "start", "end", "goal", "hazard"} <= set(legend)
    assert not _overlaps(figure, [*axes.texts, *figure.texts, *texts])


def test_a_trial_that_failed_shows_what_was_left_to_try(trial):
    stuck = dataclasses.replace(trial, outcome=Outcome.STUCK)
    names = {text.get_text() for text in draw_trial(stuck).axes[0].texts}
    assert {"s0", "s1"} <= names
    assert not {"s0", "s1"} & {text.get_text() for text in draw_trial(trial).axes[0].texts}


def test_the_legend_names_what_is_drawn_and_covers_nothing(trial, tmp_path):
    """The subgoals of a trial that failed have a row of the legend for themselves where the others are full."""
    stuck = dataclasses.replace(trial, outcome=Outcome.STUCK)
    bare = dataclasses.replace(trial.decisions[-1], subgoals=(), target=None)
    both, left = {"subgoal", "chosen"}, dataclasses.replace(stuck, decisions=(bare,))
    for shown, expected in ((stuck, both), (_long_names(stuck), both), (left, set())):
        figure = draw_trial(shown)
        # Legends are laid out in drawing.
        save_figure(figure, tmp_path / "trial.png")
        renderer = figure.canvas.get_renderer()
        texts = [text for legend in figure.legends for text in legend.get_texts()]
        assert {"subgoal", "chosen"} & {text.get_text() for text in texts} == expected
        lowest = figure.axes[0].get_tightbbox(renderer).y0
        assert all(text.get_window_extent(renderer).y1 < lowest for text in texts)


def _long_names(trial):
    """The beginning of the trial on a narrow map, with names as long as names may be."""
    names = tuple(f"{'proposition':_<43}_{name}" for name in trial.propositions)
    task = Task.from_formula(" & ".join(f"F {name}" for name in names), propositions=names)
    occupied, letters = np.array(trial.world.occupied)[:, :8], np.zeros((HEIGHT, 8), np.int32)
    occupied[:, -1] = True
    letters[2, 5], letters[9, 5] = 1, 2
    return dataclasses.replace(
        trial,
        world=make_world(occupied, letters, (6, 2), propositions=names),
        first_seen=trial.first_seen[:, :8],
        propositions=names,
        task_text=task.text,
        task_hoa=task.to_hoa(),
        path=trial.path[:5],
        states=trial.states[:5],
        word=trial.word[:5],
        decisions=trial.decisions[:1],
    )


def test_long_names_leave_no_picture(trial, tmp_path):
    long = _long_names(trial)
    figure = draw_trial(long)
    save_figure(figure, tmp_path / "long.png")
    renderer = figure.canvas.get_renderer()
    assert sum(len(legend.get_texts()) for legend in figure.legends) > 1
    for legend in figure.legends:
        for text in legend.get_texts():
            box = text.get_window_extent(renderer)
            assert 0 <= box.x0 < box.x1 <= figure.bbox.width, text.get_text()
    # Of the animation the figure is not at hand: what is drawn to its very edge was cut off there.
    save_animation(long, tmp_path / "long.gif")
    with Image.open(tmp_path / "long.gif") as animation:
        frame = np.asarray(animation.convert("RGB"))
    for edge in (frame[0], frame[-1], frame[:, 0], frame[:, -1]):
        assert np.all(edge == 255)


def test_names_and_formulas_with_dollars_are_no_mathematics(trial, tmp_path):
    names = ("cost$a", "co_st$^b")
    task = Task.from_formula('F "cost$a" & F "co_st$^b"', propositions=names)
    dear = dataclasses.replace(trial, propositions=names, task_text=task.text, task_hoa=task.to_hoa())
    save_figure(draw_trial(dear), tmp_path / "trial.svg")
    save_figure(draw_side_by_side([dear, dear]), tmp_path / "both.png")
    save_figure(draw_automaton(task), tmp_path / "task.svg")
    assert save_animation(dear, tmp_path / "trial.gif") > 1
    tree = _tree_node([_tree_action(0, 7.0, 40, _tree_outcome(1.0, None, None))])
    save_figure(draw_tree(tree, task, task.text), tmp_path / "tree.svg")
    for file in ("trial.svg", "task.svg", "tree.svg"):
        assert "cost$a" in "".join(ElementTree.parse(tmp_path / file).getroot().itertext()), file


def _lightness_and_warmth(colour: str) -> tuple[float, float]:
    """Oklab lightness, and how far red-yellow outweighs green-blue (Ottosson 2020)."""
    linear = np.array(
        [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in np.array(rgb(colour)) / 255]
    )
    to_cone = np.array([[0.4122, 0.5363, 0.0514], [0.2119, 0.6807, 0.1074], [0.0883, 0.2817, 0.6300]])
    to_lab = np.array([[0.2105, 0.7936, -0.0041], [1.9780, -2.4286, 0.4506], [0.0259, 0.7828, -0.8087]])
    light, green_red, blue_yellow = to_lab @ np.cbrt(to_cone @ linear)
    return float(light), float(green_red + blue_yellow)


def test_no_state_looks_like_an_area():
    states = [_lightness_and_warmth(colour) for colour in STATE_COLOURS]
    areas = [_lightness_and_warmth(colour) for colour in AREA_COLOURS]
    # Lightness is seen alike by all; warmth by most.
    assert max(light for light, _ in states) + 0.1 < min(light for light, _ in areas)
    assert max(warmth for _, warmth in states) < min(warmth for _, warmth in areas)


def test_a_policy_has_one_colour_whatever_it_is_compared_with():
    alone, all_of_them = policy_styles(["potlp"]), policy_styles(["mine", *POLICY_COLOURS, "yours"])
    assert alone["potlp"] == all_of_them["potlp"]
    assert len({style.colour for style in all_of_them.values()}) == len(all_of_them)
    assert not {style.colour for style in all_of_them.values()} & {*AREA_COLOURS}


def test_trial_without_decisions_has_a_picture(trial, tmp_path):
    start = dataclasses.replace(
        trial,
        decisions=(),
        path=trial.path[:1],
        states=trial.states[:1],
        word=trial.word[:1],
        outcome=Outcome.INFEASIBLE,
    )
    save_figure(draw_trial(start), tmp_path / "start.png")
    assert save_animation(start, tmp_path / "start.gif") == 1


@pytest.mark.parametrize(
    ("environment", "shown"),
    [
        ("firefighting/test", "firefighting/test, world 3"),
        ("map:/some/where/lab.yaml,places=a/b.yaml,resolution=0.3/validation", "map:lab.yaml/validation, world 3"),
        ("map:lab.yaml/validation", "map:lab.yaml/validation, world 3"),
        ("floorplan:/some/where/school.xml,resolution=0.4/test", "floorplan:school.xml/test, world 3"),
        ("floorplan:plans/schools//test", "floorplan:schools/test, world 3"),
    ],
)
def test_heading_names_the_environment_briefly(trial, environment, shown):
    assert describe_outcome(dataclasses.replace(trial, environment=environment)).startswith(
        f"{shown}  ·  policy oracle"
    )


def test_a_world_from_python_has_a_heading_too(trial):
    nameless = dataclasses.replace(trial, environment="", world_number=None)
    assert describe_outcome(nameless).startswith("no named environment  ·  policy oracle")


def test_side_by_side_shows_each_path_under_its_cost_and_wastes_no_room(trial, tmp_path):
    short = dataclasses.replace(trial, policy="potlp", cost=11.5, path=trial.path[:8], states=trial.states[:8])
    figure = draw_side_by_side([trial, short], ["the baseline", "PO-TLP"])
    texts = [text.get_text() for text in figure.texts]
    assert "the baseline: cost 21.2, satisfied" in texts
    assert "PO-TLP: cost 11.5, satisfied" in texts
    assert trial.task_text in texts
    lengths = [
        len(artist.get_segments())
        for axes in figure.axes
        for artist in axes.collections
        if isinstance(artist, LineCollection)
    ]
    assert lengths == [len(trial.path) - 1, 7]
    save_figure(figure, tmp_path / "both.png")
    shown = [*figure.texts, *(text for legend in figure.legends for text in legend.get_texts())]
    assert not _overlaps(figure, shown)
    ink = np.any(np.asarray(Image.open(tmp_path / "both.png").convert("RGB")) != 255, axis=-1)
    # No margin is wider than a third of an inch, and no blank strip between the maps is.
    rows, columns = np.flatnonzero(ink.any(axis=1)), np.flatnonzero(ink.any(axis=0))
    gaps = [rows[0], ink.shape[0] - rows[-1], columns[0], ink.shape[1] - columns[-1]]
    gaps += [np.diff(rows).max(), np.diff(columns).max()]
    assert max(gaps) < figure.dpi / 3


def test_only_trials_of_one_world_and_task_are_drawn_side_by_side(trial):
    other = dataclasses.replace(trial, task_hoa=Task.shipped("toy-1").to_hoa())
    with pytest.raises(PictureError, match="same world and task"):
        draw_side_by_side([trial, other])


def test_raster_colours_cells_by_what_is_known():
    occupied = np.ones((5, 6), bool)
    occupied[1:4, 1:5] = False
    letters = np.zeros((5, 6), np.int32)
    letters[2, 2], letters[2, 3] = 1, 3
    seen = np.zeros((5, 6), bool)
    seen[:, :4] = True
    image = cell_image(
        make_world(occupied, letters, (1, 1), propositions=PROPOSITIONS), seen, PROPOSITIONS, hatch=False, pixels=60
    )
    assert image.shape == (50, 60, 3)

    def cell(row, column):
        pixels = image[10 * row : 10 * row + 10, 10 * column : 10 * column + 10].reshape(-1, 3)
        return {tuple(pixel) for pixel in pixels.tolist()}

    assert cell(0, 0) == {rgb(WALL_SEEN)}
    assert cell(1, 1) == {rgb(FREE_SEEN)}
    assert cell(1, 4) == {rgb(FREE_UNSEEN)}
    assert cell(0, 5) == {rgb(WALL_UNSEEN)}
    assert cell(2, 2) == {rgb(area_colour(0))}
    assert cell(2, 3) == {rgb(area_colour(0)), rgb(area_colour(1))}


def test_padding_is_not_drawn(trial):
    seen = np.pad(trial.first_seen != NEVER_SEEN, ((0, 20), (0, 30)))
    padded = pad_world(trial.world, HEIGHT + 20, WIDTH + 30)
    np.testing.assert_array_equal(
        cell_image(padded, seen, PROPOSITIONS, hatch=True),
        cell_image(trial.world, trial.first_seen != NEVER_SEEN, PROPOSITIONS, hatch=True),
    )


def test_way_back_does_not_hide_the_way_out(trial):
    path = trial.path[:10] + trial.path[8::-1]
    states = tuple([0] * 10 + [1] * 9)
    back = dataclasses.replace(trial, path=path, states=states, word=states, decisions=())
    (lines,) = (artist for artist in draw_trial(back).axes[0].collections if isinstance(artist, LineCollection))
    segments = np.array(lines.get_segments())
    out, home = segments[4, 0], segments[14, 0]
    assert out[0] == pytest.approx(home[0])
    assert out[1] > 6 > home[1]
    assert {to_hex(colour) for colour in lines.get_colors()} == {state_colour(0).lower(), state_colour(1).lower()}


@settings(max_examples=25, deadline=None)
@given(
    cells=st.sets(st.tuples(st.integers(1, 28), st.integers(1, 58)), min_size=1, max_size=12), seed=st.integers(0, 99)
)
def test_area_labels_stay_apart_and_inside(cells, seed):
    letters = np.zeros((30, 60), np.int32)
    generator = np.random.default_rng(seed)
    for cell in cells:
        letters[cell] = generator.integers(1, 4)
    occupied = np.ones((30, 60), bool)
    occupied[1:-1, 1:-1] = False
    world = make_world(occupied, letters, (1, 1), propositions=PROPOSITIONS)
    labels = place_labels(world, PROPOSITIONS, [(1, 1)], inches_per_cell=0.15)
    assert labels
    for label in labels:
        assert np.all(np.subtract(label.centre, label.half_size) >= -0.5)
        assert np.all(np.add(label.centre, label.half_size) <= (59.5, 29.5))
        column, row = label.anchor
        assert letters[int(row), int(column)] > 0
    for one, other in itertools.combinations(labels, 2):
        assert np.any(np.abs(np.subtract(one.centre, other.centre)) >= np.add(one.half_size, other.half_size))


def test_animation_has_a_frame_per_decision_and_one_for_the_end(trial, tmp_path):
    seen = []
    frames = save_animation(trial, tmp_path / "trial.gif", progress=lambda done, total: seen.append((done, total)))
    assert frames == len(trial.decisions) + 1
    assert seen == [(count + 1, frames) for count in range(frames)]
    animation = Image.open(tmp_path / "trial.gif")
    pictures = [frame.convert("RGB") for frame in ImageSequence.Iterator(animation)]
    assert len(pictures) == frames
    arrays = [np.asarray(picture) for picture in pictures]
    assert all(np.any(first != second) for first, second in itertools.pairwise(arrays))
    # What was not seen gets less, and the palette keeps the colours.
    unseen = [int(np.all(array == rgb(FREE_UNSEEN), axis=-1).sum()) for array in arrays]
    assert unseen[0] > 2 * unseen[-1]
    assert {rgb(state_colour(0)), rgb(CHOSEN), rgb(WALL_SEEN)} <= _colours(pictures[1])
    assert (tmp_path / "trial.gif").stat().st_size < 3_000_000


def test_an_unseen_area_has_its_own_colour_in_an_animation(trial, tmp_path):
    """Even the smallest one: with the palette's nearest colour it would be taken for another proposition's."""
    names = (*trial.propositions, *(f"p{bit}" for bit in range(2, len(AREA_COLOURS))))
    letters = np.zeros((HEIGHT, WIDTH), np.int32)
    # Far from the names' boxes, which would cover cells that touch each other.
    places = [(2 + 3 * (bit // 4), 14 + 3 * (bit % 4)) for bit in range(len(names))]
    for bit, cell in enumerate(places):
        letters[cell] = 1 << bit
    world = make_world(np.asarray(trial.world.occupied), letters, (6, 2), propositions=names)
    unseen = np.full((HEIGHT, WIDTH), NEVER_SEEN, np.int32)
    save_animation(
        dataclasses.replace(trial, world=world, propositions=names, first_seen=unseen), tmp_path / "trial.gif"
    )
    with Image.open(tmp_path / "trial.gif") as animation:
        shown = _colours(animation)
    areas = np.array([rgb(colour) for colour in AREA_COLOURS], np.uint8)
    assert {tuple(colour) for colour in faded(areas).tolist()} <= shown


def test_animation_is_thinned_out_evenly(trial):
    many = dataclasses.replace(trial, decisions=tuple(_decision(index, 0, (6, 2)) for index in range(101)))
    kept = frame_steps(many, 11)
    assert kept[-1] is None
    assert [decision.index for decision in kept if decision is not None] == [0, 11, 22, 33, 44, 56, 67, 78, 89, 100]


def test_animation_that_is_too_large_loses_frames(trial, tmp_path):
    whole = save_animation(trial, tmp_path / "whole.gif")
    size = (tmp_path / "whole.gif").stat().st_size
    assert save_animation(trial, tmp_path / "less.gif", max_bytes=size - 1) < whole
    assert (tmp_path / "less.gif").stat().st_size < size


@pytest.mark.parametrize("name", ["toy-2", "firefighting-1", "firefighting-2", "firefighting-3", "firefighting-4"])
def test_automaton_is_complete_and_its_texts_stay_apart(name, tmp_path):
    task = Task.shipped(name)
    figure = draw_automaton(task)
    path = tmp_path / "task.svg"
    save_figure(figure, path)
    root = ElementTree.parse(path).getroot()
    shown = ["".join(node.itertext()).strip() for node in root.iter("{http://www.w3.org/2000/svg}text")]
    described = task.describe()
    joined = " ".join(" ".join(shown).split())
    for move in described["transitions"]:
        if move["from"] not in described["trap"]:
            assert all(cube in joined for cube in move["guard"].split(" | "))
            assert transition_words(task, move["from"], move["to"], brief=True) in joined or move["from"] == move["to"]
    assert all(str(state) in shown for state in range(task.dfa.num_states))
    assert ("failed" in shown) == bool(described["trap"])
    assert not _overlaps(figure, [*figure.axes[0].texts, *figure.texts])


@pytest.mark.parametrize("name", ["firefighting-3", "delivery-1"])
def test_automata_in_dot_and_mermaid_have_every_state_and_transition(name, tmp_path):
    task = Task.shipped(name)
    moves = [move for move in task.describe()["transitions"] if not task.dfa.trap[move["from"]]]
    dot, mermaid = to_dot(task), to_mermaid(task)
    for move in moves:
        assert f'  {move["from"]} -> {move["to"]} [label="' in dot
        assert any(
            line.startswith(f"  s{move['from']} -") and line.endswith(f"| s{move['to']}")
            for line in mermaid.splitlines()
        )
    assert dot.count(" -> ") == len(moves) + 1
    assert dot.count("doublecircle") == int(task.dfa.accepting.sum())
    assert mermaid.count("(((") == int(task.dfa.accepting.sum())
    for ending, text in (("dot", dot), ("mmd", mermaid)):
        save_automaton(task, tmp_path / f"task.{ending}")
        assert (tmp_path / f"task.{ending}").read_text() == text


def test_no_name_is_markup_of_mermaid():
    text = to_mermaid(Task.from_formula('F "a<b>#1"', propositions=("a<b>#1",)))
    assert "a#lt;b#gt;#35;1" in text
    assert not re.search(r"a<b|#1\b(?!24)", text)


def test_pictures_are_reproducible(tmp_path):
    for ending in ("svg", "pdf", "png"):
        for name in ("a", "b"):
            save_automaton(Task.shipped("toy-2"), tmp_path / f"{name}.{ending}")
        assert (tmp_path / f"a.{ending}").read_bytes() == (tmp_path / f"b.{ending}").read_bytes()


def test_automaton_with_one_state():
    with pytest.warns(TaskWarning):
        task = Task.from_formula("true")
    assert task.dfa.num_states == 1
    assert "true" in [text.get_text() for text in draw_automaton(task).axes[0].texts]


def test_automaton_with_a_state_that_has_failed():
    texts = [text.get_text() for text in draw_automaton(Task.shipped("toy-2")).axes[0].texts]
    assert "failed" in texts


def test_unknown_kind_of_picture_is_refused(tmp_path):
    with pytest.raises(PictureError, match="docx"):
        save_figure(new_figure(1.0, 1.0), tmp_path / "picture.docx")
    assert not list(tmp_path.iterdir())


def test_action_table_marks_the_choice(trial):
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(action_table(trial, trial.decisions[1]))
    text = console.export_text()
    for name, meaning in FIGURES.items():
        assert f"{name}: {meaning}" in " ".join(text.split())
    lines = [line.split() for line in text.splitlines()]
    chosen = next(line for line in lines if line[:1] == ["*"])
    assert chosen == ["*", "s0:", "find", "goal", "0→1", "6,12", "0.250", "12.5", "7.0", "10.0", "31.4", "40"]
    assert ["finish", "-", "-", "0.250", "12.5", "7.0", "10.0", "55.0", "40"] in lines


@pytest.mark.parametrize("width", [80, 60, 40])
def test_no_terminal_is_too_narrow_for_a_number(trial, width):
    console = Console(width=width, record=True, file=io.StringIO())
    actions = tuple(
        _action(index, 1234.5, subgoal=index, success_cost=1000.25, failure_cost=999.75, visits=20_000)
        for index in range(3)
    )
    print_table(console, action_table(trial, dataclasses.replace(trial.decisions[1], actions=actions)))
    text = console.export_text()
    assert "…" not in text
    assert max(map(len, text.splitlines())) <= max(width, 80)
    rows = [line.split() for line in text.splitlines() if "0→1" in line]
    assert [row[-6:] for row in rows] == [["0.250", "1000.2", "999.8", "10.0", "1234.5", "20000"]] * 3
    assert all("s" + str(index) + ":" in row for index, row in enumerate(rows))


def test_actions_that_would_read_the_same_are_told_apart(trial):
    """Two states that ask for the same thing, or names of which the end is cut off."""

    def named(task, *moves, **others):
        actions = [
            dataclasses.replace(_action(index, 5.0, subgoal), from_state=start, to_state=end)
            for index, (subgoal, start, end) in enumerate(moves)
        ]
        return [*action_names(dataclasses.replace(trial.decisions[0], actions=tuple(actions)), task, **others).values()]

    assert named(task_of(trial), (0, 0, 1), (1, 0, 1)) == ["s0: find goal", "s1: find goal"]
    both = task_of(_long_names(trial))
    goal = [
        (move["from"], move["to"])
        for move in both.describe()["transitions"]
        if transition_words(both, move["from"], move["to"], brief=True) == f"find {both.propositions[0]}"
    ]
    assert len(goal) == 2
    assert len({*named(both, *((0, *move) for move in goal))}) == 2
    cut = named(both, (0, 0, 1), (0, 0, 2), letters=30)
    assert [len(name) for name in cut] == [30, 30]
    assert [name[:15] + name[-5:] for name in cut] == ["s0: find propos(0→1)", "s0: find propos(0→2)"]


def test_a_decision_without_actions_says_why(trial):
    empty = dataclasses.replace(trial.decisions[0], actions=(), choice=None, preferred=None, kind="fallback")
    invalid = dataclasses.replace(empty, status=int(Status.INVALID | Status.FALLBACK))
    assert "was not allowed" in why_no_actions(trial, invalid)
    assert "the inputs were invalid, nothing was planned: go to the nearest" in describe_move(trial, invalid)
    dead_end = dataclasses.replace(empty, status=int(Status.DEAD_END | Status.FALLBACK))
    assert "no action was available" in why_no_actions(trial, dead_end)
    assert describe_move(trial, dead_end).startswith("no action is available: go to the nearest")
    direct = dataclasses.replace(empty, status=0, kind="frontier")
    assert why_no_actions(trial, direct) == f"policy {trial.policy} does not search: it weighed no actions"


def test_decision_as_json_is_ranked_and_finite(trial):
    actions = (_action(0, float("inf")), _action(1, 9.0), _action(2, 3.0))
    decision = dataclasses.replace(trial.decisions[0], actions=actions, choice=2)
    data = json.loads(json.dumps(decision_to_dict(decision), allow_nan=False))
    assert [action["index"] for action in data["actions"]] == [2, 1, 0]
    assert data["actions"][-1]["q_value"] is None
    assert data["choice"] == 2


def test_chosen_action_leads_among_equals(trial):
    decision = dataclasses.replace(trial.decisions[0], actions=(_action(0, 5.0), _action(1, 5.0)), choice=1)
    assert [action.index for action in rank_actions(decision)] == [1, 0]


def test_a_decision_that_keeps_on_says_what_was_better(trial):
    actions = (_action(0, 9.0), _action(1, 8.5, subgoal=1))
    keeping = dataclasses.replace(trial.decisions[0], actions=actions, choice=0, preferred=1)
    turning = dataclasses.replace(keeping, choice=1)
    assert keeping.overruled == actions[1]
    assert describe_decision(trial, keeping).endswith(
        f"kept although {action_name(actions[1], task_of(trial))} is better"
    )
    # Another choice than the cheapest is none that was kept: the mode of the authors takes the most visited action.
    for other in (turning, dataclasses.replace(keeping, preferred=0), dataclasses.replace(keeping, preferred=None)):
        assert other.overruled is None
        assert "kept" not in describe_decision(trial, other)


def _tree_node(actions=(), value=7.0, **others):
    flags = {"accepting": False, "dead_end": False} | others
    return {"location": None, "state": 0, "value": value, "visits": 100, "actions": list(actions), **flags}


def _tree_action(subgoal, q_value, visits, success=None, failure=None):
    ends = (None, None) if subgoal is None else (0, 1)
    return {
        "index": 0,
        "subgoal": subgoal,
        "from_state": ends[0],
        "to_state": ends[1],
        "q_value": q_value,
        "visits": visits,
        "distance": 4.0,
        "success": success,
        "failure": failure,
    }


def _tree_outcome(probability, node, value=3.0):
    return {"probability": probability, "cost": 2.5, "value": value, "node": node}


def test_tree_shows_outcomes_and_follows_the_best_action():
    done = _tree_outcome(1.0, _tree_node(accepting=True), 0.0)
    after_success = _tree_node([_tree_action(None, 3.0, 30, success=done)])
    other = _tree_node([_tree_action(9, 1.0, 5, success=done)])
    tree = _tree_node(
        [
            _tree_action(0, 7.0, 40, _tree_outcome(0.75, after_success), _tree_outcome(0.25, None, None)),
            _tree_action(1, 8.0, 30, _tree_outcome(0.5, other), _tree_outcome(0.5, _tree_node(dead_end=True))),
            _tree_action(2, float("inf"), 0, _tree_outcome(1.0, None, None)),
        ]
    )
    figure = draw_tree(tree, Task.shipped("toy-2"), "a decision", breadth=2)
    shown = [text.get_text() for text in figure.axes[0].texts]
    assert "robot in state 0\nexpected cost 7.0\nn 100" in shown
    assert "s0 succeeds  P 0.75\nfind goal\nQ 7.0  n 40  D 4.0\nR 2.5, then 3.0" in shown
    assert "s0 fails  P 0.25\nfind goal\nQ 7.0  n 40  D 4.0\nR 2.5, then not tried" in shown
    assert "finish\nin known space\nQ 3.0  n 30  D 4.0\nR 2.5, then done" in shown
    assert "s1 fails  P 0.50\nfind goal\nQ 8.0  n 30  D 4.0\nR 2.5, then a dead end" in shown
    assert not any(text.startswith(("s2", "s9")) for text in shown)
    styles = [line.get_linestyle() for line in figure.axes[0].lines]
    assert sorted(styles) == ["-", "-", "-", "--", "--"]
    assert not _overlaps(figure, figure.axes[0].texts)


def _row(policy, world, cost, outcome="satisfied"):
    return Row(
        item=Item("toy", "F goal", policy, world),
        **{"outcome": outcome, "cost": cost, "budget": 480.0, "steps": 9, "decisions": 3, "fallbacks": 0, "status": 0},
        **{
            "key": (0, 1),
            "path": "",
            "configuration": "",
            "versions": {},
            "commit": "",
            "seconds": 1.0,
            "world_digest": "",
        },
    )


def test_scatter_places_worlds_and_marks_failures():
    pairs = [
        {
            "known-map": _row("known-map", 0, 5.0),
            "baseline": _row("baseline", 0, 10.0),
            "oracle": _row("oracle", 0, 6.0),
        },
        {
            "known-map": _row("known-map", 1, 8.0),
            "baseline": _row("baseline", 1, 8.0),
            "oracle": _row("oracle", 1, 30.0, "stuck"),
        },
    ]
    figure = draw_scatter(pairs, list(pairs[0]), "a comparison")
    points = {
        str(artist.get_label()): np.asarray(artist.get_offsets()).tolist()
        for artist in figure.axes[0].collections
        if isinstance(artist, PathCollection)
    }
    assert points["oracle (1 worlds)"] == [[10.0, 6.0]]
    assert points["known-map (2 worlds)"] == [[10.0, 5.0], [8.0, 8.0]]
    assert [[8.0, 30.0]] in points.values()
    assert "not satisfied" in points


def test_comparison_tables():
    def rows(*costs, outcome="satisfied", status=0):
        return [TrialResult(cost, outcome, 100.0, status) for cost in costs]

    comparison = Comparison.from_results(
        {
            "known-map": rows(10.0, 10.0, 10.0, 10.0),
            "baseline": rows(20.0, 20.0, 20.0, 20.0),
            "oracle": [*rows(12.0, 12.0), *rows(50.0, outcome="stuck"), *rows(30.0, status=2)],
        },
        resamples=50,
    )
    console = Console(width=110, record=True, file=io.StringIO())
    console.print(comparison_table(comparison))
    lines = [line.split() for line in console.export_text().splitlines()]
    # The stuck trial is charged its budget of 100: (60 - 124) / (60 - 30) of what could be saved.
    # The one whose tree was full counts nowhere.
    figures = ["3", "of", "4", "12.0", "80.0%", "80.0", "..", "80.0%", "40.0%", "40.0", "±", "0.0%", "-213.3%"]
    assert ["oracle", *figures] in lines
    narrow = Console(width=40, record=True, file=io.StringIO())
    print_table(narrow, comparison_table(comparison))
    text = narrow.export_text()
    assert "…" not in text
    assert ["oracle", *figures] in [line.split() for line in text.splitlines()]
    remarks = remark_lines(comparison)
    assert remarks[0].startswith("Costs and savings are of the 2 worlds")
    assert "oracle: 1 stuck" in remarks
    assert "Worlds with a trial that counts in no mean, left out of all tables: 1." in remarks
    assert "oracle: trials with tree overflow: 1 (left out of costs and savings)" in remarks
    # The bootstrap of two worlds is none.
    known = [not np.isnan(row.attainable_low) for row in comparison.satisfied.rows]
    assert ("interval says" in remarks[-1]) == any(known)
    assert remarks[-1].startswith("2 worlds are few")


def test_few_worlds_without_an_interval_promise_none():
    rows = {
        policy: [TrialResult(cost, "satisfied", 100.0, 0)] for policy, cost in (("known-map", 9.0), ("baseline", 20.0))
    }
    comparison = Comparison.from_results(rows, resamples=50)
    assert all(np.isnan(row.attainable_low) for row in comparison.satisfied.rows)
    assert remark_lines(comparison)[-1] == "1 worlds are few: they tell no interval."
