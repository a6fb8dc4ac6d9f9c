"""Best-first search on bounds over a graph of histories: the default search, of the family of AO*.

This is not the search of the paper, which is PO-UCT (``search.uct``). It is deterministic: nothing is sampled, and no
key is used. AO* grows a graph of choices (OR) and outcomes (AND) along the policy that looks best, and backs up
expectations and minima, as this does. Three things are different. The leaf to expand is found as in bounded real-time
dynamic programming and HSVI, by following the widest gap, but without their random outcomes. The estimates at leaves
are guesses, which may be too high: the search first discounts them by a fixed fraction, which is no bound but leads to
good choices soon, and then goes on with admissible bounds. What dead ends cost in a guess is not discounted: the
probability that all attempts fail hardly depends on their order, and where a dead end costs much, everything else would
be lost in its discount. And the search ends when it is spent, proven or not.

Values are those of Eq. 3 itself: expectations over both outcomes, minima over actions. Outcomes that have no node yet
have a guessed value (``search.guess``). Beside its value every node has a **bound**, its value if every guess, apart
from what dead ends cost in it, were too high by the fraction ``optimism``, and a **floor**, its value if every guess
were 0. One simulation of all rows of a batch is

1. **descend** (``search.descending``): from the root, take the action of least bound (at the root itself not always:
   see "Tries" there), and of its two outcomes the one that contributes more to the gap between value and bound, until
   an outcome without a node is reached. Where no gap between value and bound is left at the root, the descent does the
   same with floors in place of bounds: it **certifies**. Only reads.
2. **expand** (``search.expanding``): give that outcome a node, or find the one that another order of the same events
   led to.
3. **back up** (``search.backing_up``) values, bounds and floors along the descent. Only writes.

Once value and floor of the root are equal the search ends.

**A search that has ended is exact**, up to rounding, unless its status has an overflow. (1) Costs are not negative, so
that 0 is no more than what follows any outcome; Eq. 3 is monotone in these; so no floor exceeds the true cost, also a
floor computed earlier, from children that have grown since. (2) Let the root's value equal its floor. The action of
least value has a floor no greater than its value, and no less than the root's floor: both are equal. They were computed
together, by the same operations, from values and floors of its outcomes, which therefore were equal too where they have
a probability. A guess is never equal to its floor of 0 (``expanding.LEAST_GUESS``), so that these outcomes had nodes,
satisfied the task, or were dead ends; and so on down to the end of every history. So the value is the cost of a policy
that rests on no guess, and no less than the optimum. By (1) it is no more.

**Every search ends**, given simulations and memory. While value and floor (or bound) of the root differ, the action of
least floor has a gap, hence one of its outcomes, and so on: the descent meets an outcome without a node and links it to
one, or it meets stored numbers that are older than their children's and renews them. There are finitely many histories,
and fewer tries than actions.

All reads of a simulation come before its writes, so that XLA updates the arrays in place and the cost of a simulation
does not depend on their size.

References:
  Nilsson, Principles of Artificial Intelligence, 1980 (AO*).
  Martelli and Montanari, Additive AND/OR graphs, IJCAI 1973; Optimizing decision trees through heuristically guided
    search, CACM 1978.
  Hansen and Zilberstein, LAO*: a heuristic search algorithm that finds solutions with loops, AIJ 2001.
  Smith and Simmons, Heuristic search value iteration for POMDPs, UAI 2004 (HSVI): outcomes chosen by their gap.
  McMahan, Likhachev and Gordon, Bounded real-time dynamic programming, ICML 2005: the same for known states.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, UInt32

from potlp_jax.planning.history import terms_of_all
from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.planning.search.backing_up import back_up, count_descent
from potlp_jax.planning.search.config import BestFirstConfig
from potlp_jax.planning.search.context import Context, reachable_states, relevant_conditions, root_costs
from potlp_jax.planning.search.descending import descend
from potlp_jax.planning.search.expanding import expand, new_node
from potlp_jax.planning.search.graph import Tree, plant_tree
from potlp_jax.planning.search.lockstep import SearchKernel, SearchMethod
from potlp_jax.planning.search.model import make_model
from potlp_jax.planning.search.native import LIBRARY, fits_kernel, search_natively
from potlp_jax.planning.search.plan import Plan, plan_of_least_score
from potlp_jax.planning.search.rule import make_rule
from potlp_jax.planning.search.successes import value_successes


def prepare(problems: PlanningProblem, seeds: UInt32[Array, "B 2"], config: BestFirstConfig) -> Context:
    """Tables, guessing rule and optimism of a batch of problems.

    Args:
      problems: every leaf has the leading axis B.
      seeds: without effect: nothing is sampled, but every search has the same verbs.
      config: ``guess_failures`` and ``optimism`` matter.

    Returns:
      What the other verbs look up.
    """
    del seeds
    model = make_model(problems)
    # From travel and attempts alone: knowledge can only take actions away.
    reach = jax.vmap(reachable_states)(model.tables)
    # The rule values successes with the chances of the root, where nothing is known.
    terms = jax.vmap(terms_of_all)(model.tables, model.root)
    rule = value_successes(
        make_rule(model.tables, model.product_states, reach, problems.dead_end_cost),
        model.tables,
        terms.success_probability,
        terms.success_cost,
        config.guess_failures,
    )
    return Context(
        model=model,
        rule=rule,
        relevant=jax.vmap(relevant_conditions)(model.tables, reach),
        optimism=jnp.full(problems.dfa_state.shape, config.optimism, jnp.float32),
    )


def plant(context: Context, config: BestFirstConfig) -> Tree:
    """Graphs of the roots alone."""
    # The root is a node like any other: its values are guesses until it is searched.
    root = new_node(context, context.model.root, config)
    return plant_tree(context.model, root, config)


def is_open(context: Context, tree: Tree) -> Bool[Array, "B"]:
    """Whether a gap between value and floor is left at the root, so that more simulations can change something."""
    root = root_costs(context, tree)
    return root.value > root.floor


def simulate(context: Context, tree: Tree, active: Bool[Array, "B"], config: BestFirstConfig) -> Tree:
    """One descent of all rows that are active.

    Args:
      context: of the problems.
      tree: the graphs.
      active: rows that descend; only rows that are open (``is_open``).
      config: ``max_depth`` bounds the descent.

    Returns:
      The graphs with at most one more node each; rows that are not active are unchanged.
    """
    # Reads first, writes last: see the module.
    descent = descend(context, tree, active, config)
    tree, leaf = expand(context, tree, descent, config)
    return count_descent(back_up(tree, descent, leaf), descent)


def choose(context: Context, tree: Tree) -> Plan:
    """The action of least Q at the root."""
    root = root_costs(context, tree)
    # Q, not the bound: the bound says where to look, Q what is believed. At the root nothing is pending.
    q_values = tree.q_values[:, Tree.ROOT]
    return plan_of_least_score(context.model, q_values, q_values, tree.root_visits, root.bound, root.floor, tree.status)


BEST_FIRST = SearchMethod(
    tree=Tree,
    prepare=prepare,
    plant=plant,
    is_open=is_open,
    simulate=simulate,
    choose=choose,
    kernel=SearchKernel(library=LIBRARY, fits=fits_kernel, run=search_natively),
)
