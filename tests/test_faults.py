"""Bad files end in one clear line, soon: a few damaged inputs of every kind. ``python -m eval.faults`` makes more."""

import functools
import io
import os
import sqlite3
import struct
import zipfile
import zlib
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from eval.faults import (
    GOOD,
    LONGEST_MESSAGE,
    Kind,
    LostRowsError,
    Verdict,
    WrongAnswerError,
    files,
    options,
    seeds,
    texts,
)
from eval.faults.mutations import damaged, damaged_text
from eval.faults.page import PAGE, page, write_page
from eval.faults.tally import TALLY, Row, Tally, open_tally, read_tally, table
from eval.faults.worker import Ending, _Clock, judged
from eval.provenance import RESULTS
from potlp_jax.codec import read_settings, settings_from_words
from potlp_jax.environments.campus.floor_plan_xml import read_plan
from potlp_jax.environments.ros.map_settings import load_settings, parse_number
from potlp_jax.environments.ros.occupancy_map import load_map
from potlp_jax.environments.ros.places import load_places
from potlp_jax.errors import CheckpointError, ConfigurationError, LogError, MapError, PotlpError, TaskError
from potlp_jax.files import (
    one_line,
    parse_yaml,
    read_bytes,
    read_json,
    read_npz,
    read_text,
    read_yaml,
    reading,
    require_mapping,
    short,
)
from potlp_jax.images import MOST_PIXELS, decode_image
from potlp_jax.logs.bag import open_bag
from potlp_jax.logs.log import Log
from potlp_jax.task.task import Task

AUTOMATON = Task.shipped("firefighting-1").to_hoa()


# The mechanism (``potlp_jax.files``).


@pytest.mark.parametrize(
    "cause", [ValueError("a\nb"), RecursionError(), MemoryError(), KeyError("x"), struct.error("y")]
)
def test_whatever_a_parser_raises_is_one_line_that_names_the_file(cause):
    with pytest.raises(MapError, match=r"^plan\.xml: is not a plan") as caught, reading("plan.xml", MapError, "a plan"):
        raise cause
    assert "\n" not in str(caught.value)
    assert caught.value.__cause__ is cause


def test_errors_of_the_reader_itself_pass_through():
    with pytest.raises(TaskError, match=r"^mine$"), reading("x", MapError, "a plan"):
        raise TaskError("mine")


def test_messages_hold_neither_control_characters_nor_a_million_of_any():
    assert one_line("a\x1b[2Jb\u202e") == "a\\x1b[2Jb\\u202e"
    assert len(one_line("x" * 10**6)) == 200
    deep: list = []
    for _ in range(100_000):
        deep = [deep]
    assert len(short(deep)) <= 80
    assert short(1 << 100_000) == "a int"


def test_only_regular_files_are_read_and_soon(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for path, why in (
        (tmp_path, "is a folder; give a file"),
        (tmp_path / "pipe", "is a device or pipe; give a file"),
        ("/dev/zero", "is a device or pipe; give a file"),
        (tmp_path / "none", "No such file"),
        (tmp_path / "loop", "symbolic links"),
        (tmp_path / ("x" * 5000), "File name too long"),
        ("a\x00b", "null (byte|character)"),
    ):
        with pytest.raises(MapError, match=why):
            read_bytes(path, MapError, 100)


def test_files_that_are_too_large_are_refused_before_they_are_read(tmp_path):
    with (tmp_path / "large").open("wb") as stream:
        stream.truncate(1 << 40)
    with pytest.raises(MapError, match=r"has 1,099,511,627,776 bytes; at most 4,194,304 are read"):
        read_text(tmp_path / "large", MapError)
    # A file of /proc says that it has no bytes.
    with pytest.raises(MapError, match="has more than 3 bytes"):
        read_bytes("/proc/self/status", MapError, 3)


def test_texts_are_utf8(tmp_path):
    (tmp_path / "text").write_bytes(b"abc\xff")
    with pytest.raises(TaskError, match=r"text: is no text in UTF-8 \(byte 3\)"):
        read_text(tmp_path / "text", TaskError)


@pytest.mark.parametrize(
    "text", ["[" * 400 + "]" * 400, "- " * 400, "{a: " * 20_000, "&a [*a]", "*nothing", "a: &b [*b]"]
)
def test_yaml_that_is_deep_or_holds_itself_is_refused(text, tmp_path):
    (tmp_path / "x.yaml").write_text(text)
    with pytest.raises(ConfigurationError, match=r"x\.yaml: is not valid YAML"):
        read_yaml(tmp_path / "x.yaml", ConfigurationError)


def test_yaml_aliases_that_stand_for_billions_are_refused(tmp_path):
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, 12)]
    with pytest.raises(yaml.YAMLError, match="aliases written out"):
        parse_yaml("\n".join(lines))
    # A few are no harm.
    assert parse_yaml("a: &x [1, 2]\nb: *x") == {"a": [1, 2], "b": [1, 2]}


@pytest.mark.parametrize(
    "text", ["a: 2001-99-99", f"a: {'9' * 5000}", "? [a]\n: b", "a: !!float x", "a: !!python/name:os"]
)
def test_yaml_values_that_no_type_takes_are_refused(text, tmp_path):
    (tmp_path / "x.yaml").write_text(text)
    with pytest.raises(ConfigurationError, match=r"x\.yaml: is not"):
        read_yaml(tmp_path / "x.yaml", ConfigurationError)


@pytest.mark.parametrize("text", ["a: 1\na: 2", "b: [{a: 1, c: 2, a: 3}]", "? a\n: &x {a: 1}\n? a\n: *x"])
def test_a_key_that_is_given_twice_is_refused_in_every_file(text, tmp_path):
    (tmp_path / "x.yaml").write_text(text)
    with pytest.raises(ConfigurationError, match=r"x\.yaml: is not valid YAML: key 'a' is given twice, line \d"):
        read_yaml(tmp_path / "x.yaml", ConfigurationError)


@pytest.mark.parametrize("text", ["1: a", "a: {2001-01-01: b}", "on: a", f"a: [0x{'f' * 5000}]", "[a]", "a"])
def test_settings_hold_names_and_numbers_that_json_knows(text, tmp_path):
    (tmp_path / "x.yaml").write_text(text)
    with pytest.raises(ConfigurationError, match=r"x\.yaml: is not a file of settings"):
        read_settings(tmp_path / "x.yaml")


@pytest.mark.parametrize("word", ["a=2001-99-99", f"a={'9' * 5000}", "a={1: 2}", "a=" + "[" * 400])
def test_settings_in_words_are_refused_in_one_line(word):
    with pytest.raises(ConfigurationError, match="setting"):
        settings_from_words([word])


def test_json_that_is_deep_or_damaged_is_refused(tmp_path):
    for text in ("[" * 100_000, "{", "", "9" * 5000):
        (tmp_path / "x.json").write_text(text)
        with pytest.raises(MapError, match=r"x\.json: is not a record"):
            read_json(tmp_path / "x.json", MapError, "a record")


def test_an_archive_is_refused_by_what_it_would_unpack_to(tmp_path):
    with zipfile.ZipFile(tmp_path / "x.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", bytes(2_000_000))
    with pytest.raises(CheckpointError, match=r"would unpack to 2,000,000 bytes; at most 1,000,000 are read"):
        read_npz(tmp_path / "x.npz", CheckpointError, "an estimator", 1_000_000)


def test_an_array_that_promises_more_than_it_has_takes_no_memory(tmp_path):
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"shape": (1 << 40, 1 << 40), "fortran_order": False, "descr": "<f4"})
    with zipfile.ZipFile(tmp_path / "x.npz", "w") as archive:
        archive.writestr("a.npy", stream.getvalue() + bytes(64))
    with pytest.raises(CheckpointError, match="does not have 64 bytes"):
        read_npz(tmp_path / "x.npz", CheckpointError, "an estimator")


def test_arrays_are_read_as_numpy_reads_them(tmp_path):
    arrays = {"a": np.arange(6.0).reshape(2, 3), "b": np.asfortranarray(np.arange(6).reshape(2, 3)), "c": np.int8(3)}
    np.savez(tmp_path / "x.npz", **arrays)
    found = read_npz(tmp_path / "x.npz", CheckpointError, "arrays")
    assert found.keys() == arrays.keys()
    for name, array in arrays.items():
        assert found[name].dtype == np.asarray(array).dtype
        assert np.array_equal(found[name], array)


def test_require_mapping_names_what_is_wrong():
    assert require_mapping("x", {"a": [{"b": 1}]}, ConfigurationError, "settings") == {"a": [{"b": 1}]}
    with pytest.raises(ConfigurationError, match=r"^x: is not settings: name 3 is no text: put it in quotes"):
        require_mapping("x", {"a": [{3: 1}]}, ConfigurationError, "settings")


# Maps, places and plans.


def _map(tmp_path, contents: bytes, name: str = "map.pgm", **fields: str):
    (tmp_path / name).write_bytes(contents)
    lines = {
        "image": name,
        "resolution": "0.1",
        "origin": "[0, 0, 0]",
        "occupied_thresh": "0.65",
        "free_thresh": "0.196",
    }
    (tmp_path / "map.yaml").write_text("\n".join(f"{key}: {value}" for key, value in (lines | fields).items()))
    return tmp_path / "map.yaml"


def _claiming(kind: str, size: int) -> bytes:
    """An image whose header claims to be of this size, and which has few bytes."""
    contents = seeds.encoded(kind)
    if kind in ("pgm", "ascii"):
        return contents.replace(b"60 40", f"{size} {size}".encode())
    if kind == "png":
        head = contents[12:16] + struct.pack(">II", size, size) + contents[24:29]
        return contents[:12] + head + struct.pack(">I", zlib.crc32(head)) + contents[33:]
    return contents[:18] + struct.pack("<ii", size, size) + contents[26:]


@pytest.mark.parametrize("kind", ["pgm", "ascii", "png", "bmp"])
@pytest.mark.parametrize("size", [6_000, 30_000])
def test_images_are_refused_by_their_header(kind, size, tmp_path):
    with pytest.raises(MapError, match=rf"at most {MOST_PIXELS:,}|{MOST_PIXELS:,} pixels that are read at most"):
        load_map(_map(tmp_path, _claiming(kind, size)))


def test_a_png_with_one_flipped_bit_is_never_read_as_another_map():
    contents = seeds.encoded("png")
    for place in range(len(contents)):
        flipped = bytearray(contents)
        flipped[place] ^= 16
        try:
            pixels = decode_image(bytes(flipped), cv2.IMREAD_UNCHANGED)
        except Exception:
            continue
        assert np.array_equal(pixels, seeds.picture())


@pytest.mark.parametrize("kind", ["png", "jpg", "bmp", "pgm", "ascii"])
def test_images_that_are_cut_short_are_refused(kind, tmp_path):
    contents = seeds.encoded(kind)
    with pytest.raises(MapError, match=rf"map\.{kind}: is (not an image|cut short)"):
        load_map(_map(tmp_path, contents[: len(contents) * 2 // 3], f"map.{kind}"))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("resolution", "1e-400"),
        ("resolution", "1e400"),
        ("resolution", "9" * 5000),
        ("resolution", "0." + "1" * 5000),
        ("resolution", "1e-30"),
        ("origin", "[1e400, 0, 0]"),
        ("origin", "[1e308, 0, 0]"),
        ("origin", "[0, 0, -1e999]"),
        ("free_thresh", "1e-999999"),
        ("occupied_thresh", "٣"),
    ],
)
def test_numbers_beyond_any_building_are_refused_by_field(field, value, tmp_path):
    with pytest.raises(MapError, match=rf"map\.yaml: {field}: ") as caught:
        load_settings(_map(tmp_path, b"", **{field: value}))
    assert len(str(caught.value)) < 400 + len(str(tmp_path))


def test_numbers_are_exact_as_before(tmp_path):
    assert parse_number(tmp_path, "x", " 0.196 ") == Fraction(196, 1000)
    assert parse_number(tmp_path, "x", "-1.5E+3") == -1500


def test_an_image_that_is_no_file_is_refused_soon(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for image, why in (("pipe", "device or pipe"), (".", "is a folder"), ("/dev/zero", "device or pipe")):
        with pytest.raises(MapError, match=why):
            load_map(_map(tmp_path, b"", image=image))


@pytest.mark.parametrize("number", ["1e400", "1e308", "9" * 4400, "nan", "-.inf"])
def test_places_beyond_any_building_are_refused(number, tmp_path):
    (tmp_path / "p.yaml").write_text(f"propositions:\n  a: [{{point: [{number}, 0], radius: 1}}]\n")
    with pytest.raises(MapError, match=r"p\.yaml: propositions: a: point: "):
        load_places(tmp_path / "p.yaml")


@pytest.mark.parametrize("number", ["1e400", "1e308", "nan", "1e10"])
def test_plans_beyond_any_building_are_refused(number, tmp_path):
    (tmp_path / "plan.xml").write_text(seeds.floor_plan_xml().replace('x="100"', f'x="{number}"', 1))
    with pytest.raises(MapError, match=r"plan\.xml: space r0"):
        read_plan(tmp_path / "plan.xml")


def test_entities_of_entities_are_refused(tmp_path):
    entities = "".join(f'<!ENTITY e{n + 1} "{f"&e{n};" * 10}">' for n in range(12))
    text = f'<!DOCTYPE b [<!ENTITY e0 "xxxxxxxxxx">{entities}]><building>&e11;</building>'
    (tmp_path / "plan.xml").write_text(text)
    with pytest.raises(MapError, match=r"plan\.xml: declares entities, which are not read"):
        read_plan(tmp_path / "plan.xml")


# Tasks.


@pytest.mark.parametrize(
    ("label", "why"),
    [
        ("(" * 20_000 + "0" + ")" * 20_000, "more than 30 parentheses"),
        ("9" * 5000, "too large a number"),
        ("0 & " * 50, "is not a label"),
    ],
)
def test_labels_that_are_deep_or_long_are_refused_with_their_line(label, why):
    line = next(line for line in AUTOMATON.splitlines() if line.startswith("["))
    with pytest.raises(TaskError, match=rf"HOA line \d+: .*{why}") as caught:
        Task.from_hoa(AUTOMATON.replace(line, f"[{label}] 0", 1))
    assert len(str(caught.value)) < LONGEST_MESSAGE


def test_two_thousand_negations_are_read():
    assert np.array_equal(
        Task.from_hoa(AUTOMATON.replace("[", "[" + "!" * 2000 + "(").replace("]", ")]")).dfa.transitions,
        Task.from_hoa(AUTOMATON).dfa.transitions,
    )


@pytest.mark.parametrize("number", ["9" * 10, "9" * 5000, "999999999"])
def test_states_that_no_automaton_has_are_refused(number):
    with pytest.raises(TaskError, match=r"HOA line \d+"):
        Task.from_hoa(AUTOMATON.replace("States: ", f"States: {number} /*").replace("\nStart", "*/\nStart"))


def test_an_automaton_of_gigabytes_is_refused():
    names = " ".join(f'"p{i}"' for i in range(16))
    states = "\n".join(f"State: {i}\n[t] {i}" for i in range(200))
    text = f"HOA: v1\nStates: 200\nStart: 0\nAP: 16 {names}\nAcceptance: 0 t\n--BODY--\n{states}\n--END--\n"
    with pytest.raises(TaskError, match="more than 4,194,304 entries, states times letters"):
        Task.from_hoa(text)


# Logs.


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    made = {}
    for kind in ("ros1", "ros2", "mcap"):
        folder = tmp_path_factory.mktemp(kind)
        seeds.make_bag(folder, kind)
        made[kind] = seeds.read_tree(folder)
    return made


@pytest.mark.parametrize("kind", ["ros1", "ros2", "mcap"])
def test_what_the_first_pass_over_a_damaged_bag_tolerates_every_pass_does(kind, bags, tmp_path):
    random = np.random.default_rng(11)
    name = max(bags[kind], key=lambda name: len(bags[kind][name]))
    path = tmp_path / ("drive.bag" if kind == "ros1" else "drive")
    for _ in range(12):
        seeds.write_tree({**bags[kind], name: damaged(random, bags[kind][name])}, tmp_path)
        try:
            bag = open_bag(path)
        except LogError:
            continue
        # As many messages as were counted, in the second pass and in the third.
        for _ in range(2):
            assert len(list(bag.messages(bag.topics))) == sum(map(len, bag.times.values()))


@pytest.mark.parametrize("sql", ["timestamp = 'x'", "timestamp = -5", "data = 'text'", "topic_id = 99"])
def test_values_that_no_bag_holds_end_the_reading_and_not_the_program(sql, bags, tmp_path):
    seeds.write_tree(bags["ros2"], tmp_path)
    with sqlite3.connect(tmp_path / "drive" / "drive.db3") as connection:
        connection.execute(f"UPDATE messages SET {sql} WHERE id = 20")
    log = Log(tmp_path / "drive")
    assert log.problems
    assert list(log.read_maps())


def test_a_bag_with_a_question_mark_in_its_name_is_scanned(bags, tmp_path):
    seeds.write_tree(bags["ros2"], tmp_path)
    (tmp_path / "drive").rename(tmp_path / "where? 100%")
    file = tmp_path / "where? 100%" / "drive.db3"
    file.write_bytes(file.read_bytes()[:-4096])
    assert sum(map(len, open_bag(tmp_path / "where? 100%").times.values())) > 0


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_messages_with_impossible_numbers_are_lost_and_counted(value, bags, tmp_path):
    seeds.write_tree(bags["ros2"], tmp_path)
    with sqlite3.connect(tmp_path / "drive" / "drive.db3") as connection:
        rows = connection.execute(
            "SELECT messages.id, data FROM messages JOIN topics ON topics.id = topic_id WHERE name = '/odom'"
        ).fetchall()
        number, data = rows[3]
        # x of the position is the first double that is 0.9, three steps of 0.3.
        changed = data.replace(struct.pack("<d", 0.3 * 3), struct.pack("<d", value))
        assert changed != data
        connection.execute("UPDATE messages SET data = ? WHERE id = ?", (changed, number))
    problems = Log(tmp_path / "drive").problems
    assert "/odom: 1 of 12 messages are lost: coordinates that are no numbers" in str(problems)


def test_devices_are_no_logs(tmp_path):
    (tmp_path / "x.bag").symlink_to("/dev/zero")
    with pytest.raises(LogError, match=r"x\.bag: is a device or pipe"):
        open_bag(tmp_path / "x.bag")


# The fuzzer.


def _text_kinds():
    # Kinds whose seeds take seconds to make are left to the command.
    slow = ("values", "dataset")
    return [kind for kind in texts.KINDS if not kind.name.startswith(slow)]


def _assert_good(kind, cases, folder):
    """Every case of this kind of damage ends well."""
    for number in range(cases):
        own = folder / str(number)
        own.mkdir()
        verdict, text = judged(kind, 3, number, own)
        assert Verdict(verdict) in GOOD, text


@pytest.mark.parametrize("kind", _text_kinds(), ids=lambda kind: kind.name)
def test_damaged_texts_end_well(kind, tmp_path):
    _assert_good(kind, 8, tmp_path)


def _file_kinds():
    quick = ("map", "rooms", "floor", "automaton", "sweep", "recipe", "training")
    return [kind for kind in files.KINDS if kind.name.startswith(quick)]


@pytest.mark.parametrize("kind", _file_kinds(), ids=lambda kind: kind.name)
def test_damaged_files_end_well(kind, tmp_path):
    _assert_good(kind, 8, tmp_path)


def _compared_kinds():
    """Where damaged files are compared with whole ones: what makes the files, and what reads them."""
    cases = [kind.run for kind in files.KINDS if isinstance(kind.run, functools.partial)]
    return [run.args[:2] for run in cases if run.func is files._case and run.args[2]]


@pytest.mark.parametrize(("trees", "read"), _compared_kinds())
def test_what_is_read_twice_is_equal(trees, read, tmp_path):
    """Or every damage that is harmless would count as a wrong answer."""
    (tmp_path / "scratch").mkdir()
    tree = trees(tmp_path / "scratch")[0]
    once, again = files._whole(tree, read, tmp_path / "scratch"), files._whole(tree, read, tmp_path / "scratch")
    assert once == again
    assert once is not None


class _LongError(PotlpError):
    """One that gets around the bound of its base class."""

    def __str__(self) -> str:
        return "x" * (LONGEST_MESSAGE + 1)


def _raising(error: BaseException | None) -> Kind:
    def run(random, folder):
        if error is not None:
            raise error

    return Kind("x", run)


@pytest.mark.parametrize(
    ("error", "verdict"),
    [
        (None, Verdict.FINE),
        (PotlpError("x: is wrong"), Verdict.CLEAR),
        (PotlpError(" "), Verdict.TRACEBACK),
        (_LongError("x"), Verdict.TRACEBACK),
        (PotlpError("\ud800"), Verdict.TRACEBACK),
        (KeyError("x"), Verdict.TRACEBACK),
        (MemoryError(), Verdict.TRACEBACK),
        (SystemExit(1), Verdict.TRACEBACK),
        (WrongAnswerError("x"), Verdict.WRONG),
        (LostRowsError("x"), Verdict.LOST),
    ],
)
def test_the_fuzzer_tells_how_cases_end(error, verdict, tmp_path):
    assert judged(_raising(error), 0, 0, tmp_path)[0] == verdict


def test_damage_is_reproducible_and_keeps_texts_texts():
    text = seeds.SWEEP_YAML
    found = [damaged_text(np.random.default_rng(seed), text) for seed in range(50)]
    assert found == [damaged_text(np.random.default_rng(seed), text) for seed in range(50)]
    assert sum(other != text for other in found) > 40
    data = [damaged(np.random.default_rng(seed), text.encode()) for seed in range(50)]
    assert sum(other != text.encode() for other in data) > 45


def test_counts_go_on_where_they_stopped_and_mix_no_seeds(tmp_path):
    tally = open_tally(tmp_path, 3)
    row = tally.row(Kind("map", lambda random, folder: None))
    for verdict in (Verdict.FINE, Verdict.CLEAR, Verdict.HANG):
        row.add(Ending(verdict, "why", 1.5))
    tally.write(tmp_path / TALLY)
    again = open_tally(tmp_path, 3)
    assert again.rows["map"] == row
    assert (row.cases, row.bad) == (3, [2])
    with pytest.raises(ConfigurationError, match="was made with seed 3, not 4"):
        open_tally(tmp_path, 4)


def test_the_table_adds_up_cases_of_equal_units():
    rows = {"a": Row("files", 3, dict.fromkeys(Verdict, 1), 0.5), "b": Row("files", 4, dict.fromkeys(Verdict, 2), 0.1)}
    lines = table(Tally(1, {}, rows)).splitlines()
    assert "| **all** | files | 7 | 3 | 3 | 3 | 3 | 3 | 3 | 0.50 s |" in lines


def test_a_message_is_cut_in_its_middle_where_it_quotes_too_much():
    error = MapError("plan.xml", "label", f"no kind is given for {'!' * 20_000}; add it to the file of kinds")
    assert len(str(error)) < LONGEST_MESSAGE
    assert str(error).startswith("plan.xml: label: no kind is given for !!!")
    assert str(error).endswith("!!!; add it to the file of kinds")


def test_the_page_has_the_counts_of_all_parts_that_were_run(tmp_path):
    counts, results = tmp_path / "counts", tmp_path / "results"
    results.mkdir()
    made = {"command": "python -m eval.faults x", "commit": "c0ffee0", "versions": {"jax": "1"}}
    rows = {"a": Row("files", 3, dict.fromkeys(Verdict, 0) | {Verdict.CLEAR: 2, Verdict.HANG: 1}, 0.5, bad=[2])}
    for part in ("files", "texts"):
        (counts / part).mkdir(parents=True)
        Tally(1, made, rows).write(counts / part / TALLY)
    text = write_page(counts, results).read_text()
    assert "- 6 files: 0 fine, 4 clear errors, 0 tracebacks, 2 hangs, 0 wrong answers, 0 lost rows\n" in text
    assert text.count("Cases that ended badly, by number (seed 1): a: 2.") == 2
    assert text.count("command: `python -m eval.faults x`; commit: `c0ffee0`; versions: jax 1.") == 2
    assert "## Formulas" not in text
    # The counts beside the page are all that it needs.
    assert page(results) == text


def test_the_page_has_the_tables_of_its_counts():
    text = (RESULTS / PAGE).read_text("utf-8")
    counted = sorted((RESULTS / "faults").glob("*.json"))
    assert counted
    for file in counted:
        assert table(read_tally(file)) in text, f"{file.name}: python -m eval.faults page writes the page"


def test_words_of_the_command_line_end_well(tmp_path):
    (kind,) = options.KINDS
    _assert_good(kind, 12, tmp_path)


def test_waiting_for_a_core_is_no_time_of_a_case(monkeypatch):
    """Of the process and of one that it began, which ends in between."""
    waits = {1: {"1": 2.0, "5": 0.0}, 2: {"2": 1.0}}
    now = [100.0]
    monkeypatch.setattr("eval.faults.worker.os.getpid", lambda: 1)
    monkeypatch.setattr("eval.faults.worker.time.monotonic", lambda: now[0])
    monkeypatch.setattr("eval.faults.worker._waits_of", lambda process: dict(waits[process]))
    monkeypatch.setattr("eval.faults.worker._children", lambda process: [child for child in waits if child != process])
    clock = _Clock(None)
    now[0] = 110.0
    waits[1]["1"], waits[1]["5"], waits[2]["2"] = 5.0, 1.0, 3.5
    assert clock.seconds() == pytest.approx(10.0 - 3.0 - 2.5)
    del waits[2]
    now[0] = 112.0
    assert clock.seconds() == pytest.approx(12.0 - 3.0 - 2.5)


def test_what_processes_wait_for_is_read_from_the_system():
    waits = _Clock(None)._waits()
    # Nothing where the system does not tell.
    assert all(wait >= 0.0 for threads in waits.values() for wait in threads.values())
    assert not Path("/proc/self/schedstat").exists() or waits[os.getpid()]
