"""Slow and obvious planning: Eq. 3 as a literal recursion over histories, and searches that sample, with dictionaries.

Everything here is derived from the text of the model (sections 3 to 5) with lists, sets and dictionaries; nothing of
the library is used but the arrays that describe a problem. A history is a list of ``(action, outcome)``; whatever is
known is worked out anew from the whole list, by going through every assignment of truth values to the conditions.
"""

import itertools
import math
import random

import numpy as np

FINISH = "finish"


class ReferenceProblem:
    """The arrays of a planning problem as plain values. An action is ``(s, e)`` or ``FINISH``."""

    def __init__(self, problem):
        task = problem.task
        self.accepting = {z for z in range(len(task.accepting)) if task.accepting[z] and task.state_mask[z]}
        self.edges = {
            e: (int(task.edges[e, 0]), int(task.edges[e, 1]), int(task.edge_condition[e]))
            for e in range(len(task.edge_mask))
            if task.edge_mask[e]
        }
        self.subgoals = [s for s in range(len(problem.subgoal_mask)) if problem.subgoal_mask[s]]
        self.robot = len(problem.subgoal_mask)
        self.edge_count = len(task.edge_mask)
        self.cubes = {
            m: [int(c) for c in task.condition_classes[m] if c >= 0]
            for m in range(len(task.condition_mask))
            if task.condition_mask[m]
        }
        implies = np.asarray(task.implies)
        self.implies = [(a, b) for a in self.cubes for b in self.cubes if implies[a, b] and a != b]
        self.travel = np.asarray(problem.travel, dtype=float)
        self.finish = np.asarray(problem.finish, dtype=float)
        self.p = np.asarray(problem.success_probability, dtype=float)
        self.r_s = np.asarray(problem.success_cost, dtype=float)
        self.r_f = np.asarray(problem.failure_cost, dtype=float)
        self.start = int(problem.dfa_state)
        self.dead_end_cost = float(problem.dead_end_cost)
        self.assignments = list(self._assignments())
        self._entailed = {}

    def _assignments(self):
        """All assignments in which implications hold and a condition holds exactly if one of its cubes does."""
        names = sorted(self.cubes)
        for values in itertools.product([False, True], repeat=len(names)):
            world = dict(zip(names, values, strict=True))
            if all(world[m] == any(world[c] for c in cubes) for m, cubes in self.cubes.items()) and all(
                world[b] or not world[a] for a, b in self.implies
            ):
                yield world

    def index(self, action):
        """The library's index of an action."""
        return self.robot * self.edge_count if action == FINISH else action[0] * self.edge_count + action[1]

    def knowledge(self, history, s):
        """What the outcomes beyond subgoal s entail: a dictionary condition -> True or False; unknown is absent."""
        facts = frozenset((self.edges[a[1]][2], outcome) for a, outcome in history if a != FINISH and a[0] == s)
        if facts not in self._entailed:
            worlds = [w for w in self.assignments if all(w[m] == outcome for m, outcome in facts)]
            assert worlds, f"contradiction: {facts}"
            entailed = {}
            for m in self.cubes:
                truths = {w[m] for w in worlds}
                if len(truths) == 1:
                    entailed[m] = truths.pop()
            self._entailed[facts] = entailed
        return self._entailed[facts]

    def estimate(self, history, action):
        """P_S, R_S, R_F of an action, given the history."""
        if action == FINISH:
            return 1.0, 0.0, 0.0
        s, e = action
        condition = self.edges[e][2]
        known = self.knowledge(history, s)
        cubes = sorted(self.cubes[condition], key=lambda c: (self.r_s[s, c], c))
        chance = {c: float(known[c]) if c in known else self.p[s, c] for c in cubes}
        p_success = 1 - math.prod(1 - chance[c] for c in cubes)
        if p_success > 0:
            r_s = 0.0
            for i, c in enumerate(cubes):
                r_s += self.r_s[s, c] * chance[c] * math.prod(1 - chance[other] for other in cubes[:i])
            r_s /= p_success
        else:
            r_s = min((self.r_s[s, c] for c in cubes if known.get(c) is not False), default=0.0)
        if condition in known:
            p_success = 1.0 if known[condition] else 0.0
        return p_success, r_s, max(self.r_f[s, c] for c in cubes)

    def end(self, action, outcome):
        """Location and state after an action."""
        s, e = action
        return s, (self.edges[e][1] if outcome else self.edges[e][0])

    def situation(self, history):
        """Location, state and the pending cost after the history."""
        if not history:
            return self.robot, self.start, 0.0
        action, outcome = history[-1]
        _, r_s, r_f = self.estimate(history[:-1], action)
        return *self.end(action, outcome), (r_s if outcome else r_f)

    def visited(self, history):
        """(Location, state) pairs since the history last learnt something."""
        pairs = [(self.robot, self.start)]
        for i, (action, outcome) in enumerate(history):
            if self.edges[action[1]][2] not in self.knowledge(history[:i], action[0]):
                pairs = []
            pairs.append(self.end(action, outcome))
        return pairs

    def distance(self, history, action):
        """D: the pending cost and the path cost; nothing for going on beyond the same subgoal in the same state."""
        location, state, pending_cost = self.situation(history)
        if action == FINISH:
            return pending_cost + self.finish[location, state]
        s, e = action
        source = self.edges[e][0]
        if (location, state) == (s, source):
            return 0.0
        return pending_cost + self.travel[location, state, s, source]

    def actions(self, history):
        """A(b_h), in the order of their indices."""
        _, state, _ = self.situation(history)
        if state in self.accepting:
            return []
        visited = self.visited(history)
        found = []
        for s in self.subgoals:
            known = self.knowledge(history, s)
            for e in self.edges:
                action = (s, e)
                returns = known.get(self.edges[e][2]) is True and self.end(action, True) in visited
                if (
                    math.isfinite(self.distance(history, action))
                    and self.estimate(history, action)[0] > 0
                    and not returns
                ):
                    found.append(action)
        if math.isfinite(self.distance(history, FINISH)):
            found.append(FINISH)
        return found


class Recursion:
    """Eq. 3 as it is written. With ``remember``, the value of a history is looked up if it was worked out before for
    one with the same outcomes, location, state, pending cost and visits, in whatever order it got there."""

    def __init__(self, problem, remember=True):
        self.problem, self.memo = problem, ({} if remember else None)

    def q(self, history, action):
        """Q(b_h, a)."""
        p, r_s, r_f = self.problem.estimate(history, action)
        cost = self.problem.distance(history, action)
        if action == FINISH:
            return cost
        cost += p * (r_s + self.value([*history, (action, True)]))
        if p < 1:
            cost += (1 - p) * (r_f + self.value([*history, (action, False)]))
        return cost

    def value(self, history=()):
        """Least Q after a history; 0 where the task is satisfied, the dead-end cost where nothing is left to do."""
        history, problem = list(history), self.problem
        location, state, pending_cost = problem.situation(history)
        if state in problem.accepting:
            return 0.0
        if self.memo is None:
            return self._least(history)
        facts = frozenset((a[0], problem.edges[a[1]][2], outcome) for a, outcome in history)
        key = (location, state, pending_cost, facts, frozenset(problem.visited(history)))
        if key not in self.memo:
            self.memo[key] = self._least(history)
        return self.memo[key]

    def _least(self, history):
        return min((self.q(history, a) for a in self.problem.actions(history)), default=self.problem.dead_end_cost)


def sampled_search(problem, simulations, exploration, seed=0):
    """UCT on histories, but with expected instead of mean costs: {action: Q} and {action: visits} at the root.

    Nodes are dictionaries keyed by the history; a new action is valued by a rollout's cost, each action first of all
    tried once.
    """
    rng = random.Random(seed)
    q_values, visits, values = {}, {}, {}

    def simulate(history):
        key = tuple(history)
        if problem.situation(history)[1] in problem.accepting:
            return 0.0
        actions = problem.actions(history)
        if not actions:
            return problem.dead_end_cost
        q, n = q_values.setdefault(key, {}), visits.setdefault(key, dict.fromkeys(actions, 0))
        total = sum(n.values()) + 1

        def bound(action):
            return q[action] - exploration * math.sqrt(math.log(total) / n[action]) if n[action] else -math.inf

        action = min(actions, key=bound)
        if action == FINISH:
            q[action] = problem.distance(history, action)
        else:
            p, r_s, r_f = problem.estimate(history, action)
            outcome = rng.random() < p
            values[(*key, (action, outcome))] = simulate([*history, (action, outcome)])
            success_value, failure_value = values.get((*key, (action, True))), values.get((*key, (action, False)))
            # An outcome that was not sampled yet is worth what the other is.
            success_value, failure_value = (
                (failure_value if success_value is None else success_value),
                (success_value if failure_value is None else failure_value),
            )
            q[action] = problem.distance(history, action) + p * (r_s + success_value) + (1 - p) * (r_f + failure_value)
        n[action] += 1
        return min(q.values())

    for _ in range(simulations):
        simulate([])
    return q_values[()], visits[()]


def literal_pouct(problem, simulations, exploration, uniform):
    """PO-UCT, literally as in the paper and its authors' code: visits and mean cost of each action at the root.

    Every new history ends a simulation and is worth nothing beyond the cost so far. ``uniform(simulation, level)`` are
    the random numbers.
    """
    known, counts, means = {()}, {}, {}
    for simulation in range(simulations):
        history, steps = [], []
        while True:
            key, actions = tuple(history), problem.actions(history)
            if problem.situation(history)[1] in problem.accepting:
                value = 0.0
                break
            if not actions or key not in known:
                value = 0.0 if actions else problem.dead_end_cost
                known.add(key)
                break
            count = counts.setdefault(key, dict.fromkeys(actions, 0))
            mean = means.setdefault(key, dict.fromkeys(actions, 0.0))
            untried = [a for a in actions if not count[a]]
            log = math.log(sum(count.values()) + 1)
            action = untried[0] if untried else min(actions, key=lambda a: _ucb(mean[a], count[a], log, exploration))
            cost = problem.distance(history, action)
            if action == FINISH:
                steps.append((key, action, cost))
                value = 0.0
                break
            chance, r_s, r_f = problem.estimate(history, action)
            outcome = uniform(simulation, len(history)) < chance
            steps.append((key, action, cost + (r_s if outcome else r_f)))
            history = [*history, (action, outcome)]
        for key, action, cost in reversed(steps):
            value += cost
            counts[key][action] += 1
            means[key][action] += (value - means[key][action]) / counts[key][action]
    return counts[()], means[()]


def _ucb(mean, count, log, exploration):
    return mean - exploration * math.sqrt(log / count)
