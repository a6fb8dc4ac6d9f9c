"""A distribution of tasks over a family's propositions, and of the outcome classes that an estimator learns from.

The estimator sees a task only through its outcome classes, and must answer for formulas that it never saw. Tasks are
drawn from templates: reach, reach in turn, reach all, reach either, and mixtures of these, each leg with up to three
propositions to avoid on the way. A **question** is an outcome class of one of them. Several questions make a **sheet**,
an automaton for ``labels.true_labels`` whose states are the distinct sets of staying letters: distances are solved
once per such set, so that further questions of the same set cost next to nothing.
"""

import contextlib
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import jax.numpy as jnp
import numpy as np

from potlp_jax.errors import TaskWarning, UnsatisfiableError
from potlp_jax.task.guards import Phi
from potlp_jax.task.propositions import in_formula, require_same_propositions
from potlp_jax.task.task import Task, TaskArrays, TaskSizes
from potlp_jax.types import NO_CLASS

HELD_OUT: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "firefighting": (
            "(!fire & !alarm) U (extinguisher & F exit)",
            "!fire U (alarm | extinguisher)",
            "(!fire U extinguisher) & (!fire U exit)",
            "(!exit U (alarm | extinguisher)) & F exit",
        ),
        "delivery": (
            "F grad & F (professor & F undergrad)",
            "!undergrad U professor",
            "F (professor | grad)",
        ),
    }
)
"""Formulas by family whose languages no training task equals: for asking whether the estimator generalises."""

LARGEST: TaskSizes = TaskSizes(states=8, propositions=16, edges=24, classes=24, compound=8, cubes=4)
"""Tasks that are drawn fit these sizes (propositions: those of the family)."""

# The probabilities below were not tuned. They give every kind of class a part in the data, simple ones the largest
# (docs/dataset.md).
_AVOIDED = (0.25, 0.45, 0.2, 0.1)
"""Probability of 0 to 3 propositions to avoid on a leg."""

_GOALS = {"one": 0.66, "without": 0.2, "together": 0.06, "either": 0.08}
_TEMPLATES = {"reach": 0.28, "turn": 0.22, "all": 0.16, "either": 0.14, "order": 0.08, "detour": 0.12}

_UNLIKELY = 0.2
"""How often a class that needs several propositions at one cell is asked, relative to others: few places offer them,
and tasks that reach all of several places have many such classes."""

# Draws before giving up: refused draws are common, but so many in a row mean that no formula is left.
_ATTEMPTS = 200


@dataclass(frozen=True)
class Question:
    """An outcome class of a task.

    Attributes:
        task: the formula.
        propositions: of the task; what the entries of the vectors and the bits of the letters mean.
        outcome_class: the index of the class in ``Task.classes``.
        phi_stay, phi_go: its vectors.
        stay, go: the letters that keep the state (exact), and those of the cube.
    """

    task: str
    propositions: tuple[str, ...]
    outcome_class: int
    phi_stay: Phi
    phi_go: Phi
    stay: tuple[bool, ...]
    go: tuple[bool, ...]


def random_formula(rng: np.random.Generator, propositions: Sequence[str]) -> str:
    """A co-safe formula over some of the propositions, in Spot's syntax."""
    names = [in_formula(name) for name in propositions]
    template = _choice(rng, _TEMPLATES)
    # "reach", "turn" and "detour" have the forms of the paper's fire-fighting tasks, "all" that of its delivery task.
    if template == "reach":
        return _leg(rng, names)
    if template == "turn":
        last = _leg(rng, names)
        return _leg(rng, names, then=_leg(rng, names, then=last) if rng.random() < 0.25 else last)
    if template == "order":
        first, second = _pick(rng, names, 2, replace=len(names) < 2)
        return f"(!{second} U {first}) & F {second}"
    if template == "detour":
        return f"({_leg(rng, names)}) | (({_leg(rng, names)}) & ({_leg(rng, names)}))"
    last = _leg(rng, names, then=_leg(rng, names)) if rng.random() < 0.2 else _leg(rng, names)
    return f"({_leg(rng, names)}) {'&' if template == 'all' else '|'} ({last})"


class TaskDistribution:
    """Draws tasks over Sigma that ask the robot to look for something, never one whose language is held out."""

    def __init__(self, propositions: Sequence[str], held_out: Sequence[str] = ()) -> None:
        """Raises TaskError where a formula that is held out cannot be compiled over ``propositions``."""
        self.propositions = tuple(propositions)
        self._held_out = {language(Task.from_formula(text, self.propositions)) for text in held_out}

    def draw(self, rng: np.random.Generator) -> Task:
        """The next task."""
        for _ in range(_ATTEMPTS):
            text = random_formula(rng, self.propositions)
            # What nothing satisfies, and what everything does, is drawn now and then and asks no question.
            with contextlib.suppress(UnsatisfiableError), warnings.catch_warnings():
                warnings.simplefilter("ignore", TaskWarning)
                task = Task.from_formula(text, self.propositions)
                if self._accepts(task):
                    return task
        raise ValueError(f"no task was found over {self.propositions}: the formulas that are held out leave none")

    def _accepts(self, task: Task) -> bool:
        # A task that is decided before anything is found (letter 0) asks nothing of the unknown.
        first = task.dfa.transitions[task.dfa.initial, 0]
        asks = len(task.classes) > 0 and not task.dfa.accepting[first] and not task.dfa.trap[first]
        return asks and LARGEST.covers(task.sizes) and language(task) not in self._held_out


def language(task: Task) -> tuple[bytes, bytes, int]:
    """Equal for tasks over the same propositions that accept the same words."""
    # Task.from_formula gives the minimal automaton with its states in a canonical order, so equal languages have equal
    # arrays, however the formulas are written.
    return task.dfa.transitions.tobytes(), task.dfa.accepting.tobytes(), int(task.dfa.initial)


def questions_of(task: Task) -> tuple[Question, ...]:
    """The outcome classes of a task as questions."""
    return tuple(
        Question(
            task=task.text,
            propositions=task.propositions,
            outcome_class=c,
            phi_stay=phi_stay,
            phi_go=phi_go,
            stay=tuple(condition.stay.tolist()),
            go=tuple(condition.go.tolist()),
        )
        for c, ((phi_stay, phi_go), condition) in enumerate(zip(task.classes, task.conditions, strict=False))
    )


def draw_questions(
    rng: np.random.Generator, tasks: Sequence[Task], count: int, staying_sets: int
) -> tuple[Question, ...]:
    """Questions from some of the tasks, distinct by (phi_stay, phi_go).

    Args:
        rng: moves on.
        tasks: the pool that classes are drawn from.
        count: questions, at most.
        staying_sets: distinct sets of staying letters among them, at most; each costs a solve of distances.

    Returns:
        The questions in the order in which they were drawn; fewer where the tasks have no more.
    """
    chosen: dict[tuple[Phi, Phi], Question] = {}
    stays: set[tuple[bool, ...]] = set()
    # Draws repeat, and some do not fit the sets that are there: eight draws a question find nearly all there are.
    for _ in range(8 * count):
        if len(chosen) == count:
            break
        classes = questions_of(tasks[int(rng.integers(len(tasks)))])
        likely = np.array([1.0 if question.phi_go.count(1) < 2 else _UNLIKELY for question in classes])
        for index in rng.choice(len(classes), min(2, len(classes)), replace=False, p=likely / likely.sum()):
            question = classes[index]
            if len(chosen) < count and len(stays | {question.stay}) <= staying_sets:
                stays.add(question.stay)
                chosen.setdefault((question.phi_stay, question.phi_go), question)
    return tuple(chosen.values())


def question_sheet(questions: Sequence[Question], count: int, staying_sets: int) -> TaskArrays:
    """Questions as an automaton for ``true_labels``: class ``c`` is question ``c``, the rest of ``count`` is padding.

    State ``k`` keeps itself on the ``k``-th set of staying letters, and no other entry means anything.

    Args:
        questions: of tasks over the same propositions.
        count: classes of the sheet, so that all sheets have arrays of one shape.
        staying_sets: states of the sheet.

    Returns:
        Arrays of a task without edges, accepting states or traps: only ``true_labels`` can read it.

    Raises:
        PropositionsError: the questions are of tasks over different propositions.
        ValueError: no question, more questions or sets than there is room for, or room for fewer than two sets.
    """
    stays = list(dict.fromkeys(question.stay for question in questions))
    if not 0 < len(questions) <= count or len(stays) > staying_sets or staying_sets < 2:
        raise ValueError(
            f"{len(questions)} questions with {len(stays)} staying sets do not fit a sheet of {count} and "
            f"{staying_sets}: a sheet has at least one question, and room for two sets or more"
        )
    for question in questions:
        require_same_propositions(
            question.propositions,
            questions[0].propositions,
            asker=f"a question of {question.task!r}",
            knower=f"one of {questions[0].task!r}",
            remedy="ask about tasks over the same ones",
        )
    letters, propositions = len(stays[0]), len(questions[0].propositions)
    states = np.arange(staying_sets, dtype=np.int32)[:, None]
    keeps = np.ones((staying_sets, letters), bool)
    keeps[: len(stays)] = stays
    real = np.arange(count) < len(questions)
    # Where a state does not keep itself it goes to another one, whichever: a path that leaves the set has failed.
    return TaskArrays(
        transitions=jnp.asarray(np.where(keeps, states, (states + 1) % staying_sets)),
        accepting=jnp.zeros(staying_sets, bool),
        trap=jnp.zeros(staying_sets, bool),
        irrevocable=jnp.zeros((staying_sets, letters), bool),
        state_mask=jnp.ones(staying_sets, bool),
        initial=jnp.int32(0),
        edges=jnp.zeros((1, 2), jnp.int32),
        edge_mask=jnp.zeros(1, bool),
        edge_condition=jnp.zeros(1, jnp.int32),
        class_phi=jnp.asarray(_rows([(q.phi_stay, q.phi_go) for q in questions], (count, 2, propositions), np.int8)),
        class_stay=jnp.asarray(_rows([q.stay for q in questions], (count, letters), bool)),
        class_go=jnp.asarray(_rows([q.go for q in questions], (count, letters), bool)),
        class_mask=jnp.asarray(real),
        condition_classes=jnp.asarray(np.where(real, np.arange(count), NO_CLASS).astype(np.int32)[:, None]),
        condition_mask=jnp.asarray(real),
        implies=jnp.asarray(np.diag(real)),
        propositions=questions[0].propositions,
    )


def _rows(rows: Sequence, shape: tuple[int, ...], dtype: type) -> np.ndarray:
    padded = np.zeros(shape, dtype)
    padded[: len(rows)] = rows
    return padded


def _leg(rng: np.random.Generator, names: list[str], then: str | None = None) -> str:
    """Reach a goal, avoiding some propositions on the way; then, at the goal, begin with what follows."""
    goal, positive = _goal(rng, names)
    others = [name for name in names if name not in positive]
    count = min(int(rng.choice(len(_AVOIDED), p=_AVOIDED)), len(others))
    avoided = " & ".join(f"!{name}" for name in _pick(rng, others, count))
    body = goal if then is None else f"({goal} & ({then}))"
    return f"({avoided}) U {body}" if avoided else f"F {body}"


def _goal(rng: np.random.Generator, names: list[str]) -> tuple[str, set[str]]:
    """What must be found at one cell, and the names that occur in it without negation."""
    kind = _choice(rng, _GOALS)
    if kind == "one" or len(names) < 2:
        (name,) = _pick(rng, names, 1)
        return name, {name}
    first, second = _pick(rng, names, 2)
    if kind == "without":
        return f"({first} & !{second})", {first}
    return f"({first} {'&' if kind == 'together' else '|'} {second})", {first, second}


def _pick(rng: np.random.Generator, names: list[str], count: int, replace: bool = False) -> list[str]:
    return [names[int(i)] for i in rng.choice(len(names), count, replace=replace)]


def _choice(rng: np.random.Generator, weights: Mapping[str, float]) -> str:
    return str(rng.choice(list(weights), p=list(weights.values())))
