"""One decision for people and programs: the table of its actions."""

import dataclasses
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table

from potlp_jax.codec import finite_or_null
from potlp_jax.trials.record import ActionRecord, Decision, Trial
from potlp_jax.types import status_names


def rank_actions(decision: Decision) -> list[ActionRecord]:
    """Actions by expected cost, the chosen one first among equals."""
    return sorted(decision.actions, key=lambda action: (action.q_value, action.index != decision.choice, action.index))


def action_name(action: ActionRecord) -> str:
    """``finish``, or the subgoal and the transition that is tried beyond it."""
    if action.subgoal is None:
        return "finish"
    return f"s{action.subgoal}: {action.from_state}→{action.to_state}"


def action_table(trial: Trial, decision: Decision) -> Table:
    """The actions of a decision by expected cost, the chosen one marked."""
    caption = f"expected cost {decision.value:.2f}; costs in units of resolution"
    table = Table(
        title=describe_decision(trial, decision),
        caption=caption,
        title_justify="left",
        box=SIMPLE_HEAD,
        caption_justify="left",
    )
    table.add_column("", width=1)
    table.add_column("action", no_wrap=True)
    table.add_column("subgoal")
    for name in ("P_S", "R_S", "R_F", "D", "Q", "visits"):
        table.add_column(name, justify="right")
    for action in rank_actions(decision):
        chosen = action.index == decision.choice
        place = "-" if action.cell is None else f"{action.cell[0]},{action.cell[1]}"
        table.add_row(
            "*" if chosen else "",
            action_name(action),
            place,
            f"{action.success_probability:.3f}",
            *(f"{value:.1f}" for value in (action.success_cost, action.failure_cost, action.distance, action.q_value)),
            str(action.visits),
            style="bold" if chosen else None,
        )
    return table


def describe_decision(trial: Trial, decision: Decision) -> str:
    """Where and when the decision was made, and what it led to, in one line."""
    went = "nowhere" if decision.target is None else f"cell {decision.target} in state {decision.target_state}"
    better = decision.overruled
    kept = "" if better is None else f", kept although {action_name(better)} is better"
    return (
        f"decision {decision.index} of {trial.policy} (step {decision.step}): cell {decision.cell} in state "
        f"{decision.state}, {decision.kind} toward {went}{kept}"
    )


def decision_to_dict(decision: Decision) -> dict[str, Any]:
    """JSON-able values of a decision, actions by expected cost; what is infinite becomes None, status bits names."""
    ranked = dataclasses.replace(decision, actions=tuple(rank_actions(decision)))
    return finite_or_null({**dataclasses.asdict(ranked), "status": list(status_names(decision.status))})
