"""Automata: the reference automata of Spot, canonical form, HOA in and out, the semantics of the formulas."""

import json
import random
import re
import subprocess
import sys
import warnings
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from potlp_jax.errors import TaskError, TaskWarning, UnsatisfiableError
from potlp_jax.task import hoa
from potlp_jax.task.automaton import Dfa, canonical_dfa, translate
from potlp_jax.task.formula import parse_formula
from potlp_jax.task.hoa import read_hoa, write_hoa
from potlp_jax.task.reading import read_task
from potlp_jax.task.task import Task
from potlp_jax.verify.semantics import satisfies_lasso, word_satisfies, word_violates

HEADER = 'HOA: v1\nStates: 2\nStart: 0\nAP: 2 "a" "b"\nacc-name: Buchi\nAcceptance: 1 Inf(0)\n'
EVENTUALLY_A = HEADER + "--BODY--\nState: 0\n[!0] 0\n[0] 1\nState: 1 {0}\n[t] 1\n--END--\n"

# Formulas that do not come from Spot's own random generator, with the operators that those lack.
OWN_FORMULAS = [
    "F(a & F(b & F a))",
    "!a U (b & X(!a U c))",
    "(a -> F b) & F c",
    "!(G a) & !(b W c)",
    "F(a <-> X b) & F(a xor c)",
    "(!a U b) | ((!a U c) & F a)",
    "<>(a && <>b) || !([]c)",
    "!(a R (b & !c))",
    "XX(a M (b | X c))",
    "!((a U b) -> G c)",
    "F[2:4] a & X[2] b",
    "F[1:](a & !G[0..2] b)",
    "X[!]F[3,1] a | X[0] c",
    # How strongly operators bind, and Spot's other spellings of them.
    "F(a xor b | c)",
    "F(a | b ^ c) & F b",
    "F(a ^ b & c | b)",
    "~a U b /\\ F c",
    "◇(a ∧ ¬b) ∨ ○(b ⊕ c)",
    "F(a --> b) * F c + F(a => b) ∩ X a",
    "F(a <--> b) & (F(a ↔ c) ∪ b)",
    "True U a & !FALSE & F(b → c)",
    "()a \\/ !□b",
]


@pytest.fixture(scope="module")
def all_references(external_data):
    return json.loads((external_data / "reference" / "spot_dfas.json").read_text())


@pytest.fixture(scope="module")
def reference(all_references):
    """The automata that accept something: the others are no tasks."""
    return [entry for entry in all_references if entry["accepting"]]


@cache
def compiled(formula: str, propositions: tuple[str, ...] | None = None) -> Task:
    return Task.from_formula(formula, propositions)


def same(a: Dfa, b: Dfa) -> bool:
    return a.initial == b.initial and all(
        np.array_equal(getattr(a, name), getattr(b, name)) for name in ("transitions", "accepting", "trap")
    )


def trap_by_search(transitions: np.ndarray, accepting: np.ndarray) -> list[bool]:
    """Whether no accepting state is found by following transitions, state by state."""
    trap = []
    for start in range(len(transitions)):
        seen, waiting = {start}, [start]
        while waiting:
            waiting += (new := set(transitions[waiting.pop()].tolist()) - seen)
            seen |= new
        trap.append(not any(accepting[state] for state in seen))
    return trap


def run(dfa: Dfa, word) -> int:
    state = dfa.initial
    for letter in word:
        state = int(dfa.transitions[state, letter])
    return state


def check_semantics(formula: str, propositions, dfa: Dfa, rng: random.Random, words: int) -> None:
    """The DFA's verdict on random words and lassos is that of the formula's semantics."""
    letters = range(2 ** len(propositions))
    for _ in range(words):
        prefix = [rng.choice(letters) for _ in range(rng.randrange(7))]
        loop = [rng.choice(letters) for _ in range(rng.randrange(1, 4))]
        state = run(dfa, prefix)
        assert dfa.accepting[state] == word_satisfies(formula, propositions, prefix), (formula, prefix)
        assert dfa.trap[state] == word_violates(formula, propositions, prefix), (formula, prefix)
        # After |Z| rounds of the loop a state has come back: acceptance happens by then or never.
        final = run(dfa, prefix + loop * dfa.num_states)
        assert dfa.accepting[final] == satisfies_lasso(formula, propositions, prefix, loop), (formula, prefix, loop)


def test_a_reference_that_accepts_nothing_is_no_task(all_references):
    empty = [entry for entry in all_references if not entry["accepting"]]
    assert empty
    for entry in empty:
        with pytest.raises(UnsatisfiableError, match=re.escape(entry["formula"])):
            compiled(entry["formula"])


def test_all_reference_automata_are_reproduced(all_references, reference):
    assert len(all_references) == 206
    for entry in reference:
        task = compiled(entry["formula"])
        assert task.propositions == tuple(entry["ap"])
        dfa = task.dfa
        assert dfa.transitions.dtype == np.int32
        assert dfa.transitions.tolist() == entry["delta"], entry["formula"]
        assert np.flatnonzero(dfa.accepting).tolist() == entry["accepting"]
        assert dfa.initial == entry["init"]
        assert dfa.trap.tolist() == trap_by_search(dfa.transitions, dfa.accepting)
        again = Task.from_hoa(task.to_hoa())
        assert same(again.dfa, dfa), entry["formula"]
        assert (again.text, again.propositions) == (task.text, task.propositions)


def test_spot_reads_our_hoa_as_the_same_language(reference):
    spot = pytest.importorskip("spot")
    for entry in reference[::4]:
        ours = spot.automaton(compiled(entry["formula"]).to_hoa())
        assert spot.are_equivalent(ours, spot.translate(entry["formula"])), entry["formula"]
        assert ours.prop_universal().is_true(), "read as deterministic"
        assert ours.prop_state_acc().is_true()


@pytest.mark.parametrize("options", ["", "i", "k", "l"])
def test_we_read_what_spot_writes(reference, options):
    """Plain, with implicit labels (i), with state labels where possible (k), in one line (l)."""
    spot = pytest.importorskip("spot")
    for entry in reference[:: 8 if options else 2]:
        automaton = spot.translate(entry["formula"], "deterministic", "complete", "SBAcc")
        text = automaton.to_str("hoa", options)
        task = Task.from_hoa(text, entry["ap"])
        assert task.dfa.transitions.tolist() == entry["delta"], entry["formula"]
        assert np.flatnonzero(task.dfa.accepting).tolist() == entry["accepting"]


def test_words_are_judged_as_the_semantics_say(reference):
    rng = random.Random(0)
    for entry in reference:
        dfa = compiled(entry["formula"]).dfa
        check_semantics(entry["formula"], entry["ap"], dfa, rng, words=12)


@pytest.mark.parametrize("formula", OWN_FORMULAS)
def test_operators_are_judged_as_the_semantics_say(formula):
    names = ("c", "unused", "b", "a")
    check_semantics(formula, names, Task.from_formula(formula, names).dfa, random.Random(1), words=60)


def test_the_semantics_of_each_operator_on_a_lasso():
    """The reference itself, on verdicts that can be read off: a a b (c)^omega over propositions a, b, c."""

    def holds(formula):
        return satisfies_lasso(formula, ("a", "b", "c"), [1, 1, 2], [4])

    true = [
        "a",
        "X a",
        "XX b",
        "a U b",
        "F b",
        "FG c",
        "G(a|b|c)",
        "a W b",
        "c R (a|b|c)",
        "X X X G c",
        "a -> a",
        "b -> c",
        "!b",
        "(a|b) W c",
        "F c & !G c",
        "(X b) M a",
        "a xor b",
        "b <-> c",
        "1",
        "(X b) R a",
    ]
    false = ["b", "XX a", "a U c", "G a", "GF a", "a M b", "b R a", "a R c", "a -> b", "a W c", "a <-> b", "0", "FG b"]
    assert [formula for formula in true if not holds(formula)] == []
    assert [formula for formula in false if holds(formula)] == []


def test_equal_languages_have_equal_arrays():
    for one, other in [("F(a | X a)", "F a"), ("a U (a U b)", "a U b"), ("F a & F b", "F b & F a"), ("Xa | X!a", "1")]:
        names = ("a", "b")
        assert same(Task.from_formula(one, names).dfa, Task.from_formula(other, names).dfa), (one, other)


def test_propositions_that_do_not_matter_change_no_move():
    alone = Task.from_formula("a U b").dfa
    wide = Task.from_formula("a U b", ("b", "x", "a")).dfa
    letters = np.arange(8)
    own = (letters >> 2 & 1) | (letters & 1) << 1
    # The numbering follows the letters' order, which differs: compare by running words.
    for word in ([4, 4, 1], [0], [6, 6, 3], [2], [5]):
        assert wide.accepting[run(wide, word)] == alone.accepting[run(alone, own[word])]
        assert wide.trap[run(wide, word)] == alone.trap[run(alone, own[word])]
    assert np.array_equal(wide.transitions[:, letters], wide.transitions[:, letters ^ 2])


@pytest.mark.parametrize("text", ["F(a & !a)", "0", "X a & X !a", "(!a U b) & a & !b", "F (b & (a & !b))"])
def test_a_formula_that_nothing_satisfies_is_refused_by_name(text):
    with pytest.raises(UnsatisfiableError, match=re.escape(f"no robot can satisfy '{text}'")):
        Task.from_formula(text, ("a", "b"))
    # The same where an automaton is read: as Spot gives it, before the task is made.
    hoa = translate(parse_formula(text, ("a", "b")))
    with pytest.raises(UnsatisfiableError, match="no robot can satisfy"):
        Task.from_hoa(hoa)


@pytest.mark.parametrize("text", ["1", "F(a | !a)", "a | X X 1", "F a | !a"])
def test_a_formula_that_asks_for_nothing_is_named(text):
    with pytest.warns(TaskWarning, match=re.escape(f"'{text}' is satisfied by every word")):
        task = Task.from_formula(text, ("a",))
    assert task.dfa.accepting.tolist() == [True]
    with warnings.catch_warnings():
        warnings.simplefilter("error", TaskWarning)
        Task.from_formula("F a | X a")


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_canonical_form_of_a_shuffled_and_doubled_automaton(data):
    """Renaming states and splitting them into copies does not show."""
    formula = data.draw(
        st.sampled_from(["a U (b & F a)", "F(a & X b)", "(!a U b) & F(a & F b)", "a & X b", "F a | F b"])
    )
    dfa = Task.shipped("toy-2").dfa if formula is None else Task.from_formula(formula, ("a", "b")).dfa
    count = dfa.num_states
    copies = data.draw(st.lists(st.integers(0, count - 1), min_size=0, max_size=4))
    origin = np.array([*range(count), *copies])
    places = np.array(data.draw(st.permutations(range(len(origin)))))
    transitions = np.zeros((len(origin), 4), dtype=np.int64)
    for new, old in enumerate(origin):
        for letter in range(4):
            twins = np.flatnonzero(origin == dfa.transitions[old, letter])
            transitions[places[new], letter] = places[data.draw(st.sampled_from(twins.tolist()))]
    accepting = np.zeros(len(origin), dtype=bool)
    accepting[places] = dfa.accepting[origin]
    assert same(canonical_dfa(transitions, accepting, int(places[0])), dfa)


def test_states_that_cannot_avoid_acceptance_are_accepting():
    """Judged by infinite words: what is bound to be accepted is accepted."""
    dfa = canonical_dfa(np.array([[1, 1], [2, 2], [2, 2]]), np.array([False, False, True]), 0)
    assert dfa.transitions.tolist() == [[0, 0]]
    assert dfa.accepting.tolist() == [True]


def test_acceptance_marks_off_cycles_do_not_matter():
    """A state that is visited once at most may carry any mark."""
    table = np.array([[1, 2], [1, 1], [2, 2]])
    plain = canonical_dfa(table, np.array([False, True, False]), 0)
    marked = canonical_dfa(table, np.array([True, True, False]), 0)
    assert same(plain, marked)
    assert plain.accepting.tolist() == [False, True, False]


@pytest.mark.parametrize("formula", ["G a", "GF a", "F G a", "a W b", "G(a -> X b)", "F a & G b"])
def test_automata_that_are_not_co_safe_are_refused(formula):
    spot = pytest.importorskip("spot")
    automaton = spot.translate(formula, "BA", "deterministic", "complete", "SBAcc")
    what = "not co-safe" if spot.is_deterministic(automaton) else r"HOA line \d+: state \d+ is not deterministic"
    with pytest.raises(TaskError, match=what):
        Task.from_hoa(automaton.to_str("hoa"))


def test_hoa_of_a_co_safe_language_that_is_written_with_always_is_read():
    spot = pytest.importorskip("spot")
    automaton = spot.translate("F a | G !a", "BA", "deterministic", "complete")
    assert Task.from_hoa(automaton.to_str("hoa"), ("a",)).dfa.accepting.tolist() == [True]


def test_hoa_labels_aliases_comments_and_headers():
    text = """HOA: v1 /* a comment
        of two lines */ tool: "by hand" "1.0" own-header: t {0} [1]
        name: "say \\"a\\" \\\\ b"
        Start: 1 AP: 2 "a" "front \\"door\\""
        Alias: @both 0 & 1 Alias: @some !(!0 & !1)
        acc-name: Buchi Acceptance: 1 Inf ( 0 ) properties: deterministic !complete
        --BODY--
        State: [t] 0 "done" {0} 0
        State: 1 "start" [@both] 0 [@some & !@both] 1 [!@some | f] 1
        --END--"""
    automaton = read_hoa(text)
    assert automaton.name == 'say "a" \\ b'
    assert automaton.propositions == ("a", 'front "door"')
    assert automaton.initial == 1
    assert automaton.transitions.tolist() == [[0, 0, 0, 0], [1, 1, 1, 0]]
    assert automaton.accepting.tolist() == [True, False]
    task = Task.from_hoa(text)
    assert Task.from_hoa(task.to_hoa()).propositions == automaton.propositions
    assert Task.from_hoa(task.to_hoa()).text == automaton.name


def test_hoa_aliases_may_stand_before_the_propositions():
    text = EVENTUALLY_A.replace("[0] 1", "[@x & @all] 1").replace("[!0] 0", "[!@x] 0")
    early = text.replace("Start:", "Alias: @x 0 Alias: @all @x | t\nStart:")
    assert read_hoa(early).transitions.tolist() == read_hoa(EVENTUALLY_A).transitions.tolist()


def test_hoa_may_begin_with_a_byte_order_mark(tmp_path):
    (tmp_path / "task.hoa").write_text(EVENTUALLY_A, "utf-8-sig")
    assert read_task(str(tmp_path / "task.hoa")).dfa.num_states == 2


def test_hoa_acceptance_true_and_false():
    body = "--BODY--\nState: 0\n[t] 0\n--END--"
    assert read_hoa(f"HOA: v1\nStart: 0\nAcceptance: 0 t\n{body}").accepting.tolist() == [True]
    assert read_hoa(f"HOA: v1\nStart: 0\nAcceptance: 0 f\n{body}").accepting.tolist() == [False]


@pytest.mark.parametrize(
    ("old", "new", "line", "what"),
    [
        ("HOA: v1", "HOA: v2", 1, "version v2"),
        ("HOA: v1\n", "", 1, "does not begin"),
        ("Start: 0\n", "", 6, "no 'Start:'"),
        ("Start: 0", "Start: 0\nStart: 1", 4, "several initial states"),
        ("Start: 0", "Start: 0 & 1", 3, "conjunction of initial states"),
        ("Start: 0", "Start: 7", 14, "initial state 7"),
        ("Acceptance: 1 Inf(0)\n", "", 6, "no 'Acceptance:'"),
        ("Acceptance: 1 Inf(0)", "Acceptance: 2 Inf(0)&Inf(1)", 6, "must be Büchi"),
        ("Acceptance: 1 Inf(0)", "Acceptance: 1 Fin(0)", 6, "must be Büchi"),
        ("Acceptance: 1 Inf(0)", "Acceptance: 1 Inf(0)\nAcceptance: 0 t", 7, "a second 'Acceptance:' header"),
        ("States: 2", "States: 2\nStates: 1", 3, "a second 'States:' header"),
        ("AP:", "AP: 0\nAP:", 5, "a second 'AP:' header"),
        ("AP:", 'name: "a"\nname: "b"\nAP:', 5, "a second 'name:' header"),
        ("AP:", "Alias: @x 0\nAlias: @x !0\nAP:", 5, "a second alias @x"),
        ("AP:", "Alias: @x @y\nAlias: @y 0\nAP:", 4, "@y is not a label"),
        ("AP:", "Alias: @x 0 1\nAP:", 4, "expected a header or --BODY--, found 1"),
        ("AP:", "Alias: x 0\nAP:", 4, "expected an alias such as @a, found x"),
        ('AP: 2 "a" "b"', 'AP: 3 "a" "b"', 4, "announces 3"),
        ('AP: 2 "a" "b"', 'AP: 2 "a" "a"', 4, "announces 2"),
        ('AP: 2 "a" "b"', "AP: 17" + "".join(f' "p{i}"' for i in range(17)), 4, "too many"),
        ("AP:", "Players: 1\nAP:", 4, "'Players:' is not supported"),
        ("[!0] 0", "[!0&1] 0", 8, "state 0 is not complete: letter !a&!b"),
        ("[0] 1", "[t] 1", 10, "state 0 is not deterministic: letter !a&!b leads to both 0 and 1"),
        ("[0] 1", "[2] 1", 10, "proposition 2 does not exist"),
        ("[0] 1", "[@x] 1", 10, "@x is not a label"),
        ("[0] 1", "[0 1", 10, "expected ']'"),
        ("[0] 1", "[0] 1 & 0", 10, "universal branching"),
        ("[0] 1", "[0] 1 {0}", 10, "acceptance on an edge"),
        ("[0] 1", "[0] 5", 8, "leads to state 5"),
        ("[0] 1", "[0] x", 10, "edge's target state, found x"),
        ("[0] 1", "1", 10, "edge without label beside"),
        ("[!0] 0\n[0] 1", "0 [0] 1", 9, "edge label beside"),
        ("State: 1 {0}", "State: 0 {0}", 11, "described twice"),
        ("State: 1 {0}", "State: 1 {1}", 11, "acceptance set"),
        ("State: 1 {0}", "State: 2 {0}", 14, "state 1 of 2 is not described"),
        ("States: 2", "States: 1", 11, "exceeds"),
        ("--END--", "--ABORT--", 13, "found --ABORT--"),
        ("--END--", "--END--\nHOA: v1", 14, "not several"),
        ("--END--", "%", 13, "cannot read '%'"),
    ],
)
def test_hoa_that_is_not_understood_is_refused_with_its_line(old, new, line, what):
    assert old in EVENTUALLY_A
    with pytest.raises(TaskError) as caught:
        read_hoa(EVENTUALLY_A.replace(old, new, 1))
    assert str(caught.value).startswith(f"HOA line {line}: ")
    assert what in str(caught.value)


def test_hoa_writing_is_exact():
    task = Task.from_hoa(EVENTUALLY_A)
    assert write_hoa(task.dfa, ("a", "b"), "F a").splitlines() == [
        "HOA: v1",
        'name: "F a"',
        "States: 2",
        "Start: 0",
        'AP: 2 "a" "b"',
        "acc-name: Buchi",
        "Acceptance: 1 Inf(0)",
        "properties: trans-labels explicit-labels state-acc deterministic complete terminal",
        "--BODY--",
        "State: 0",
        "[!0] 0",
        "[0] 1",
        "State: 1 {0}",
        "[t] 1",
        "--END--",
    ]


def test_hoa_needs_no_spot():
    code = (
        "import sys; sys.modules['spot'] = None\n"
        "from potlp_jax.task.shipped import shipped_tasks\n"
        "from potlp_jax.task.task import Task\n"
        "print({n: Task.from_hoa(Task.shipped(n).to_hoa()).dfa.num_states for n in shipped_tasks()})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    # Those found in any order have a state for each set that has been found.
    fire = {f"firefighting-{number}": states for number, states in zip("1234", (4, 4, 5, 3), strict=True)}
    parcels, rooms = {"parcels-1": 2**2, "parcels-2": 3}, {"rooms-1": 2**3, "rooms-2": 4}
    campus = {}
    for size in ("large", "medium", "small"):
        campus |= {f"campus-{size}-1": 2**3, **{f"campus-{size}-{name}": found for name, found in parcels.items()}}
    expected = {**campus, "delivery-1": 2**3, **fire, **parcels, **rooms, "toy-1": 2, "toy-2": 3}
    assert done.stdout.strip() == str(expected)


def test_a_long_text_is_not_read_beyond_its_first_mistake(monkeypatch):
    """Millions of tokens take seconds."""
    taken = []

    def tokens(text):
        for token in of_hoa(text):
            taken.append(token)
            yield token

    of_hoa = hoa._tokens
    monkeypatch.setattr(hoa, "_tokens", tokens)
    with pytest.raises(TaskError, match=r"line 2: expected a header or --BODY--, found \{"):
        read_hoa("HOA: v1\n" + 1_000_000 * "{")
    assert len(taken) == 3
