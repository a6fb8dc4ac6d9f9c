"""Faults of the native kernels: their twins in JAX must notice."""

from eval.mutants.mutant import Mutant

PART = "native kernels"

_KERNELS = "potlp_jax/native/kernels"
_SEARCH = f"{_KERNELS}/search.cc"
_SEARCH_TESTS = ("tests/test_native_search.py",)
_TWINS = ("tests/test_native_twins.py",)


def _of_search(says: str, old: str, new: str) -> Mutant:
    return Mutant(PART, says, _SEARCH, old, new, _SEARCH_TESTS)


def _of(name: str, says: str, old: str, new: str, only: str) -> Mutant:
    return Mutant(PART, says, f"{_KERNELS}/{name}", old, new, _TWINS, only)


MUTANTS = (
    _of_search(
        "the search discounts what dead ends cost in a guess",
        "lesser((1.0f - optimism) * guess + optimism * dead_ends, guess)",
        "lesser((1.0f - optimism) * guess, guess)",
    ),
    _of_search(
        "the search tries actions from the first simulation on",
        "return simulations_ >= kSimulationsBeforeTries * available ? least : kNone;",
        "return least;",
    ),
    _of_search(
        "the search tries the action of largest bound",
        "(least == kNone || bound[i] < bound[least])) least = i;",
        "(least == kNone || bound[i] > bound[least])) least = i;",
    ),
    _of_search(
        "the search finds no history again",
        "== key[0] && static_cast<uint32_t>(entry[1]) == key[1]",
        "== key[0] && static_cast<uint32_t>(entry[1]) == key[0]",
    ),
    _of_search(
        "the backup leaves the pending cost out of a bound",
        "lesser(pending + values.leave.bound, values.stay.bound)",
        "lesser(values.leave.bound, values.stay.bound)",
    ),
    _of_search(
        "the search goes round in circles",
        "(visited & actions_[own.action[i]].end)) path_[i] = kInf;",
        "(visited & actions_[own.action[i]].end)) path_[i] += 0;",
    ),
    _of_search(
        "a descent that is cut is not flagged",
        "if (descent.active) status_ |= kDepthOverflow;",
        "",
    ),
    _of_search(
        "a chain forgets where it has failed",
        "chain.failed[action.subgoal] |= action.backward;",
        "",
    ),
    _of_search(
        "a search that certifies looks at bounds",
        "const float* low = (certifies ? floor_ : bound_).data() + node.first;",
        "const float* low = bound_.data() + node.first;",
    ),
    _of_search(
        "a dead end after a success is that of its failure",
        "as_guesses(load(own.after_success.data() + i), load(own.dead_end.data() + i) * dead_end_cost_)",
        "as_guesses(load(own.after_success.data() + i), load(dead_end_without_.data() + i) * dead_end_cost_)",
    ),
    _of(
        "distances.cc",
        "a wildcard does not stay in its state",
        "if (next == state || successors.typed_data()",
        "if (successors.typed_data()",
        "distances or tables",
    ),
    _of(
        "distances.cc",
        "paths between portals cross cells of letters",
        "if ((kind & kNeutral) && reached < cost_[there]) {",
        "if (reached < cost_[there]) {",
        "tables or only_way",
    ),
    _of(
        "grid_search.h",
        "moves cut corners",
        "(above[column] & left) | (above[column] & right) << 2",
        "above[column] | (above[column] & right) << 2",
        "distances",
    ),
    _of(
        "labels.cc",
        "hidden paths come back over every observed cell",
        "return kind & kWayBack ? kSeen : -1;",
        "return kind & kObserved ? kSeen : -1;",
        "labels",
    ),
    _of(
        "paths.cc",
        "the last of several predecessors",
        "if (arriving < least && leads(state, place)) {",
        "if (arriving <= least && leads(state, place)) {",
        "paths",
    ),
    _of(
        "frontiers.cc",
        "the last of several cells nearest the centroid",
        "if (off_centre < least) {",
        "if (off_centre <= least) {",
        "components",
    ),
    _of(
        "square_ways.cc",
        "a way keeps the obstacles of the one before",
        "along[lane] = less ? met : along[lane];",
        "along[lane] = least[lane] > 0 ? along[lane] : met;",
        "ways",
    ),
    _of(
        "camera.cc",
        "a look goes through the first obstacle on each ray",
        "for (int64_t step = 1; step < steps && !going.empty(); ++step) {",
        "for (int64_t step = 2; step < steps && !going.empty(); ++step) {",
        "looks",
    ),
    _of(
        "camera.cc",
        "a cell on the border of two columns is painted from the earlier one",
        "back = turn + ((look & kOnBorder) ? 0 : 1);",
        "back = turn + 1;",
        "looks",
    ),
    _of(
        "camera.cc",
        "a look from afar replaces a nearer one",
        "if (!(away < distance[at]) || away > farthest) continue;",
        "if (away > farthest) continue;",
        "looks",
    ),
    _of(
        "camera.cc",
        "an obstacle is not painted beyond its side",
        "(occupied.typed_data()[at] ? kHalfDiagonal : 0.0f)",
        "0.0f",
        "looks",
    ),
    _of(
        "camera.cc",
        "what pads the map is painted too",
        "std::min<int64_t>(height, extent.typed_data()[0])",
        "height",
        "looks",
    ),
)
