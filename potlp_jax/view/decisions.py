"""One decision for people and programs: its actions in words, their figures, and the table of them."""

import dataclasses
import math
from collections import Counter
from collections.abc import Mapping
from functools import lru_cache
from types import MappingProxyType
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table

from potlp_jax.codec import finite_or_null
from potlp_jax.task.task import Task
from potlp_jax.task.words import state_words, transition_words
from potlp_jax.trials.record import ActionRecord, Decision, Trial
from potlp_jax.types import Status, status_names

FIGURES: Mapping[str, str] = MappingProxyType(
    {
        "P_S": "probability that the attempt beyond the subgoal succeeds",
        "R_S": "expected cost beyond the subgoal if it succeeds",
        "R_F": "expected cost beyond the subgoal if it fails",
        "D": "path cost to the subgoal in known space",
        "Q": "expected cost of the rest of the task if this action is taken now",
        "visits": "simulations of the search that began with this action",
    }
)
"""What the columns of an action's table mean; costs are in units of the map's resolution."""

KINDS: Mapping[str, str] = MappingProxyType(
    {
        "finish": "finish the task in known space",
        "frontier": "go to the nearest frontier that violates nothing",
        "fallback": "no action is available: go to the nearest frontier that violates nothing",
        "optimistic": "go where the task could be finished if unseen cells were as one wishes",
        "none": "nothing can be done",
    }
)
"""What a decision is for where it is no attempt beyond a subgoal, by ``Decision.kind``."""


# Of an invalid decision it cannot be said that no action is available: none was looked for.
_INVALID_KINDS: Mapping[str, str] = MappingProxyType({**KINDS, "fallback": KINDS["frontier"]})


@lru_cache(maxsize=8)
def _task(hoa: str, propositions: tuple[str, ...], max_positive_literals: int | None) -> Task:
    return Task.from_hoa(hoa, propositions, max_positive_literals)


def task_of(trial: Trial) -> Task:
    """The task of a record; the last few are kept, because every decision of a trial asks for it."""
    return _task(trial.task_hoa, trial.propositions, trial.max_positive_literals)


def rank_actions(decision: Decision) -> list[ActionRecord]:
    """Actions by expected cost, the chosen one first among equals."""
    # Ties occur, for instance where nothing leads on and all actions cost infinity: the index keeps tables repeatable.
    return sorted(decision.actions, key=lambda action: (action.q_value, action.index != decision.choice, action.index))


def chosen_action(decision: Decision) -> ActionRecord | None:
    """The action that was taken; None unless the policy searched."""
    return next((action for action in decision.actions if action.index == decision.choice), None)


def action_name(action: ActionRecord, task: Task) -> str:
    """``finish``, or the subgoal and the transition that is tried beyond it, such as ``s2: find alarm``."""
    if action.subgoal is None:
        return "finish"
    # Only the finish action has no transition.
    assert action.from_state is not None
    assert action.to_state is not None
    return f"s{action.subgoal}: {transition_words(task, action.from_state, action.to_state, brief=True)}"


def action_names(decision: Decision, task: Task, *, letters: int | None = None) -> dict[int, str]:
    """The names of a decision's actions; those that would read the same end in their states: ``s8: find key (5→7)``.

    Args:
        decision: whose actions are named.
        task: says what they try.
        letters: to which a name is cut; default: none is.

    Returns:
        One name an action, by its index.
    """
    whole = {action.index: action_name(action, task) for action in decision.actions}
    names = {index: name if letters is None else shortened(name, letters) for index, name in whole.items()}
    alike = Counter(names.values())
    for action in decision.actions:
        if alike[names[action.index]] > 1:
            end, name = f" ({action.from_state}→{action.to_state})", whole[action.index]
            names[action.index] = (name if letters is None else shortened(name, letters - len(end))) + end
    return names


def shortened(text: str, letters: int) -> str:
    """The text in so many letters at most, cut within a word if need be: names without spaces are long."""
    return text if len(text) <= letters else text[: letters - 3].rstrip() + "..."


def why_no_actions(trial: Trial, decision: Decision) -> str:
    """Why a decision weighed no actions, one sentence."""
    if decision.status & Status.INVALID:
        return "an input of this decision was not allowed, such as an estimate that is NaN: no actions were weighed"
    if decision.status & (Status.DEAD_END | Status.ACCEPTING_ROOT):
        return "the policy searched, and no action was available"
    return f"policy {trial.policy} does not search: it weighed no actions"


def action_table(trial: Trial, decision: Decision) -> Table:
    """The actions of a decision by expected cost, the chosen one marked, with what the columns mean below."""
    meanings = "; ".join(f"{name}: {meaning}" for name, meaning in FIGURES.items())
    table = Table(
        title=describe_decision(trial, decision),
        caption=f"expected cost {decision.value:.2f}, in units of resolution as are all costs. {meanings}",
        title_justify="left",
        box=SIMPLE_HEAD,
        caption_justify="left",
        # Its twelve columns have to fit the 80 of a terminal.
        padding=0,
        pad_edge=False,
    )
    table.add_column("", width=1)
    # Words may wrap; a number that is broken into two lines is misread.
    table.add_column("action", min_width=16)
    for name in ("states", "subgoal"):
        table.add_column(name, no_wrap=True)
    for name in FIGURES:
        table.add_column(name, justify="right", no_wrap=True)
    for action in rank_actions(decision):
        chosen = action.index == decision.choice
        table.add_row(
            "*" if chosen else "",
            action_name(action, task_of(trial)),
            "-" if action.subgoal is None else f"{action.from_state}→{action.to_state}",
            "-" if action.cell is None else f"{action.cell[0]},{action.cell[1]}",
            *figure_texts(action, digits=3),
            style="bold" if chosen else None,
        )
    return table


def figure_texts(action: ActionRecord, *, digits: int = 2) -> list[str]:
    """The values of the columns ``FIGURES``; probabilities with ``digits`` digits, costs with one."""
    costs = (action.success_cost, action.failure_cost, action.distance, action.q_value)
    return [f"{action.success_probability:.{digits}f}", *map(cost_text, costs), str(action.visits)]


def cost_text(value: float) -> str:
    """A cost with one digit; infinity as a sign."""
    # Costs are tens to hundreds: a second digit would only widen the columns.
    return f"{value:.1f}" if math.isfinite(value) else "∞"


def decision_number(trial: Trial, decision: Decision) -> str:
    """Which decision it is. Numbers count from 0, as in the record and in ``potlp explain FOLDER:NUMBER``."""
    return f"decision {decision.index} (last: {len(trial.decisions) - 1})"


def describe_decision(trial: Trial, decision: Decision) -> str:
    """Where and when the decision was made, and what it led to, in one line."""
    row, column = decision.cell
    return (
        f"decision {decision.index} of {trial.policy}, step {decision.step}: at cell {row},{column} in state "
        f"{decision.state} ({state_words(task_of(trial), decision.state)}): {describe_move(trial, decision)}"
    )


def describe_move(trial: Trial, decision: Decision) -> str:
    """What was decided: the attempt and where it is made, or why the robot went elsewhere."""
    target = "" if decision.target is None else f" at {decision.target[0]},{decision.target[1]}"
    chosen, names = chosen_action(decision), action_names(decision, task_of(trial))
    if decision.status & Status.INVALID:
        # Whatever the robot did, no action was weighed.
        move = (
            f"the inputs were invalid, nothing was planned: {_INVALID_KINDS.get(decision.kind, decision.kind)}{target}"
        )
    elif chosen is None or chosen.subgoal is None:
        move = KINDS.get(decision.kind, decision.kind) + target
    else:
        # The cell stands after the subgoal's number: "s2 at 11,30: find alarm".
        move = names[chosen.index].replace(":", f"{target}:", 1)
    # Hysteresis: the robot keeps its target unless another is clearly better (docs/model.md, section 8).
    better = decision.overruled
    kept = "" if better is None else f"; kept although {names[better.index]} is better"
    return move + kept + _setbacks(decision)


def _setbacks(decision: Decision) -> str:
    """What a robot had failed to get to before, and whether it failed now; empty in simulation."""
    aside = f"; {len(decision.set_aside)} cells were set aside after failed legs" if decision.set_aside else ""
    return aside + (f"; the robot failed: {decision.failure}" if decision.failure else "")


def decision_to_dict(decision: Decision) -> dict[str, Any]:
    """JSON-able values of a decision, actions by expected cost; what is infinite becomes None, status bits names."""
    ranked = dataclasses.replace(decision, actions=tuple(rank_actions(decision)))
    return finite_or_null({**dataclasses.asdict(ranked), "status": list(status_names(decision.status))})
