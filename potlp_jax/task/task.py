"""A task: a formula, its automaton and its outcome classes in one frozen object, and its arrays for the device."""

import warnings
from collections.abc import Collection, Sequence
from dataclasses import astuple, dataclass
from functools import cached_property
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int8, Int32

from potlp_jax.errors import SpotMissingError, TaskError, TaskWarning, UnsatisfiableError
from potlp_jax.precision import in_32_bits
from potlp_jax.task.automaton import Dfa, canonical_dfa, check_size, translate
from potlp_jax.task.formula import Structure, parse_formula, unknown_proposition
from potlp_jax.task.guards import Phi, minimal_cover
from potlp_jax.task.hoa import HoaAutomaton, read_hoa, write_hoa
from potlp_jax.task.irrevocable import irrevocable_moves
from potlp_jax.task.language import UnreadableError, names_of, read_formula
from potlp_jax.task.outcomes import Condition, OutcomeClass, Outcomes, find_outcomes
from potlp_jax.task.propositions import (
    MAX_PROPOSITIONS,
    check_propositions,
    in_formula,
    require_same_propositions,
)
from potlp_jax.task.shipped import find_shipped, shipped_hoa
from potlp_jax.types import NO_CLASS

UNNAMED: str = "(unnamed automaton)"
"""Text of a task that was read from HOA without a ``name:`` header."""


@flax.struct.dataclass(kw_only=True)
class TaskArrays:
    """A task on the device; padded where masks are False.

    Padded propositions (the highest bits of a letter) are ignored by every table. Padded states loop on every letter
    and are traps. The conditions are the C classes first, then those with several cubes. Stacked tasks have a leading
    batch axis; functions take the arrays of one task.

    Attributes:
        transitions: ``[z, letter]`` is the next state.
        accepting: the task is satisfied.
        trap: acceptance is out of reach; True on padding.
        irrevocable: ``[z, letter]``: entering a cell of this letter in z cannot be taken back (``task.irrevocable``);
            False on padding.
        state_mask: True on real states.
        initial: the state before the first letter.
        edges: ``(z', z'')`` in lexicographic order; (0, 0) on padding.
        edge_mask: True on real edges.
        edge_condition: index of the edge's condition; 0 on padding.
        class_phi: phi_stay and phi_cube; 0 on padding.
        class_stay: letters that keep z' (exact); False on padding.
        class_go: letters of the cube; False on padding.
        class_mask: True on real classes.
        condition_classes: the classes that make up a condition, increasing, then ``NO_CLASS``.
        condition_mask: True on real conditions.
        implies: ``[a, b]``: if a holds beyond a subgoal, so does b. Reflexive on real conditions, False on padding.
        propositions: Sigma without padding; bit ``i`` of a letter is ``propositions[i]``. Static under jit.
    """

    transitions: Int32[Array, "*batch Z L"]
    accepting: Bool[Array, "*batch Z"]
    trap: Bool[Array, "*batch Z"]
    irrevocable: Bool[Array, "*batch Z L"]
    state_mask: Bool[Array, "*batch Z"]
    initial: Int32[Array, "*batch"]
    edges: Int32[Array, "*batch E 2"]
    edge_mask: Bool[Array, "*batch E"]
    edge_condition: Int32[Array, "*batch E"]
    class_phi: Int8[Array, "*batch C 2 P"]
    class_stay: Bool[Array, "*batch C L"]
    class_go: Bool[Array, "*batch C L"]
    class_mask: Bool[Array, "*batch C"]
    condition_classes: Int32[Array, "*batch M K"]
    condition_mask: Bool[Array, "*batch M"]
    implies: Bool[Array, "*batch M M"]
    # Part of what JAX compiles for, so that a task that meets a map of other names is refused while tracing.
    propositions: tuple[str, ...] = flax.struct.field(pytree_node=False)


@dataclass(frozen=True)
class TaskSizes:
    """Array sizes of a task, real or padded.

    Attributes:
        states: Z.
        propositions: P; letters are ``2 ** P``.
        edges: E.
        classes: C.
        compound: conditions with several cubes, M - C.
        cubes: K, cubes of a condition at most.
    """

    states: int
    propositions: int
    edges: int
    classes: int
    compound: int
    cubes: int

    def union(self, other: "TaskSizes") -> "TaskSizes":
        """The larger of each size."""
        return TaskSizes(*map(max, astuple(self), astuple(other)))

    def covers(self, other: "TaskSizes") -> bool:
        """Whether arrays of the other sizes fit."""
        return self.union(other) == self


@dataclass(frozen=True, eq=False)
class Task:
    """A temporal-logic task, checked and compiled. Host only; ``arrays`` is its form for the device.

    Attributes:
        text: the formula, or the name of the automaton that was read.
        propositions: Sigma; bit ``i`` of a letter is ``propositions[i]``.
        dfa: the minimal automaton.
        outcomes: edges, conditions and outcome classes.
        max_positive_literals: cubes that need more propositions at one cell were dropped (None: none were).
        structure: the formula in negation normal form (``task.language``), where the task was made from one that can
            be written so; what an automaton's name says is nothing that was checked.
    """

    text: str
    propositions: tuple[str, ...]
    dfa: Dfa
    outcomes: Outcomes
    max_positive_literals: int | None = None
    structure: Structure | None = None

    @classmethod
    def from_formula(
        cls, text: str, propositions: Sequence[str] | None = None, max_positive_literals: int | None = None
    ) -> "Task":
        """Compiles a co-safe formula in Spot's syntax.

        Without Spot, formulas of shipped tasks are recognised by their language, however they are written; the task is
        the same as with Spot, because equal languages have equal automata here.

        Args:
            text: the formula. Names that begin with F, G or X, or hold spaces, stand in double quotes.
            propositions: Sigma, a superset of the formula's names; default: these names, sorted.
            max_positive_literals: drops cubes that need more propositions to hold at one cell.

        Returns:
            The task; its ``arrays`` are what the planner takes.

        Raises:
            TaskError: anything wrong with the formula, with column and caret; Spot is missing and no shipped task has
                this language; acceptance unreachable because of ``max_positive_literals``.
            UnsatisfiableError: no word satisfies the formula.

        Warns:
            TaskWarning: every word satisfies the formula, so that there is nothing to do.
        """
        try:
            formula = parse_formula(text, propositions)
        except SpotMissingError as missing:
            sigma, automaton, structure = _without_spot(text, propositions, missing)
        else:
            # Through HOA text, so that formulas and files take one path and a shipped file is what Spot would deliver.
            sigma, automaton, structure = formula.propositions, read_hoa(translate(formula)), formula.structure
        return cls._compile(text, sigma, automaton, max_positive_literals, structure)

    @classmethod
    def from_hoa(
        cls, text: str, propositions: Sequence[str] | None = None, max_positive_literals: int | None = None
    ) -> "Task":
        """Compiles an automaton in HOA format; needs no Spot.

        Args:
            text: a deterministic complete automaton with state-based Büchi acceptance and a co-safe language.
            propositions: Sigma, a superset of the automaton's; default: the automaton's, in its order.
            max_positive_literals: drops cubes that need more propositions to hold at one cell.

        Returns:
            The task; its text is the automaton's name.

        Raises:
            TaskError: what is wrong with the automaton, with the line where it has one.
            UnsatisfiableError: no word satisfies the automaton.

        Warns:
            TaskWarning: every word satisfies the automaton, so that there is nothing to do.
        """
        automaton = read_hoa(text)
        sigma = automaton.propositions if propositions is None else propositions
        return cls._compile(automaton.name or UNNAMED, check_propositions(sigma), automaton, max_positive_literals)

    @classmethod
    def shipped(cls, name: str) -> "Task":
        """A task that comes with the package; needs no Spot. ``task.shipped.shipped_tasks()`` lists them.

        Raises:
            TaskError: there is no such task; names those that there are.
        """
        texts = shipped_hoa()
        if name not in texts:
            raise TaskError(f"there is no shipped task {name!r}; there are: {', '.join(texts)}")
        return cls.from_hoa(texts[name])

    @classmethod
    def _compile(
        cls,
        text: str,
        propositions: tuple[str, ...],
        automaton: HoaAutomaton,
        max_positive_literals: int | None,
        structure: Structure | None = None,
    ) -> "Task":
        """The task of a parsed automaton, over Sigma."""
        check_size(len(automaton.accepting), len(propositions))
        unknown = [name for name in automaton.propositions if name not in propositions]
        if unknown:
            raise TaskError(f"unknown proposition '{unknown[0]}'; known: {', '.join(propositions) or 'none'}")
        # Sigma may be larger and in another order: each of its letters is looked up by the bits that the automaton
        # knows.
        bits = [propositions.index(name) for name in automaton.propositions]
        letters = np.arange(2 ** len(propositions))
        own_letters = sum(((letters >> bit & 1) << i for i, bit in enumerate(bits)), np.zeros_like(letters))
        dfa = canonical_dfa(automaton.transitions[:, own_letters], automaton.accepting, automaton.initial)
        _check_that_it_asks_for_something(text, dfa)
        return cls(
            text=text,
            propositions=propositions,
            dfa=dfa,
            outcomes=find_outcomes(dfa, max_positive_literals),
            max_positive_literals=None if max_positive_literals is None else int(max_positive_literals),
            structure=structure,
        )

    def can_do_without(self, names: Collection[str]) -> bool:
        """Whether some word satisfies the task in which none of these propositions ever holds."""
        bits = sum(1 << self.propositions.index(name) for name in names)
        transitions = self.dfa.transitions[:, (np.arange(self.dfa.transitions.shape[1]) & bits) == 0]
        reached = {self.dfa.initial}
        # As many rounds as there are states reach all that can be reached.
        for _ in range(self.dfa.num_states):
            reached |= {int(state) for state in np.unique(transitions[sorted(reached)])}
        return bool(self.dfa.accepting[sorted(reached)].any())

    @property
    def edges(self) -> Int32[np.ndarray, "E 2"]:
        """``(z', z'')`` in lexicographic order."""
        return self.outcomes.edges

    @property
    def classes(self) -> tuple[OutcomeClass, ...]:
        """Outcome classes: pairs (phi_stay, phi_cube)."""
        return self.outcomes.classes

    @property
    def conditions(self) -> tuple[Condition, ...]:
        """One condition per class, then those with several cubes."""
        return self.outcomes.conditions

    @property
    def sizes(self) -> TaskSizes:
        """The smallest arrays that the task fits into: one edge and one class at least, masked where it has none."""
        # `X X fire` has neither: no letter keeps any of its states. An axis without rows cannot be indexed, not even
        # where the result is masked, and would need a case of its own in every estimator and search.
        outcomes = self.outcomes
        return TaskSizes(
            states=self.dfa.num_states,
            propositions=len(self.propositions),
            edges=max(len(outcomes.edges), 1),
            classes=max(len(outcomes.classes), 1),
            compound=len(outcomes.conditions) - len(outcomes.classes),
            cubes=max((len(condition.classes) for condition in outcomes.conditions), default=1),
        )

    @cached_property
    def irrevocable(self) -> Bool[np.ndarray, "Z L"]:
        """``[z, letter]``: entering a cell of this letter in z cannot be taken back (``task.irrevocable``)."""
        return irrevocable_moves(self.dfa)

    @cached_property
    def arrays(self) -> TaskArrays:
        """The device form, without more padding than ``sizes`` has."""
        return self.padded(self.sizes)

    @in_32_bits
    def padded(self, sizes: TaskSizes) -> TaskArrays:
        """The device form in larger arrays. Padding changes no result.

        Raises:
            TaskError: the task does not fit, or there are too many propositions.
        """
        return _on_device(_padded_fields(self, sizes), self.propositions)

    def to_hoa(self) -> str:
        """The automaton in HOA format, with the formula as its name. ``max_positive_literals`` is not part of it."""
        return write_hoa(self.dfa, self.propositions, self.text)

    def guard_text(self, cubes: Sequence[Phi]) -> str:
        """Cubes in words, such as ``!fire & alarm | exit``; ``true`` and ``false`` where there is nothing to say."""
        return " | ".join(_cube_text(cube, self.propositions) for cube in cubes) or "false"

    def describe(self) -> dict[str, Any]:
        """The task for people and programs; JSON-able. Guards are canonical covers in words."""
        # Indices are those of the arrays, so that a planner's values can be looked up here.
        dfa = self.dfa
        return {
            "formula": self.text,
            "propositions": list(self.propositions),
            "max_positive_literals": self.max_positive_literals,
            "states": dfa.num_states,
            "initial": dfa.initial,
            "accepting": np.flatnonzero(dfa.accepting).tolist(),
            "trap": np.flatnonzero(dfa.trap).tolist(),
            "transitions": [
                {"from": source, "to": int(target), "guard": self.guard_text(minimal_cover(row == target))}
                for source, row in enumerate(dfa.transitions)
                for target in np.unique(row)
            ],
            "edges": [
                {"from": int(source), "to": int(target), "condition": int(condition)}
                for (source, target), condition in zip(self.edges, self.outcomes.edge_condition, strict=True)
            ],
            "classes": [self._describe_class(c) for c in range(len(self.classes))],
            "conditions": [self._describe_condition(condition) for condition in self.conditions],
        }

    def _describe_class(self, c: int) -> dict[str, Any]:
        phi_stay, phi_cube = self.classes[c]
        return {
            "phi_stay": list(phi_stay),
            "phi_cube": list(phi_cube),
            "stay": self.guard_text([phi_stay]),
            "cube": self.guard_text([phi_cube]),
            "stay_is_exact": bool(self.outcomes.stay_is_exact[c]),
        }

    def _describe_condition(self, condition: Condition) -> dict[str, Any]:
        return {
            "stay": self.guard_text(minimal_cover(condition.stay)),
            "go": self.guard_text([self.classes[c].phi_cube for c in condition.classes]),
            "classes": list(condition.classes),
        }


def _check_that_it_asks_for_something(text: str, dfa: Dfa) -> None:
    # Planned with, such a task would end its trial at once with cost 0, which looks like a result.
    if dfa.trap[dfa.initial]:
        raise UnsatisfiableError(f"no robot can satisfy '{text}': its parts contradict each other in every word")
    if dfa.accepting[dfa.initial]:
        warnings.warn(f"'{text}' is satisfied by every word: there is nothing to do", TaskWarning, stacklevel=4)


@in_32_bits
def stack_tasks(tasks: Sequence[Task], sizes: TaskSizes | None = None) -> TaskArrays:
    """Several tasks over the same propositions, padded and stacked along a new leading axis.

    Args:
        tasks: at least one task.
        sizes: padded sizes; default: the largest of each.

    Returns:
        The arrays of all tasks, each field with the leading axis ``len(tasks)``.

    Raises:
        PropositionsError: they have different propositions.
        TaskError: no task, or a task that does not fit.
    """
    # Tasks of other propositions could be padded too, but a letter would mean different things from row to row.
    if not tasks:
        raise TaskError("there is no task to stack")
    for task in tasks:
        require_same_propositions(
            task.propositions,
            tasks[0].propositions,
            asker=f"the task {task.text!r}",
            knower=f"the first task of the stack, {tasks[0].text!r},",
            remedy="give all tasks of a stack the same ones, Task.from_formula(formula, names)",
        )
    # Propositions are the same, so letters mean the same in every row of the stack; the other sizes may differ.
    if sizes is None:
        sizes = tasks[0].sizes
        for task in tasks:
            sizes = sizes.union(task.sizes)
    padded = [_padded_fields(task, sizes) for task in tasks]
    stacked = {name: np.stack([fields[name] for fields in padded]) for name in padded[0]}
    return _on_device(stacked, tasks[0].propositions)


def _without_spot(
    text: str, propositions: Sequence[str] | None, missing: SpotMissingError
) -> tuple[tuple[str, ...], HoaAutomaton, Structure]:
    """Sigma, the shipped automaton that has the language of a formula, and the formula's structure.

    Raises:
        SpotMissingError: none has.
        TaskError: the formula holds a proposition that is not in Sigma.
    """
    try:
        formula = read_formula(text)
    except UnreadableError:
        raise missing from None
    names = names_of(formula)
    sigma = names if propositions is None else check_propositions(propositions)
    for name in names:
        if name not in sigma:
            raise unknown_proposition(name, sigma, text)
    automaton = find_shipped(formula)
    if automaton is None:
        raise missing
    return sigma, automaton, formula


def _cube_text(cube: Phi, propositions: Sequence[str]) -> str:
    """A cube in words, names as in a formula."""
    names = [in_formula(name) for name in propositions]
    return " & ".join(("" if sign > 0 else "!") + names[i] for i, sign in enumerate(cube) if sign) or "true"


def _on_device(fields: dict[str, np.ndarray], propositions: tuple[str, ...]) -> TaskArrays:
    """Concrete arrays, also where a trace is under way: a task keeps its arrays, and may not keep tracers."""
    # ``Task.arrays`` is cached; a first use within a jitted function would otherwise cache that trace's constants.
    with jax.ensure_compile_time_eval():
        arrays = {name: jnp.asarray(value) for name, value in fields.items()}
    return TaskArrays(**arrays, propositions=propositions)


def _padded_fields(task: Task, sizes: TaskSizes) -> dict[str, np.ndarray]:
    """The fields of ``TaskArrays`` on the host."""
    if not sizes.covers(task.sizes):
        raise TaskError(f"the task '{task.text}' does not fit: it has {task.sizes}, the arrays {sizes}")
    if sizes.propositions > MAX_PROPOSITIONS:
        raise TaskError(f"{sizes.propositions} propositions are too many: a task has at most {MAX_PROPOSITIONS}")
    return _state_fields(task, sizes) | _edge_fields(task, sizes) | _condition_fields(task, sizes)


def _state_fields(task: Task, sizes: TaskSizes) -> dict[str, np.ndarray]:
    dfa = task.dfa
    # Padded states loop: no real state leads to them, and as traps they are never entered.
    transitions = np.repeat(np.arange(sizes.states, dtype=np.int32)[:, None], 2**sizes.propositions, axis=1)
    transitions[: dfa.num_states] = _ignore_padded_propositions(dfa.transitions, sizes)
    return {
        "transitions": transitions,
        "accepting": _grow(dfa.accepting, sizes.states, False),
        "trap": _grow(dfa.trap, sizes.states, True),
        "irrevocable": _grow(_ignore_padded_propositions(task.irrevocable, sizes), sizes.states, False),
        "state_mask": np.arange(sizes.states) < dfa.num_states,
        "initial": np.array(dfa.initial, dtype=np.int32),
    }


def _edge_fields(task: Task, sizes: TaskSizes) -> dict[str, np.ndarray]:
    outcomes, classes = task.outcomes, len(task.classes)
    # Conditions of several cubes follow the padded classes and so move up by the padding.
    compound = outcomes.edge_condition >= classes
    condition = outcomes.edge_condition + np.int32(sizes.classes - classes) * compound
    return {
        "edges": _grow(outcomes.edges, sizes.edges, 0),
        "edge_mask": np.arange(sizes.edges) < len(outcomes.edges),
        "edge_condition": _grow(condition.astype(np.int32), sizes.edges, 0),
    }


def _condition_fields(task: Task, sizes: TaskSizes) -> dict[str, np.ndarray]:
    """Classes keep their indices; the conditions with several cubes follow the padded classes."""
    outcomes, count, propositions = task.outcomes, len(task.classes), len(task.propositions)
    phi = np.zeros((sizes.classes, 2, sizes.propositions), dtype=np.int8)
    phi[:count, :, :propositions] = np.reshape(outcomes.classes, (count, 2, propositions))
    row_of = np.arange(len(outcomes.conditions))
    row_of[count:] += sizes.classes - count
    total = sizes.classes + sizes.compound
    classes = np.full((total, sizes.cubes), NO_CLASS, dtype=np.int32)
    for row, condition in zip(row_of, outcomes.conditions, strict=True):
        classes[row, : len(condition.classes)] = condition.classes
    mask, implies = np.zeros(total, dtype=bool), np.zeros((total, total), dtype=bool)
    mask[row_of] = True
    implies[np.ix_(row_of, row_of)] = outcomes.implies
    own = outcomes.conditions[:count]
    return {
        "class_phi": phi,
        "class_stay": _class_letters([condition.stay for condition in own], propositions, sizes),
        "class_go": _class_letters([condition.go for condition in own], propositions, sizes),
        "class_mask": np.arange(sizes.classes) < count,
        "condition_classes": classes,
        "condition_mask": mask,
        "implies": implies,
    }


def _class_letters(guards: Sequence[np.ndarray], propositions: int, sizes: TaskSizes) -> np.ndarray:
    # Without classes there is no row whose length would say how many letters there are.
    letters = np.reshape(guards, (len(guards), 2**propositions)).astype(bool)
    return _grow(_ignore_padded_propositions(letters, sizes), sizes.classes, False)


def _ignore_padded_propositions(table: np.ndarray, sizes: TaskSizes) -> np.ndarray:
    """Repeats the letters (last axis): the bits above the task's own do not matter."""
    # Padded propositions are the highest bits, so a letter's own bits repeat with the period of the table.
    return np.tile(table, (1, 2**sizes.propositions // table.shape[1]))


def _grow(values: np.ndarray, size: int, fill: int | bool) -> np.ndarray:
    """Pads the first axis to ``size`` entries."""
    return np.pad(values, [(0, size - len(values))] + [(0, 0)] * (values.ndim - 1), constant_values=fill)
