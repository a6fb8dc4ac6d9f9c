"""pomdp-py's PO-UCT (its class ``POUCT``, in Cython) on our planning problems.

The model is the belief MDP of the paper's rollouts: a state is a history (what is known, where the robot is), the
observation says whether an action succeeded, and the outcome is drawn with P_S from the planner's own generator. That
is equivalent to drawing all conditions of a world beforehand and looking them up, and cheaper. Histories and their
actions are made once and kept, so that what a simulation costs is pomdp-py's own work and one look-up a step.

pomdp-py maximises rewards: a reward is a negative cost, the discount is 1. Its tree is the one of
``pouct_numba``: untried actions first, then ``mean + C * sqrt(log n / n_a)``, mean backups; the action of the best mean
is its answer, the one tried most often is reported beside it. A simulation ends at a new history, as the paper's
authors have it; ``rollouts=True`` goes on from there with random actions, pomdp-py's default: several times slower, and
worse, since random actions wander about.

References:
  Zheng and Tellex, pomdp_py: A Framework to Build and Solve POMDP Problems, ICAPS 2020 workshop.
"""

import importlib
import random
from typing import Any

import numpy as np

from eval.bench.opponents.pouct_numba import (
    ACCEPTED,
    DISTANCE,
    FAILURE_COST,
    INDEX,
    OPTION,
    PROBABILITY,
    SUCCEEDED,
    SUCCESS_COST,
    Histories,
    RootStatistics,
)
from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.types import NO_ACTION

pomdp_py: Any = importlib.import_module("pomdp_py")
"""By name: an optional package, compiled and without type information."""

MAX_DEPTH = 1000
"""Actions per simulation; rollouts end long before."""


class _State(pomdp_py.State):
    """A history: ``moves`` holds for each of its actions P_S, and cost and next state of failure and of success."""

    __slots__ = ("moves", "node")
    __eq__, __hash__ = object.__eq__, object.__hash__

    def __init__(self, node: int) -> None:
        self.node = node
        self.moves: dict[Any, list[Any]] | None = None


class _Action(pomdp_py.Action):
    """An action of the problem by the library's index; equal only to itself, for fast look-ups."""

    __slots__ = ("index",)
    __eq__, __hash__ = object.__eq__, object.__hash__

    def __init__(self, index: int) -> None:
        self.index = index


class _Outcome(pomdp_py.Observation):
    """Failure or success; equal only to itself."""

    __eq__, __hash__ = object.__eq__, object.__hash__


_OUTCOMES = (_Outcome(), _Outcome())
_STOP = _Action(NO_ACTION)
_END = _State(ACCEPTED)
_END.moves = {_STOP: [0.0, 0.0, _END, 0.0, _END]}


class _Problem(pomdp_py.BlackboxModel):
    """``sample(state, action)`` as pomdp-py asks for it; ``steps`` counts the actions simulated."""

    def __init__(self, problem: PlanningProblem, seed: int) -> None:
        self._histories = Histories(problem)
        self._dead_end_cost = float(problem.dead_end_cost)
        self._actions = [_Action(index) for index in range(problem.action_count)]
        self._index = self._histories.model.options[:, INDEX].tolist()
        self.generator = random.Random(seed)
        self.root = _State(0)
        self.steps = 0

    @property
    def size(self) -> int:
        """Histories met."""
        return self._histories.size

    def moves(self, state: _State) -> dict[Any, list[Any]]:
        """The actions of a state; ``_STOP`` alone where there is nothing left to do."""
        if state.moves is None:
            rows = self._histories.listed(state.node)
            here, actions, index = slice(rows.start, rows.stop), self._actions, self._index
            links = self._histories.tree.links[here].tolist()
            terms = self._histories.tree.terms[here].tolist()
            state.moves = {
                actions[index[link[OPTION]]]: [
                    term[PROBABILITY],
                    term[DISTANCE] + term[FAILURE_COST],
                    at,
                    term[DISTANCE] + term[SUCCESS_COST],
                    _END if link[SUCCEEDED] == ACCEPTED else at,
                ]
                for at, link, term in zip(rows, links, terms, strict=True)
            }
        return state.moves or {_STOP: []}

    def sample(self, state: _State, action: _Action) -> tuple[Any, Any, float, int]:
        """Next state, observation, reward, steps taken: so many when stopping that the simulation ends."""
        if action is _STOP:
            return _END, _OUTCOMES[0], 0.0, MAX_DEPTH
        self.steps += 1
        move = self.moves(state)[action]
        success = self.generator.random() < move[0]
        at = 4 if success else 2
        after = move[at]
        if type(after) is int:
            after = _State(self._histories.follow(state.node, after, success))
            if _STOP in self.moves(after):
                # The way into a dead end costs what the dead end costs.
                move[at - 1] += self._dead_end_cost
                after = _END
            move[at] = after
        return after, _OUTCOMES[success], -move[at - 1], 1


class _Policy(pomdp_py.RolloutPolicy):
    """What can be done, and what rollouts do."""

    def __init__(self, problem: _Problem, rollouts: bool) -> None:
        self._problem, self._rollouts = problem, rollouts

    def get_all_actions(self, state: _State, history: Any = None) -> Any:
        """Available actions of a state."""
        return self._problem.moves(state)

    def rollout(self, state: _State, history: Any = None) -> _Action:
        """A random action, or the end."""
        if not self._rollouts:
            return _STOP
        return self._problem.generator.choice(list(self._problem.moves(state)))


class _Belief(pomdp_py.GenerativeDistribution):
    """The root for certain."""

    def __init__(self, state: _State) -> None:
        self._state = state

    def random(self) -> _State:
        return self._state


class PomdpPySearch:
    """A search of one problem that can be continued."""

    def __init__(
        self, problem: PlanningProblem, *, seed: int = 0, exploration: float = 50.0, rollouts: bool = False
    ) -> None:
        """Prepare the search.

        Args:
          problem: the unbatched problem.
          seed: of the outcomes drawn and of the rollouts.
          exploration: C, in the unit of cost.
          rollouts: whether random actions follow a new history, pomdp-py's default.
        """
        self._model = _Problem(problem, seed)
        self._policy = _Policy(self._model, rollouts)
        self._agent = pomdp_py.Agent(_Belief(self._model.root), self._policy, blackbox_model=self._model)
        self._action_count, self._exploration, self._simulations = problem.action_count, exploration, 0

    def run(self, simulations: int) -> None:
        """Add simulations."""
        planner = pomdp_py.POUCT(
            max_depth=MAX_DEPTH,
            planning_time=-1.0,
            num_sims=simulations,
            discount_factor=1.0,
            exploration_const=self._exploration,
            num_visits_init=0,
            rollout_policy=self._policy,
        )
        planner.plan(self._agent)
        self._simulations += simulations

    def statistics(self) -> RootStatistics:
        """What the root knows now; ``nodes`` counts the histories met, those of rollouts included."""
        visits, means = np.zeros(self._action_count, np.int64), np.full(self._action_count, np.inf)
        for action, node in self._agent.tree.children.items() if self._simulations else ():
            if action is not _STOP and node.num_visits > 0:
                visits[action.index], means[action.index] = node.num_visits, -node.value
        return RootStatistics(
            most_visited=int(np.argmax(visits)) if visits.any() else NO_ACTION,
            least_mean=int(np.argmin(means)) if visits.any() else NO_ACTION,
            visits=visits,
            means=means,
            simulations=self._simulations,
            mean_depth=self._model.steps / max(self._simulations, 1),
            nodes=self._model.size,
        )
