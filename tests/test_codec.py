"""Configurations from mappings, differences of nested values, and JSON of numbers that are not finite."""

import dataclasses
import enum
import json
import math
from typing import Literal

import pytest

from potlp_jax.codec import (
    config_from_dict,
    differences,
    finite_or_null,
    finite_or_text,
    json_copy,
    settings_from_words,
    with_settings,
)
from potlp_jax.errors import ConfigurationError
from potlp_jax.trials.config import TrialConfig


class Colour(enum.Enum):
    RED = "red"
    GREEN = "green"


@dataclasses.dataclass(frozen=True)
class Circle:
    radius: float = 1.0
    kind: Literal["circle"] = "circle"

    def __post_init__(self):
        if self.radius < 0:
            raise ValueError(f"radius is {self.radius}, must be at least 0")


@dataclasses.dataclass(frozen=True)
class Polygon:
    corners: tuple[tuple[int, int], ...] = ()
    kind: Literal["polygon"] = "polygon"


@dataclasses.dataclass(frozen=True)
class Drawing:
    shape: Circle | Polygon = Circle(2.0)
    others: tuple[Circle, ...] = ()
    colour: Colour = Colour.RED
    width: int | None = None
    height: int | float = 1
    filled: bool = False
    limit: float = math.inf


POLYGON = Drawing(shape=Polygon(((1, 2), (3, 4))), colour=Colour.GREEN, width=3, height=1.5)


@pytest.mark.parametrize("config", [Drawing(), POLYGON, TrialConfig()])
def test_a_configuration_comes_back_from_json(config):
    assert config_from_dict(type(config), json.loads(json.dumps(json_copy(dataclasses.asdict(config)))), "x") == config


def test_settings_change_what_they_name_at_every_depth():
    assert with_settings(Drawing(), {}) == Drawing()
    assert with_settings(Drawing(), {"width": 3, "shape": {"radius": 5}}) == Drawing(shape=Circle(5.0), width=3)
    assert with_settings(POLYGON, {"width": None, "colour": Colour.RED}).width is None


def test_settings_of_another_kind_start_from_its_defaults():
    assert with_settings(POLYGON, {"shape": {"kind": "circle"}}).shape == Circle()
    assert with_settings(Drawing(), {"shape": {"kind": "polygon", "corners": [[1, 2]]}}).shape == Polygon(((1, 2),))
    assert with_settings(POLYGON, {"shape": "circle"}).shape == Circle()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"widht": 3}, "here: unknown field 'widht'; known: shape, others, colour, width, height, filled, limit"),
        ({"others": [{"radius": 1}, {"raduis": 2}]}, "here.others.1: unknown field 'raduis'; known: radius, kind"),
        ({"width": "3"}, 'here.width: give a whole number or null, found "3"'),
        ({"width": True}, "here.width: give a whole number or null, found true"),
        ({"width": 1.5}, "here.width: give a whole number or null, found 1.5"),
        ({"height": "tall"}, 'here.height: give a whole number or a number, found "tall"'),
        ({"filled": 1}, "here.filled: give true or false, found 1"),
        ({"colour": "blue"}, "here.colour: give 'red' or 'green', found \"blue\""),
        ({"shape": 7}, "here.shape: give a mapping, found 7"),
        ({"shape": {"radius": "big"}}, 'here.shape.radius: give a number, found "big"'),
        ({"shape": {"radius": -1}}, "here.shape: radius is -1.0, must be at least 0"),
        ({"shape": {"corners": []}}, "here.shape: unknown field 'corners'; known: radius, kind"),
        ({"shape": {"kind": "blob"}}, "here.shape.kind: give 'circle' or 'polygon', found \"blob\""),
        ({"shape": {"kind": "polygon", "corners": 3}}, "here.shape.corners: give a list, found 3"),
        (
            {"shape": {"kind": "polygon", "corners": [[1, "x"]]}},
            'here.shape.corners.0.1: give a whole number, found "x"',
        ),
        ([1], "here: give a mapping, found [1]"),
    ],
)
def test_what_is_wrong_is_named_in_one_line(settings, message):
    with pytest.raises(ConfigurationError) as raised:
        with_settings(Drawing(), settings, "here")
    assert str(raised.value) == message


def test_what_was_stored_must_be_whole():
    data = dataclasses.asdict(Drawing())
    del data["shape"]["radius"]
    with pytest.raises(ConfigurationError, match=r"file: shape\.radius is missing"):
        config_from_dict(Drawing, data, "file")


def test_differences_are_named_with_both_values():
    before = {"seed": 1, "camera": {"rows": 2, "far": 3.0}, "same": [1]}
    now = {"seed": 2, "camera": {"rows": 2, "far": 4.0, "fold": 1}, "same": [1]}
    assert differences(before, now) == [
        "camera.far was 3.0, is 4.0",
        "camera.fold was null, is 1",
        "seed was 1, is 2",
    ]
    assert differences(before, before) == []
    assert differences([1], [1, 2], "policies") == ["policies was [1], is [1, 2]"]
    assert len(differences("x" * 1000, "", "text")[0]) < 120


def test_a_number_that_is_none_does_not_differ_from_itself():
    assert differences({"a": math.nan}, {"a": float("nan")}) == []
    assert differences({"a": math.nan}, {"a": 1.0}) == ["a was NaN, is 1.0"]


def test_numbers_that_are_not_finite_have_a_form_in_json():
    values = {"cost": math.inf, "list": (1.0, -math.inf, math.nan), "text": "inf", "count": 3}
    text = finite_or_text(values)
    assert json.loads(json.dumps(text, allow_nan=False)) == text
    assert float(text["cost"]) == math.inf
    assert [float(value) for value in text["list"][:2]] == [1.0, -math.inf]
    assert finite_or_null(values) == {"cost": None, "list": [1.0, None, None], "text": "inf", "count": 3}


def test_settings_are_read_from_words():
    words = ["width=3", "shape.kind=polygon", "shape.corners=[[1, 2]]", "colour=green"]
    assert settings_from_words(words) == {
        "width": 3,
        "shape": {"kind": "polygon", "corners": [[1, 2]]},
        "colour": "green",
    }
    assert with_settings(Drawing(), settings_from_words(words)) == Drawing(
        shape=Polygon(((1, 2),)), colour=Colour.GREEN, width=3
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["width"], "'width': write name=value"),
        (["=3"], "'=3': write name=value"),
        (["width=["], "no value as in YAML"),
        (["shape=3", "shape.radius=2"], "shape has got a value already"),
        (["shape.radius=2", "shape={width: 3}"], "'shape={width: 3}': shape is set already; give it once"),
        (["width=1", "width=2"], "'width=2': width is set already; give it once"),
    ],
)
def test_words_that_are_no_settings_are_named(words, message):
    with pytest.raises(ConfigurationError, match=message):
        settings_from_words(words)
