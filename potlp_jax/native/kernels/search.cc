// Best-first search on bounds over a graph of histories: the twin of potlp_jax/planning/search/best_first.py.
//
// The whole search of a row of a batch in one call, with the same operations in the same order, so that plans are equal
// bit for bit; the Python modules say why things are as they are. What differs is what is left out: actions that are
// padding or that no rollout can reach have no entries, and a node has entries only for actions that its state of the
// automaton leads to. Entries of actions that are not available cost inf, as does the padding to whole lanes.
//
// Names are those of the twin: R_S success_cost, R_F failure_cost, a product state is location * Z + state.

#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#ifdef __AVX__
#include <immintrin.h>
#endif

#include "rows.h"
#include "xla/ffi/api/ffi.h"

namespace ffi = xla::ffi;

namespace {

using Set = uint32_t;

constexpr float kInf = INFINITY;
constexpr float kCostLimit = 1e30f;
constexpr float kNegligible = 1e-3f;   // chains.NEGLIGIBLE
constexpr int kPasses = 4;             // successes.PASSES
constexpr int kNested = 2;             // guess.NESTED
constexpr float kLeastGuess = 1e-4f;   // expanding.LEAST_GUESS
constexpr int kSimulationsBeforeTries = 4, kTryEvery = 4;  // descending
constexpr int32_t kShares = 2048;      // graph.SHARES
constexpr int kProbes = 8;             // graph.PROBES
constexpr int kNone = -1;              // NO_STATE, NO_SUBGOAL, NO_ACTION, NO_CLASS, NOWHERE, UNVISITED
constexpr uint32_t kTreeOverflow = 2, kDepthOverflow = 4, kDeadEnd = 8, kAcceptingRoot = 16, kInvalid = 512;
constexpr size_t kKeptEntries = size_t{1} << 20;  // Memory that a thread keeps from one search to the next.

struct Settings {
  int64_t max_depth, capacity, slots, guess_failures;
  float optimism;
};

struct Shape {
  int64_t S, Z, E, C, M, K, A;
};

// One row of the problems' arrays.
struct Arrays {
  const bool *accepting, *state_mask;
  const int32_t* edges;
  const bool* edge_mask;
  const int32_t* edge_condition;
  const bool* class_mask;
  const int32_t* condition_classes;
  const bool *condition_mask, *implies;
  const float *travel, *finish, *success_probability, *success_cost, *failure_cost;
  int32_t dfa_state;
  const bool* subgoal_mask;
  float dead_end_cost;
  int32_t simulations;  // at most
};

// One row of the arrays of a tree (graph.Tree); holds, fails and visited have one word.
struct TreeArrays {
  float *q_values, *bounds, *floors, *chances, *success_costs;
  int32_t* children;
  float* values;
  int32_t *location, *state;
  uint32_t *holds, *fails, *visited;
  int32_t *table, *root_visits, *size, *simulations, *steps;
  uint32_t* status;
};

struct PlanArrays {
  int32_t *action, *subgoal, *from_state, *to_state;
  float *value, *q_values;
  int32_t* visits;
  float *optimism_gap, *lower_bound;
  uint32_t* status;
};

// Eight lanes at a time: compilers do not vectorise a minimum of floats by themselves, because of NaN.
constexpr int kLanes = 8;
typedef float Lanes __attribute__((vector_size(32)));
typedef int32_t Marks __attribute__((vector_size(32)));
constexpr Marks kCounting = {0, 1, 2, 3, 4, 5, 6, 7};

inline Lanes load(const float* values) {
  Lanes lanes;
  std::memcpy(&lanes, values, sizeof lanes);
  return lanes;
}

inline Marks load(const int32_t* values) {
  Marks lanes;
  std::memcpy(&lanes, values, sizeof lanes);
  return lanes;
}

inline Lanes all_lanes(float value) { return Lanes{} + value; }
inline Marks all_lanes(int32_t value) { return Marks{} + value; }

inline float lesser(float first, float second) { return first < second ? first : second; }

// The same choice either way; compilers do not find the one instruction for it by themselves.
inline Lanes lesser(const Lanes& first, const Lanes& second) {
#ifdef __AVX__
  return _mm256_min_ps(first, second);
#else
  return first < second ? first : second;
#endif
}

// The least lane.
template <typename Value, typename Vector>
inline Value least_lane(const Vector& lanes) {
  typedef Value Half __attribute__((vector_size(16)));
  Half low, high;
  std::memcpy(&low, &lanes, sizeof low);
  std::memcpy(&high, reinterpret_cast<const char*>(&lanes) + sizeof low, sizeof high);
  low = high < low ? high : low;
  const Value first = low[1] < low[0] ? low[1] : low[0], second = low[3] < low[2] ? low[3] : low[2];
  return second < first ? second : first;
}

// The least of values that come eight at a time, and the first place that holds it.
struct Least {
  Lanes values = all_lanes(kInf);
  Marks places = {}, next = kCounting;

  void take(const Lanes& lanes) {
    const Marks lower = lanes < values;
    values = lesser(lanes, values);
    places = lower ? next : places;
    next += kLanes;
  }
  float value() const { return least_lane<float>(values); }
  int place(float least) const {
    return least_lane<int32_t, Marks>(values == least ? places : all_lanes(int32_t{INT32_MAX}));
  }
};

inline uint32_t mix(uint32_t bits) {
  bits = (bits ^ (bits >> 16)) * 0x85EBCA6Bu;
  bits = (bits ^ (bits >> 13)) * 0xC2B2AE35u;
  return bits ^ (bits >> 16);
}

// graph.as_guess.
inline Marks as_guesses(const Lanes& values, const Lanes& dead_ends) {
  const Lanes share = dead_ends < values ? dead_ends / values * float{kShares} : all_lanes(float{kShares - 1});
  Marks bits;
  std::memcpy(&bits, &values, sizeof bits);
  return (bits & -kShares) | INT32_MIN | __builtin_convertvector(share, Marks);
}

// graph.guess_in and dead_ends_in, and context.discounted_guess_in; of one entry or of a vector of them.
template <typename Value, typename Entry>
inline Value guess_in(const Entry& child) {
  const Entry bits = child & (INT32_MAX & -kShares);
  Value value;
  std::memcpy(&value, &bits, sizeof value);
  return value;
}

inline float as_float(int32_t count) { return count; }
inline Lanes as_float(const Marks& count) { return __builtin_convertvector(count, Lanes); }

template <typename Value, typename Entry>
inline Value discounted(const Entry& child, float optimism) {
  const Value guess = guess_in<Value>(child);
  const Value dead_ends = guess * (as_float(child & (kShares - 1)) / float{kShares});
  return lesser((1.0f - optimism) * guess + optimism * dead_ends, guess);
}

struct Costs {
  float value, bound, floor;

  float low(bool certifies) const { return certifies ? floor : bound; }
};

// What is guessed to follow an outcome; its dead end is a probability.
struct Guess {
  float cost, dead_end;
};

struct NodeValues {
  Costs leave, stay;
  float visits;

  Costs on_arrival(float pending_cost, float dead_end_cost) const {
    const auto least = [&](float leave, float stay) {
      const float best = lesser(pending_cost + leave, stay);
      return std::isinf(best) ? dead_end_cost : best;
    };
    return {least(leave.value, stay.value), least(leave.bound, stay.bound), least(leave.floor, stay.floor)};
  }
};

// An action that is real and that a rollout can get to; the last one is finish.
struct Action {
  int id;  // in the problem
  int subgoal, from_state, to_state, product_state;
  bool accepts;
  float failure_cost, chance, success_cost;  // with nothing known
  Set condition, forward, backward, end;
};

struct Node {
  int first, width;             // its entries: those of `StateActions` of its state; none where nothing is left to do
  int stay_begin, stay_end;     // those that stay inside, counted from `first`
  int location, state, product_state;
  bool whole;                   // Entries of what is not available have chances and costs too.
  NodeValues values;
  // The entry that a descent left by last, and the least costs of the others that leave, which have not changed since.
  int left_by;
  Costs rival;
};

struct History {
  int location, state;
  float pending_cost;
  std::vector<Set> holds, fails, visited;
};

// Actions that a rollout can get to from a state of the automaton, in the order of the problem, padded to whole lanes.
struct StateActions {
  bool made, valued;
  int count, width;
  std::vector<int> action, first_of;  // first_of: where the actions of each subgoal begin
  std::vector<int32_t> product_state;
  std::vector<Set> condition;
  std::vector<float> failure_cost, chance, success_cost;  // with nothing known
  std::vector<float> after, after_success;  // what a success is worth, to the rule and to an entry
  std::vector<float> dead_end;              // after a success
  // Path costs to each action from a product state, and to a product state from where each action fails; 0 inside. Made
  // when they are wanted: where they begin is kNone before.
  std::vector<float> rows, columns;
  std::vector<int> row_at, column_at;
};

// What a chain of failures needs of the actions from a state; attempts of what is not available cost inf.
struct Candidates {
  StateActions* actions = nullptr;
  std::vector<float> chance, success_cost, inverse_chance, attempt_cost;
};

struct Chain {
  std::vector<int> position;
  std::vector<float> open_cost;  // of attempts, inf after they were taken or closed
  std::vector<float> cost, chance, dead_end;  // by level; the dead end is that after its success
  std::vector<Guess> rest;
  int length;
  std::vector<Set> failed;  // while it is followed: at each subgoal
};

struct Level {
  int node, entry;
  bool inside;
  NodeValues before;
  Costs base, rival;
  float weight, pending_cost;
};

class Search {
 public:
  void run(const Shape& shape, const Settings& settings, const Arrays& arrays, const TreeArrays* tree, bool resumes,
           const PlanArrays& plan) {
    shape_ = shape;
    settings_ = settings;
    in_ = arrays;
    prepare();
    if (resumes) {
      read_tree(*tree);
    } else {
      plant();
    }
    for (int64_t count = 0; count < in_.simulations && is_open(); ++count) simulate();
    choose(plan);
    if (tree != nullptr) write_tree(*tree);
    forget();
  }

 private:
  // ---- What stays the same during a search --------------------------------------------------------------------------

  void prepare() {
    const int Z = shape_.Z, E = shape_.E, S = shape_.S;
    screen();
    dead_end_cost_ = invalid_ ? kInf : in_.dead_end_cost;
    start_ = invalid_ ? 0 : in_.dfa_state;
    state_accepts_.assign(Z, 0);
    for (int z = 0; z < Z; ++z) state_accepts_[z] = in_.accepting[z] && in_.state_mask[z] && !invalid_;
    optimism_ = settings_.optimism;
    bool subgoals = false;
    for (int s = 0; s < S; ++s) subgoals |= subgoal_real_[s];
    relate_states(subgoals);
    list_conditions();
    list_actions();
    coupled_ = is_coupled();
    order_edges();
    // The rule values successes with the chances of the root, where nothing is known.
    const int count = actions_.size();
    all_chance_.resize(count);
    all_cost_.resize(count);
    for (int k = 0; k < count; ++k) {
      all_chance_[k] = actions_[k].chance;
      all_cost_[k] = actions_[k].success_cost;
    }
    if (static_cast<int>(state_actions_.size()) < Z) state_actions_.resize(Z);
    for (StateActions& own : state_actions_) own.made = false;
    value_successes(after_root_);
  }

  // problem.screen: one wrong value among those that count makes the row a dead end. Also collects between which states
  // paths lead, because both look at every path cost.
  void screen() {
    const int S = shape_.S, Z = shape_.Z, C = shape_.C;
    const int32_t state = in_.dfa_state;
    bool wrong = !(state >= 0 && state < Z && in_.state_mask[state]);
    wrong |= !(in_.dead_end_cost > 0 && in_.dead_end_cost < kCostLimit);
    Set states = 0;
    for (int z = 0; z < Z; ++z) states |= Set{in_.state_mask[z]} << z;
    reach_.assign(Z, 0);
    for (int u = 0; u <= S; ++u) {
      if (u < S && !in_.subgoal_mask[u]) continue;
      for (int z = 0; z < Z; ++z) {
        if (!in_.state_mask[z]) continue;
        wrong |= !is_path_cost(in_.finish[u * Z + z]);
        for (int s = 0; s < S; ++s) {
          if (!in_.subgoal_mask[s]) continue;
          const float* costs = in_.travel + ((int64_t{u} * Z + z) * S + s) * Z;
          Set finite = 0, right = 0;
          for (int to = 0; to < Z; ++to) {
            finite |= Set{costs[to] < kCostLimit} << to;
            right |= Set{is_path_cost(costs[to])} << to;
          }
          reach_[z] |= finite & states;
          wrong |= (~right & states) != 0;
        }
      }
    }
    for (int s = 0; s < S; ++s) {
      if (!in_.subgoal_mask[s]) continue;
      for (int c = 0; c < C; ++c) {
        if (!in_.class_mask[c]) continue;
        const float chance = in_.success_probability[s * C + c], success = in_.success_cost[s * C + c];
        const float failure = in_.failure_cost[s * C + c];
        wrong |= !(chance >= 0 && chance <= 1) || !(success > 0 && success < kCostLimit);
        wrong |= !(failure >= 0 && failure < kCostLimit);
      }
    }
    invalid_ = wrong;
    subgoal_real_.assign(S, 0);
    for (int s = 0; s < S; ++s) subgoal_real_[s] = in_.subgoal_mask[s] && !wrong;
  }

  static bool is_path_cost(float value) { return (value >= 0 && value < kCostLimit) || value == kInf; }

  // context.reachable_states; `reach_` holds the states that paths lead to.
  void relate_states(bool any_subgoal) {
    const int Z = shape_.Z;
    Set attempted = 0;
    for (int e = 0; e < shape_.E; ++e) {
      if (in_.edge_mask[e] && any_subgoal) attempted |= Set{1} << in_.edges[2 * e];
    }
    for (int z = 0; z < Z; ++z) reach_[z] = (invalid_ ? 0 : reach_[z] & attempted) | Set{1} << z;
    for (int e = 0; e < shape_.E; ++e) {
      if (in_.edge_mask[e] && any_subgoal) reach_[in_.edges[2 * e]] |= Set{1} << in_.edges[2 * e + 1];
    }
    for (int via = 0; via < Z; ++via) {
      for (int z = 0; z < Z; ++z) {
        if (reach_[z] >> via & 1) reach_[z] |= reach_[via];
      }
    }
    cyclic_ = false;
    for (int z = 0; z < Z; ++z) {
      for (int to = 0; to < Z; ++to) cyclic_ |= z != to && (reach_[z] >> to & 1) && (reach_[to] >> z & 1);
    }
  }

  bool leads(int from, int to) const { return reach_[from] >> to & 1; }

  // Implications between conditions, cubes of those that have several, and what matters from each state on.
  void list_conditions() {
    const int M = shape_.M, C = shape_.C, K = shape_.K, Z = shape_.Z;
    forward_of_.assign(M, 0);
    backward_of_.assign(M, 0);
    for (int a = 0; a < M; ++a) {
      for (int b = 0; b < M; ++b) {
        if (!in_.implies[a * M + b]) continue;
        forward_of_[a] |= Set{1} << b;
        backward_of_[b] |= Set{1} << a;
      }
    }
    compound_ = false;
    cubes_of_.assign(M - C, 0);
    for (int q = 0; q < M - C; ++q) {
      compound_ |= in_.condition_mask[C + q];
      for (int k = 0; k < K; ++k) {
        const int32_t cube = in_.condition_classes[(C + q) * K + k];
        if (cube >= 0) cubes_of_[q] |= Set{1} << cube;
      }
    }
    bool any_subgoal = false;
    for (const uint8_t real : subgoal_real_) any_subgoal |= real != 0;
    relevant_.assign(Z, compound_ ? ~Set{0} : Set{0});
    for (int e = 0; e < shape_.E; ++e) {
      if (!in_.edge_mask[e] || !any_subgoal) continue;
      for (int z = 0; z < Z; ++z) {
        if (leads(z, in_.edges[2 * e])) relevant_[z] |= Set{1} << condition_of(e);
      }
    }
  }

  int condition_of(int edge) const { return std::max<int32_t>(in_.edge_condition[edge], 0); }

  // Those that a rollout can get to; the others would be available nowhere.
  void list_actions() {
    const int S = shape_.S, Z = shape_.Z, E = shape_.E, K = shape_.K;
    actions_.clear();
    cube_probability_.clear();
    cube_cost_.clear();
    cube_bits_.clear();
    action_at_.assign(S * E, kNone);
    for (int s = 0; s < S; ++s) {
      for (int e = 0; e < E && subgoal_real_[s]; ++e) {
        const int from = in_.edges[2 * e], to = in_.edges[2 * e + 1], condition = condition_of(e);
        if (!in_.edge_mask[e] || !leads(start_, from)) continue;
        action_at_[s * E + e] = actions_.size();
        Action action{};
        action.id = s * E + e;
        action.subgoal = s;
        action.from_state = from;
        action.to_state = to;
        action.product_state = s * Z + from;
        action.accepts = state_accepts_[to];
        action.condition = Set{1} << condition;
        action.forward = forward_of_[condition];
        action.backward = backward_of_[condition];
        action.end = Set{1} << to;
        action.failure_cost = list_cubes(s, condition);
        actions_.push_back(action);
      }
    }
    Action finish{};
    finish.id = S * E;
    finish.subgoal = S;
    finish.from_state = finish.product_state = kNone;
    finish.to_state = 0;
    while (finish.to_state + 1 < Z && !state_accepts_[finish.to_state]) ++finish.to_state;
    if (!state_accepts_[finish.to_state]) finish.to_state = 0;
    finish.accepts = state_accepts_[finish.to_state];
    finish.end = Set{1} << finish.to_state;
    for (int k = 0; k < K; ++k) add_cube(k == 0 ? 1.0f : 0.0f, k == 0 ? 0.0f : kInf, 0);
    actions_.push_back(finish);
    for (size_t k = 0; k < actions_.size(); ++k) knowledge_terms(k, 0, 0, actions_[k].chance, actions_[k].success_cost);
  }

  void add_cube(float probability, float cost, Set bits) {
    cube_probability_.push_back(probability);
    cube_cost_.push_back(cost);
    cube_bits_.push_back(bits);
  }

  // Adds a condition's cubes in order of R_S at a subgoal; cubes of equal cost keep the task's order. Gives R_F.
  float list_cubes(int subgoal, int condition) {
    const int K = shape_.K, C = shape_.C, begin = cube_cost_.size();
    float failure = 0;
    for (int k = 0; k < K; ++k) {
      const int32_t cube = in_.condition_classes[condition * K + k];
      if (cube < 0) {
        add_cube(0, kInf, 0);
        continue;
      }
      // Entries of absent classes may hold anything.
      const bool real = in_.class_mask[cube];
      const int at = subgoal * C + cube;
      failure = std::max(failure, real ? in_.failure_cost[at] : 0.0f);
      add_cube(real ? in_.success_probability[at] : 0.0f, real ? in_.success_cost[at] : 1.0f, Set{1} << cube);
    }
    for (int end = begin + 1; end < begin + K; ++end) {
      for (int i = end; i > begin && cube_cost_[i] < cube_cost_[i - 1]; --i) {
        std::swap(cube_cost_[i], cube_cost_[i - 1]);
        std::swap(cube_probability_[i], cube_probability_[i - 1]);
        std::swap(cube_bits_[i], cube_bits_[i - 1]);
      }
    }
    return failure;
  }

  // rule._is_coupled, of the actions that a rollout can get to and of those that it cannot alike.
  bool is_coupled() const {
    for (int a = 0; a < shape_.E; ++a) {
      for (int b = 0; b < shape_.E; ++b) {
        if (!in_.edge_mask[a] || !in_.edge_mask[b]) continue;
        const int from = in_.edges[2 * a], later = in_.edges[2 * b];
        const bool closes = backward_of_[condition_of(a)] >> condition_of(b) & 1;
        if (closes && from != later && leads(from, later)) return true;
      }
    }
    return false;
  }

  // successes._order_of_successes: edges that end nearest to acceptance first, without those that need no value.
  void order_edges() {
    edge_order_.clear();
    for (int depth = 0; depth <= shape_.Z; ++depth) {
      for (int e = 0; e < shape_.E; ++e) {
        const int to = in_.edges[2 * e + 1];
        const bool counts = in_.edge_mask[e] && !state_accepts_[to] && leads(start_, in_.edges[2 * e]);
        if (counts && __builtin_popcount(reach_[to]) == depth) edge_order_.push_back(e);
      }
    }
  }

  StateActions& actions_from(int state) {
    StateActions& own = state_actions_[state];
    if (!own.made) list_from(state, own);
    return own;
  }

  void list_from(int state, StateActions& own) const {
    const int S = shape_.S, last = actions_.size() - 1;
    own.made = true;
    own.valued = false;
    own.action.clear();
    own.first_of.assign(S + 2, 0);
    for (int k = 0; k <= last; ++k) {
      if (k < last && !leads(state, actions_[k].from_state)) continue;
      own.action.push_back(k);
      own.first_of[actions_[k].subgoal + 1] += 1;
    }
    for (int s = 0; s <= S; ++s) own.first_of[s + 1] += own.first_of[s];
    own.count = own.action.size();
    const int width = own.width = (own.count + kLanes - 1) / kLanes * kLanes;
    own.product_state.assign(width, kNone - 1);
    own.condition.assign(width, 0);
    for (auto* values : {&own.failure_cost, &own.chance, &own.success_cost, &own.after, &own.after_success,
                         &own.dead_end}) {
      values->assign(width, 0);
    }
    for (int i = 0; i < own.count; ++i) {
      const Action& action = actions_[own.action[i]];
      own.product_state[i] = action.product_state;
      own.condition[i] = action.condition;
      own.failure_cost[i] = action.failure_cost;
      own.chance[i] = action.chance;
      own.success_cost[i] = action.success_cost;
    }
    own.rows.clear();
    own.columns.clear();
    own.row_at.assign((S + 1) * shape_.Z, kNone);
    own.column_at.assign((S + 1) * shape_.Z + 1, kNone);
  }

  float path_cost(int product_state, const Action& action) const {
    const int S = shape_.S, Z = shape_.Z, u = product_state / Z;
    const bool real = (u == S || subgoal_real_[u] != 0) && in_.state_mask[product_state % Z] && !invalid_;
    if (!real) return kInf;
    if (action.subgoal == S) return in_.finish[product_state];
    if (!in_.state_mask[action.from_state]) return kInf;
    return in_.travel[(int64_t{product_state} * S + action.subgoal) * Z + action.from_state];
  }

  // To each action from a product state.
  const float* path_costs(StateActions& own, int product_state) const {
    int& at = own.row_at[product_state];
    if (at != kNone) return own.rows.data() + at;
    at = own.rows.size();
    own.rows.resize(at + own.width, kInf);
    float* costs = own.rows.data() + at;
    for (int i = 0; i < own.count; ++i) {
      const Action& action = actions_[own.action[i]];
      costs[i] = action.product_state == product_state ? 0.0f : path_cost(product_state, action);
    }
    return costs;
  }

  // To one action from where each one has failed, with R_F.
  const float* costs_to_begin(StateActions& own, int start) const {
    const Action& first = actions_[own.action[start]];
    // Finish, which lies nowhere, has the first column.
    int& at = own.column_at[first.product_state + 1];
    if (at != kNone) return own.columns.data() + at;
    at = own.columns.size();
    own.columns.resize(at + own.width, 0.0f);
    float* costs = own.columns.data() + at;
    for (int i = 0; i < own.count; ++i) {
      const int from = own.product_state[i];
      const bool inside = from == first.product_state;
      costs[i] = inside ? 0.0f : path_cost(std::max(from, 0), first) + own.failure_cost[i];
    }
    return costs;
  }

  // ---- What a history knows -----------------------------------------------------------------------------------------

  // history.knowledge_terms.
  void knowledge_terms(int k, Set holds, Set fails, float& chance_out, float& cost_out) const {
    const int K = shape_.K;
    const bool certain = holds & actions_[k].condition;
    float probability = 0, cost = kInf;
    for (int i = k * K; i < (k + 1) * K; ++i) {
      const Set bits = cube_bits_[i];
      const float cube_cost = cube_cost_[i];
      const bool failed = fails & bits;
      const float chance = holds & bits ? 1.0f : failed ? 0.0f : cube_probability_[i];
      const float share = (1.0f - probability) * chance;
      const float total = probability + share;
      const bool first = probability == 0 && (chance > 0 || (std::isinf(cost) && !failed));
      if (first) {
        cost = cube_cost;
      } else if (share > 0) {
        cost = (cost * probability + cube_cost * share) / (total > 0 ? total : 1.0f);
      }
      probability = first ? chance : total;
    }
    chance_out = certain ? 1.0f : probability;
    cost_out = std::isinf(cost) ? 0.0f : cost;
  }

  Set propagate_failures(Set fails) const {
    const int count = cubes_of_.size(), C = shape_.C;
    for (int round = 0; round < count; ++round) {
      for (int q = 0; q < count; ++q) {
        if (in_.condition_mask[C + q] && (cubes_of_[q] & ~fails) == 0) fails |= backward_of_[C + q];
      }
    }
    return fails;
  }

  // history.step_row: `history_` becomes what it is after an action.
  void step(const Action& action, bool success) {
    const bool somewhere = action.subgoal < static_cast<int>(shape_.S);
    Set holds = somewhere ? history_.holds[action.subgoal] : 0, fails = somewhere ? history_.fails[action.subgoal] : 0;
    const bool certain = holds & action.condition;
    if (success) {
      holds |= action.forward;
    } else {
      fails |= action.backward;
    }
    if (!cubes_of_.empty()) {
      fails = propagate_failures(fails);
      // A condition holds if its failure would refute what is known to hold.
      Set known = 0;
      for (int m = 0; holds != 0 && m < static_cast<int>(shape_.M); ++m) {
        if (propagate_failures(fails | backward_of_[m]) & holds) known |= Set{1} << m;
      }
      holds = known;
    }
    if (somewhere) {
      history_.holds[action.subgoal] = holds;
      history_.fails[action.subgoal] = fails;
    }
    history_.location = action.subgoal;
    history_.state = success ? action.to_state : action.from_state;
    // Having learnt something, the rollout may go anywhere again.
    if (!certain) std::fill(history_.visited.begin(), history_.visited.end(), 0);
    history_.visited[action.subgoal] |= Set{1} << history_.state;
  }

  // ---- Guesses ------------------------------------------------------------------------------------------------------

  // Fills in what follows from the chances and costs of a list; what has no chance is closed.
  static void value_attempts(Candidates& list) {
    const StateActions& own = *list.actions;
    const int width = own.width;
    list.inverse_chance.resize(width);
    list.attempt_cost.resize(width);
    const Lanes one = all_lanes(1.0f), never = all_lanes(kInf);
    for (int i = 0; i < width; i += kLanes) {
      const Lanes chance = load(list.chance.data() + i), inverse = one / chance;
      const Lanes succeeds = chance * (load(list.success_cost.data() + i) + load(own.after.data() + i));
      Lanes cost = succeeds + (one - chance) * load(own.failure_cost.data() + i);
      cost = inverse < never ? cost : never;
      std::memcpy(list.inverse_chance.data() + i, &inverse, sizeof inverse);
      std::memcpy(list.attempt_cost.data() + i, &cost, sizeof cost);
    }
  }

  // successes.value_successes, with the chances and costs of all actions in `all_chance_` and `all_cost_`.
  void value_successes(std::vector<Guess>& after) {
    const int count = actions_.size(), S = shape_.S, E = shape_.E, Z = shape_.Z;
    after.resize(count);
    for (int k = 0; k < count; ++k) after[k] = actions_[k].accepts ? Guess{0, 0} : Guess{dead_end_cost_, 1};
    after[count - 1] = {0, 0};
    new_values_.resize(S);
    for (int pass = 0; pass < (cyclic_ ? kPasses : 1); ++pass) {
      for (const int edge : edge_order_) {
        const int to = in_.edges[2 * edge + 1];
        list_tried(valued_, to, after);
        for (int s = 0; s < S; ++s) {
          if (!subgoal_real_[s]) continue;
          chain_.open_cost = valued_.attempt_cost;
          follow(chain_, valued_, s * Z + to, all_cost_[action_at_[s * E + edge]], 0);
          new_values_[s] = chain_.rest[0];
        }
        // All at once: no value of this edge enters another one of it.
        for (int s = 0; s < S; ++s) {
          if (subgoal_real_[s]) after[action_at_[s * E + edge]] = new_values_[s];
        }
      }
    }
  }

  // chains.follow_chain: the action of least cost per chance, as long as all fail; `nested` of its successes in a row
  // are valued by what has failed before.
  void follow(Chain& chain, const Candidates& list, int product_state, float pending_cost, int nested) {
    StateActions& own = *list.actions;
    const int width = own.width, most = settings_.guess_failures;
    chain.position.clear();
    chain.cost.clear();
    chain.chance.clear();
    chain.dead_end.clear();
    float reached = 1;
    bool active = true;
    for (chain.length = 0; active && chain.length < most; ++chain.length) {
      const float* costs = path_costs(own, product_state);
      const float *open_cost = chain.open_cost.data(), *inverse = list.inverse_chance.data();
      const Lanes inside = all_lanes(0.0f), pending = all_lanes(pending_cost);
      Least ratio;
      for (int i = 0; i < width; i += kLanes) {
        const Marks stays = load(own.product_state.data() + i) == product_state;
        const Lanes distance = load(costs + i) + (stays ? inside : pending);
        ratio.take((distance + load(open_cost + i)) * load(inverse + i));
      }
      const float least = ratio.value();
      if (std::isinf(least)) break;
      const int taken = ratio.place(least), k = own.action[taken];
      const Action& action = actions_[k];
      const float chance = list.chance[taken];
      float cost = least * chance, dead_end = own.dead_end[taken];
      if (nested > 0) {
        if (leads_on(action)) {
          const Guess rest = rest_after(nested - 1, success_state(action), all_cost_[k], chain.failed);
          cost += chance * rest.cost;
          cost -= chance * after_[k].cost;
          dead_end = rest.dead_end;
        }
        chain.failed[action.subgoal] |= action.backward;
      }
      chain.position.push_back(taken);
      chain.cost.push_back(cost);
      chain.chance.push_back(chance);
      chain.dead_end.push_back(dead_end);
      reached *= 1.0f - chance;
      active = reached > kNegligible;
      close_failed(chain, own, action);
      product_state = action.product_state;
      pending_cost = action.failure_cost;
    }
    chain.rest.resize(chain.length + 1);
    chain.rest[chain.length] = {dead_end_cost_, 1};
    for (int level = chain.length - 1; level >= 0; --level) {
      const float chance = chain.chance[level], fails = 1.0f - chance;
      const Guess& below = chain.rest[level + 1];
      chain.rest[level] = {chain.cost[level] + fails * below.cost,
                           chance * chain.dead_end[level] + fails * below.dead_end};
    }
  }

  bool leads_on(const Action& action) const { return !action.accepts && action.subgoal < static_cast<int>(shape_.S); }

  int success_state(const Action& action) const { return action.subgoal * shape_.Z + action.to_state; }

  // What the rule costs from a product state on, by what `history_` knows and what else has failed.
  Guess rest_after(int nested, int product_state, float pending_cost, const std::vector<Set>& failed) {
    Chain& chain = nested_[nested];
    const Candidates& list = tried_from(product_state % shape_.Z);
    const StateActions& own = *list.actions;
    chain.open_cost = list.attempt_cost;
    chain.failed = failed;
    for (int i = 0; i < own.count; ++i) {
      if (failed[actions_[own.action[i]].subgoal] & own.condition[i]) chain.open_cost[i] = kInf;
    }
    follow(chain, list, product_state, pending_cost, nested);
    return chain.rest[0];
  }

  // What chains from a state of the automaton may take, by what `history_` knows.
  const Candidates& tried_from(int state) {
    Candidates& list = tried_[state];
    if (list.actions == nullptr) list_tried(list, state, after_);
    return list;
  }

  // Actions that lead on from a state by `all_chance_` and `all_cost_`, wherever paths lead.
  void list_tried(Candidates& list, int state, const std::vector<Guess>& after) {
    StateActions& own = actions_from(state);
    list.actions = &own;
    list.chance.assign(own.width, 0);
    list.success_cost.assign(own.width, 0);
    for (int i = 0; i < own.count; ++i) {
      list.chance[i] = all_chance_[own.action[i]];
      list.success_cost[i] = all_cost_[own.action[i]];
      own.after[i] = after[own.action[i]].cost;
      own.dead_end[i] = after[own.action[i]].dead_end;
    }
    own.valued = false;
    value_attempts(list);
  }

  // guess._guess_each: the guess after each candidate's failure into `without_`, after its success into `after_`.
  void guess_each(const Candidates& list) {
    const StateActions& own = *list.actions;
    const int count = own.count;
    const std::vector<Set> none(shape_.S + 1, 0);
    without_.assign(own.width, dead_end_cost_);
    dead_end_without_.assign(own.width, 1);
    anew_.assign(count, {0, 0});
    for (int i = 0; i < count; ++i) {
      const Action& action = actions_[own.action[i]];
      if (action.subgoal == static_cast<int>(shape_.S) || path_[i] == kInf) continue;
      std::vector<Set> failed = none;
      failed[action.subgoal] = action.backward;
      const Guess rest = rest_after(kNested, action.product_state, action.failure_cost, failed);
      without_[i] = rest.cost;
      dead_end_without_[i] = rest.dead_end;
      if (leads_on(action)) anew_[i] = rest_after(kNested, success_state(action), all_cost_[own.action[i]], none);
    }
    // Only now: the chains need what the successes are worth to the rule.
    for (int i = 0; i < count; ++i) {
      if (path_[i] < kInf) after_[own.action[i]] = anew_[i];
    }
  }

  // Takes out what fails with an action.
  static void close_failed(Chain& chain, const StateActions& own, const Action& action) {
    float* open_cost = chain.open_cost.data();
    const Set* condition = own.condition.data();
    for (int i = own.first_of[action.subgoal]; i < own.first_of[action.subgoal + 1]; ++i) {
      // Without a branch, which would often be foreseen wrongly.
      open_cost[i] = action.backward & condition[i] ? kInf : open_cost[i];
    }
  }

  // guess._without_each and _cost_to_begin_elsewhere: the guess after each candidate's failure, into `without_`.
  void guess_failures(const Candidates& list) {
    StateActions& own = *list.actions;
    const int width = own.width;
    without_.assign(width, chain_.rest[0].cost);
    dead_end_without_.assign(width, chain_.rest[0].dead_end);
    Guess spent{0, 0};
    float reached = 1;
    for (int level = 0; level < chain_.length; ++level) {
      const Guess& rest = chain_.rest[level + 1];
      without_[chain_.position[level]] = spent.cost + reached * rest.cost;
      dead_end_without_[chain_.position[level]] = spent.dead_end + reached * rest.dead_end;
      spent.cost += reached * chain_.cost[level];
      spent.dead_end += reached * chain_.chance[level] * chain_.dead_end[level];
      reached *= 1.0f - chain_.chance[level];
    }
    if (chain_.length == 0) return;
    const int first = chain_.position[0];
    const float cost_here = chain_.cost[0] - list.attempt_cost[first];
    const float kept = without_[first];
    const Lanes here = all_lanes(cost_here), never = all_lanes(kInf);
    const float* costs = costs_to_begin(own, first);
    for (int i = 0; i < width; i += kLanes) {
      Lanes there = load(costs + i);
      there = there < never ? there : here;
      const Lanes guess = load(without_.data() + i) + (there - here);
      std::memcpy(without_.data() + i, &guess, sizeof guess);
    }
    without_[first] = kept;
  }

  // ---- Nodes --------------------------------------------------------------------------------------------------------

  // expanding.new_node: the entries of `history_` behind all others; `parent` is where it comes from, or kNone.
  Node new_node(int parent) {
    Node node{};
    node.left_by = kNone;
    node.first = entries_;
    node.location = history_.location;
    node.state = history_.state;
    node.product_state = node.location * shape_.Z + node.state;
    StateActions& own = actions_from(node.state);
    node.width = state_accepts_[node.state] || invalid_ ? 0 : own.width;
    keep_entries(node.first + node.width);
    node.values = {{kInf, kInf, kInf}, {kInf, kInf, kInf}, 0};
    if (node.width == 0) return node;
    node.whole = true;
    find_stay(node, own);
    if (coupled_) value_anew();
    value_entries(own, coupled_ ? after_ : after_root_);
    list_available(node, own, parent);
    if (coupled_) {
      guess_each(list_);
      own.valued = false;
      value_entries(own, after_);
    } else {
      chain_.open_cost = list_.attempt_cost;
      follow(chain_, list_, node.product_state, history_.pending_cost, 0);
      guess_failures(list_);
    }
    fill_entries(node, own);
    node.values = {least_leaving(node, kNone), least_staying(node, kNone), 0};
    return node;
  }

  // Makes room, for more than that, and lets it hold what it held: entries are written before they are read.
  void keep_entries(size_t size) {
    entries_ = size;
    if (size <= q_.size()) return;
    for (auto* values : {&q_, &bound_, &floor_, &chance_, &success_cost_}) values->resize(2 * size);
    for (auto& children : child_) children.resize(2 * size);
  }

  // Those of a subgoal and a state lie side by side.
  static void find_stay(Node& node, const StateActions& own) {
    const auto begin = own.product_state.begin(), end = begin + own.count;
    const auto inside = std::find(begin, end, node.product_state);
    node.stay_begin = node.stay_end = inside - begin;
    while (node.stay_end < own.count && own.product_state[node.stay_end] == node.product_state) ++node.stay_end;
  }

  // What successes are worth, to the actions from a state.
  void value_entries(StateActions& own, const std::vector<Guess>& after) const {
    if (own.valued) return;
    const float least = kLeastGuess * dead_end_cost_;
    // What a coupled problem's guesses are made of changes from node to node.
    own.valued = !coupled_;
    for (int i = 0; i < own.count; ++i) {
      const int k = own.action[i];
      own.after[i] = after[k].cost;
      own.after_success[i] = actions_[k].accepts ? 0.0f : std::max(after[k].cost, least);
      own.dead_end[i] = after[k].dead_end;
    }
  }

  void fill_entries(const Node& node, const StateActions& own) {
    const Lanes one = all_lanes(1.0f), least = all_lanes(kLeastGuess * dead_end_cost_);
    const auto store = [](auto& values, int at, const auto& lanes) {
      std::memcpy(values.data() + at, &lanes, sizeof lanes);
    };
    for (int i = 0; i < own.width; i += kLanes) {
      const int at = node.first + i;
      const Lanes chance = load(list_.chance.data() + i), success_cost = load(list_.success_cost.data() + i);
      Lanes after_failure = load(without_.data() + i);
      after_failure = after_failure < least ? least : after_failure;
      const Marks failure = as_guesses(after_failure, load(dead_end_without_.data() + i) * dead_end_cost_);
      const Marks success =
          as_guesses(load(own.after_success.data() + i), load(own.dead_end.data() + i) * dead_end_cost_);
      Lanes known = load(path_.data() + i) + chance * success_cost;
      known += (one - chance) * load(own.failure_cost.data() + i);
      const auto expected = [&](const Lanes& after_success, const Lanes& after_failure) {
        return known + (chance * after_success + (one - chance) * after_failure);
      };
      store(q_, at, expected(guess_in<Lanes>(success), guess_in<Lanes>(failure)));
      store(bound_, at, expected(discounted<Lanes>(success, optimism_), discounted<Lanes>(failure, optimism_)));
      store(floor_, at, known);
      store(chance_, at, chance);
      store(success_cost_, at, success_cost);
      store(child_[0], at, failure);
      store(child_[1], at, success);
    }
  }

  // Least costs of the entries that leave, but for one.
  Costs least_leaving(const Node& node, int without) const {
    const int32_t* at = state_actions_[node.state].product_state.data();
    const float *q = q_.data() + node.first, *bound = bound_.data() + node.first, *floor = floor_.data() + node.first;
    const Lanes never = all_lanes(kInf);
    Lanes values = never, bounds = never, floors = never;
    Marks place = kCounting;
    for (int i = 0; i < node.width; i += kLanes, place += kLanes) {
      const Marks out = (load(at + i) == node.product_state) | (place == without);
      const auto take = [&](Lanes& least, const float* own) {
        const Lanes next = out ? never : load(own + i);
        least = lesser(next, least);
      };
      take(values, q);
      take(bounds, bound);
      take(floors, floor);
    }
    return {least_lane<float>(values), least_lane<float>(bounds), least_lane<float>(floors)};
  }

  // Likewise of those that stay.
  Costs least_staying(const Node& node, int without) const {
    Costs least{kInf, kInf, kInf};
    for (int i = node.stay_begin; i < node.stay_end; ++i) {
      if (i == without) continue;
      const int at = node.first + i;
      least = {lesser(q_[at], least.value), lesser(bound_[at], least.bound), lesser(floor_[at], least.floor)};
    }
    return least;
  }

  // history.terms_of_all: chances and costs of `history_` into `list_`, path costs into `path_`: inf of what is not
  // available.
  void list_available(const Node& node, StateActions& own, int parent) {
    list_.actions = &own;
    const float* costs = path_costs(own, node.product_state);
    path_.assign(costs, costs + own.width);
    if (parent != kNone && nodes_[parent].whole && nodes_[parent].state == node.state) {
      const int first = nodes_[parent].first;
      list_.chance.assign(chance_.data() + first, chance_.data() + first + own.width);
      list_.success_cost.assign(success_cost_.data() + first, success_cost_.data() + first + own.width);
      // The parent knew the same of all other subgoals.
      know(own, node.location);
    } else {
      list_.chance = own.chance;
      list_.success_cost = own.success_cost;
      for (int s = 0; s < static_cast<int>(shape_.S); ++s) know(own, s);
    }
    for (int s = 0; s < static_cast<int>(shape_.S); ++s) close_circles(own, s);
    value_attempts(list_);
    for (int i = 0; i < own.width; ++i) {
      path_[i] = list_.chance[i] > 0 ? path_[i] : kInf;
      list_.attempt_cost[i] = path_[i] < kInf ? list_.attempt_cost[i] : kInf;
    }
  }

  // Chances and costs at a subgoal that something is known of.
  void know(const StateActions& own, int s) {
    if (s == static_cast<int>(shape_.S)) return;
    const Set holds = history_.holds[s], fails = history_.fails[s];
    if ((holds | fails) == 0) return;
    for (int i = own.first_of[s]; i < own.first_of[s + 1]; ++i) {
      knowledge_terms(own.action[i], holds, fails, list_.chance[i], list_.success_cost[i]);
    }
  }

  // A rollout that repeats what it knows, and ends where it has been, would go round in circles for ever.
  void close_circles(const StateActions& own, int s) {
    const Set holds = history_.holds[s], visited = history_.visited[s];
    if (holds == 0 || visited == 0) return;
    for (int i = own.first_of[s]; i < own.first_of[s + 1]; ++i) {
      if ((holds & own.condition[i]) && (visited & actions_[own.action[i]].end)) path_[i] = kInf;
    }
  }

  // successes.value_successes_anew: by what `history_` knows.
  void value_anew() {
    const int S = shape_.S;
    for (size_t k = 0; k < actions_.size(); ++k) {
      const int s = actions_[k].subgoal;
      const bool somewhere = s < S;
      knowledge_terms(k, somewhere ? history_.holds[s] : 0, somewhere ? history_.fails[s] : 0, all_chance_[k],
                      all_cost_[k]);
    }
    value_successes(after_);
    tried_.resize(shape_.Z);
    for (Candidates& list : tried_) list.actions = nullptr;
  }

  void plant() {
    const int S = shape_.S;
    history_.location = S;
    history_.state = start_;
    history_.pending_cost = 0;
    history_.holds.assign(S, 0);
    history_.fails.assign(S, 0);
    history_.visited.assign(S + 1, 0);
    history_.visited[S] = Set{1} << start_;
    table_.assign((settings_.slots + kProbes) * 3, kNone);
    root_visits_.assign(actions_.size(), 0);
    simulations_ = steps_ = 0;
    all_tried_ = false;
    status_ = 0;
    keep(new_node(kNone));
  }

  // Adds the node that `history_` has just been given.
  void keep(const Node& node) {
    nodes_.push_back(node);
    holds_.insert(holds_.end(), history_.holds.begin(), history_.holds.end());
    fails_.insert(fails_.end(), history_.fails.begin(), history_.fails.end());
    visited_.insert(visited_.end(), history_.visited.begin(), history_.visited.end());
  }

  void recall(int node, float pending_cost) {
    const int S = shape_.S;
    history_.location = nodes_[node].location;
    history_.state = nodes_[node].state;
    history_.pending_cost = pending_cost;
    history_.holds.assign(holds_.begin() + int64_t{node} * S, holds_.begin() + (int64_t{node} + 1) * S);
    history_.fails.assign(fails_.begin() + int64_t{node} * S, fails_.begin() + (int64_t{node} + 1) * S);
    history_.visited.assign(visited_.begin() + int64_t{node} * (S + 1),
                            visited_.begin() + (int64_t{node} + 1) * (S + 1));
  }

  // graph._key of `history_`.
  void make_key(uint32_t key[2]) const {
    const int S = shape_.S;
    const Set usable = relevant_[history_.state];
    const uint32_t position = mix(static_cast<uint32_t>(history_.location * 64 + history_.state) + 0x2545F491u);
    uint32_t visited = 0;
    for (int u = 0; u <= S; ++u) visited += mix(history_.visited[u] ^ mix(static_cast<uint32_t>(u) + 0x51ED270Bu));
    const uint32_t salts[2] = {0x9E3779B9u, 0xC2B2AE3Du};
    for (int word = 0; word < 2; ++word) {
      const uint32_t salt = salts[word];
      uint32_t total = visited;
      for (int s = 0; s < S; ++s) {
        const uint32_t holds = mix((history_.holds[s] & usable) + static_cast<uint32_t>(s) * salt);
        total += mix(holds ^ ((history_.fails[s] & usable) * 0x85EBCA77u + salt));
      }
      key[word] = mix((total ^ position) * (salt | 1) + position);
    }
  }

  // ---- Simulations --------------------------------------------------------------------------------------------------

  Costs root_costs() const { return nodes_[0].values.on_arrival(0, dead_end_cost_); }

  bool is_open() const {
    const Costs root = root_costs();
    return root.value > root.floor;
  }

  // Where a descent is (descending.Descent).
  struct Descent {
    int node = 0, entry = 0;
    float pending_cost = 0;
    bool active = true, success = false, expands = false, accepted = false;
  };

  void simulate() {
    const Costs root = root_costs();
    const bool certifies = root.value <= root.bound;
    Descent descent;
    levels_.clear();
    for (int64_t level = 0; descent.active && level < settings_.max_depth; ++level) {
      const int tried = level == 0 && !certifies ? next_try() : kNone;
      descend_once(descent, certifies, tried, level + 1 >= settings_.max_depth);
    }
    int child = kNone;
    const Costs leaf = expand(descent, child);
    back_up(leaf);
    // Linked last, to the node that the descent left the graph from.
    if (child != kNone) child_[descent.success][nodes_[descent.node].first + descent.entry] = child;
    if (levels_.empty()) return;
    root_visits_[action_of(nodes_[0], levels_[0].entry)] += 1;
    simulations_ += 1;
    steps_ += levels_.size();
  }

  // Without padding.
  int entry_count(const Node& node) const { return node.width == 0 ? 0 : state_actions_[node.state].count; }

  int action_of(const Node& node, int entry) const { return state_actions_[node.state].action[entry]; }

  // The entry that the next descent begins with because none has (descending._passed_over), or kNone.
  int next_try() {
    if (all_tried_ || simulations_ % kTryEvery != kTryEvery - 1) return kNone;
    const Node& root = nodes_[0];
    const float* bound = bound_.data() + root.first;
    int64_t available = 0;
    int least = kNone;
    for (int i = 0; i < entry_count(root); ++i) {
      if (std::isinf(bound[i])) continue;
      available += 1;
      if (root_visits_[action_of(root, i)] == 0 && (least == kNone || bound[i] < bound[least])) least = i;
    }
    all_tried_ = least == kNone;
    return simulations_ >= kSimulationsBeforeTries * available ? least : kNone;
  }

  // One action further; by `tried` if it is an entry.
  void descend_once(Descent& descent, bool certifies, int tried, bool is_last) {
    Node& node = nodes_[descent.node];
    const int entry = tried != kNone ? tried : select_again(node, certifies, descent.pending_cost);
    if (entry == kNone) {
      // A dead end.
      descent.active = false;
      return;
    }
    const int at = node.first + entry;
    const Action& action = actions_[action_of(node, entry)];
    Level level;
    level.node = descent.node;
    level.entry = entry;
    level.inside = entry >= node.stay_begin && entry < node.stay_end;
    level.before = node.values;
    level.rival = level.inside ? least_staying(node, entry) : least_but(node, entry);
    level.pending_cost = descent.pending_cost;
    const float path_cost = path_costs(state_actions_[node.state], node.product_state)[entry];
    // Follow the outcome that contributes more to the gap.
    const float chance = chance_[at], success_cost = success_cost_[at], failure_cost = action.failure_cost;
    const Costs after_success = outcome_costs(child_[1][at], success_cost, is_last);
    const Costs after_failure = outcome_costs(child_[0][at], failure_cost, is_last);
    const float success_gap = chance * (after_success.value - after_success.low(certifies));
    const float failure_gap = (1.0f - chance) * (after_failure.value - after_failure.low(certifies));
    // Nothing is to be learnt from satisfying the task, and a certain success cannot fail.
    const bool success = (success_gap >= failure_gap && !action.accepts) || chance >= 1.0f;
    float known = path_cost + chance * success_cost;
    known += (1.0f - chance) * failure_cost;
    level.weight = success ? chance : 1.0f - chance;
    const float rest = success ? 1.0f - chance : chance;
    const Costs& other = success ? after_failure : after_success;
    level.base = {known + rest * other.value, known + rest * other.bound, known + rest * other.floor};
    levels_.push_back(level);
    const int child = child_[success][at];
    descent.entry = entry;
    descent.success = success;
    descent.accepted = success && action.accepts;
    descent.expands = !descent.accepted && child < 0;
    descent.active = !descent.accepted && child >= 0;
    if (!descent.accepted) descent.pending_cost = success ? success_cost : failure_cost;
    if (descent.active) descent.node = child;
  }

  // The entry of least bound or floor: most often the one of the last descent, which is seen without looking at all.
  int select_again(const Node& node, bool certifies, float pending_cost) const {
    const float* low = (certifies ? floor_ : bound_).data() + node.first;
    if (node.left_by != kNone) {
      const float own = pending_cost + low[node.left_by];
      if (own < pending_cost + node.rival.low(certifies) && own < node.values.stay.low(certifies)) return node.left_by;
    }
    return select(node, low, pending_cost);
  }

  // Least costs of the entries that leave, but for one that a descent leaves by now.
  const Costs& least_but(Node& node, int entry) const {
    if (node.left_by != entry) {
      node.left_by = entry;
      node.rival = least_leaving(node, entry);
    }
    return node.rival;
  }

  // The entry of least bound or floor, ties by lowest index; only actions that leave pay the pending cost.
  int select(const Node& node, const float* low, float pending_cost) const {
    const int32_t* at = state_actions_[node.state].product_state.data();
    const Lanes inside = all_lanes(0.0f), pending = all_lanes(pending_cost);
    Least cost;
    for (int i = 0; i < node.width; i += kLanes) {
      cost.take(load(low + i) + (load(at + i) == node.product_state ? inside : pending));
    }
    const float least = cost.value();
    return std::isinf(least) ? kNone : cost.place(least);
  }

  Costs outcome_costs(int child, float pending_cost, bool is_last) const {
    if (child < 0) {
      return {guess_in<float>(child), discounted<float>(child, optimism_), 0.0f};
    }
    return closed_where(is_last, nodes_[child].values.on_arrival(pending_cost, dead_end_cost_));
  }

  static Costs closed_where(bool cut, const Costs& costs) {
    return cut ? Costs{costs.value, costs.value, costs.value} : costs;
  }

  // Adds the node that the descent reached, or finds it; `child` is to be linked.
  Costs expand(const Descent& descent, int& child) {
    if (descent.accepted) return {0, 0, 0};
    if (!descent.expands) {
      if (descent.active) status_ |= kDepthOverflow;
      return closed_where(descent.active, nodes_[descent.node].values.on_arrival(descent.pending_cost, dead_end_cost_));
    }
    recall(descent.node, descent.pending_cost);
    step(actions_[action_of(nodes_[descent.node], descent.entry)], descent.success);
    uint32_t key[2];
    make_key(key);
    const int64_t first = key[0] & (settings_.slots - 1);
    int64_t slot = kNone;
    for (int probe = kProbes - 1; probe >= 0; --probe) {
      const int32_t* entry = table_.data() + 3 * (first + probe);
      if (entry[2] == kNone) {
        slot = first + probe;
      } else if (static_cast<uint32_t>(entry[0]) == key[0] && static_cast<uint32_t>(entry[1]) == key[1]) {
        child = std::max(child, entry[2]);
      }
    }
    if (child != kNone) return nodes_[child].values.on_arrival(descent.pending_cost, dead_end_cost_);
    const Node node = new_node(descent.node);
    if (static_cast<int64_t>(nodes_.size()) < settings_.capacity) {
      child = nodes_.size();
      keep(node);
      // Where all slots are taken the node is not shared between orders.
      if (slot != kNone) {
        const int32_t entry[3] = {static_cast<int32_t>(key[0]), static_cast<int32_t>(key[1]), child};
        std::copy(entry, entry + 3, table_.data() + 3 * slot);
      }
    } else {
      status_ |= kTreeOverflow;
      entries_ = node.first;
    }
    return node.values.on_arrival(descent.pending_cost, dead_end_cost_);
  }

  void back_up(Costs after) {
    for (auto level = levels_.rbegin(); level != levels_.rend(); ++level) {
      const auto action = [&](float base, float below) { return base + level->weight * below; };
      const Costs costs{action(level->base.value, after.value), action(level->base.bound, after.bound),
                        action(level->base.floor, after.floor)};
      Node& node = nodes_[level->node];
      NodeValues values = level->before;
      (level->inside ? values.stay : values.leave) =
          Costs{lesser(level->rival.value, costs.value), lesser(level->rival.bound, costs.bound),
                lesser(level->rival.floor, costs.floor)};
      values.visits += 1;
      const float pending = level->pending_cost;
      after = {lesser(pending + values.leave.value, values.stay.value),
               lesser(pending + values.leave.bound, values.stay.bound),
               lesser(pending + values.leave.floor, values.stay.floor)};
      const int at = node.first + level->entry;
      q_[at] = costs.value;
      bound_[at] = costs.bound;
      floor_[at] = costs.floor;
      node.values = values;
    }
  }

  // ---- Results ------------------------------------------------------------------------------------------------------

  void choose(const PlanArrays& plan) const {
    const Node& root = nodes_[0];
    const Costs costs = root_costs();
    std::fill(plan.q_values, plan.q_values + shape_.A, kInf);
    std::fill(plan.visits, plan.visits + shape_.A, 0);
    const int best = select(root, q_.data() + root.first, 0);
    const bool available = best != kNone, accepted = state_accepts_[start_];
    for (int i = 0; i < entry_count(root); ++i) {
      const int k = action_of(root, i);
      plan.q_values[actions_[k].id] = q_[root.first + i];
      plan.visits[actions_[k].id] = root_visits_[k];
    }
    float value = available ? q_[root.first + best] : dead_end_cost_;
    if (accepted) value = 0;
    *plan.action = *plan.subgoal = *plan.from_state = *plan.to_state = kNone;
    if (available) {
      const Action& action = actions_[action_of(root, best)];
      *plan.action = action.id;
      if (action.subgoal < static_cast<int>(shape_.S)) {
        *plan.subgoal = action.subgoal;
        *plan.from_state = action.from_state;
        *plan.to_state = action.to_state;
      }
    }
    *plan.value = value;
    *plan.optimism_gap = available ? (value - costs.bound) / (value > 0 ? value : 1.0f) : 0.0f;
    *plan.lower_bound = available ? costs.floor : value;
    *plan.status = status_ | (accepted ? kAcceptingRoot : available ? 0 : kDeadEnd);
    if (invalid_) *plan.status = kInvalid;
  }

  // Nodes that are not in use are as `graph.plant_tree` leaves them, and so is what belongs to unavailable actions.
  void write_tree(const TreeArrays& tree) const {
    const int64_t rows = settings_.capacity + 1, S = shape_.S, A = shape_.A, nodes = nodes_.size();
    for (float* costs : {tree.q_values, tree.bounds, tree.floors}) std::fill(costs, costs + rows * A, kInf);
    for (float* terms : {tree.chances, tree.success_costs}) std::fill(terms, terms + rows * A, 0.0f);
    std::fill(tree.children, tree.children + rows * A * 2, kNone);
    std::fill(tree.values + nodes * 7, tree.values + rows * 7, 0.0f);
    for (int32_t* place : {tree.location, tree.state}) std::fill(place + nodes, place + rows, 0);
    for (uint32_t* known : {tree.holds, tree.fails}) std::fill(known + nodes * S, known + rows * S, 0);
    std::fill(tree.visited + nodes * (S + 1), tree.visited + rows * (S + 1), 0);
    std::copy(holds_.begin(), holds_.end(), tree.holds);
    std::copy(fails_.begin(), fails_.end(), tree.fails);
    std::copy(visited_.begin(), visited_.end(), tree.visited);
    for (int64_t n = 0; n < nodes; ++n) {
      const Node& node = nodes_[n];
      for (int i = 0; i < entry_count(node); ++i) {
        const int at = node.first + i;
        if (std::isinf(q_[at])) continue;
        const int64_t entry = n * A + actions_[action_of(node, i)].id;
        tree.q_values[entry] = q_[at];
        tree.bounds[entry] = bound_[at];
        tree.floors[entry] = floor_[at];
        tree.chances[entry] = chance_[at];
        tree.success_costs[entry] = success_cost_[at];
        for (int success = 0; success < 2; ++success) tree.children[2 * entry + success] = child_[success][at];
      }
      const NodeValues& own = node.values;
      const float values[7] = {own.leave.value, own.stay.value,  own.leave.bound, own.stay.bound,
                               own.leave.floor, own.stay.floor, own.visits};
      std::copy(values, values + 7, tree.values + n * 7);
      tree.location[n] = node.location;
      tree.state[n] = node.state;
    }
    std::copy(table_.begin(), table_.end(), tree.table);
    std::fill(tree.root_visits, tree.root_visits + A, 0);
    for (size_t k = 0; k < actions_.size(); ++k) tree.root_visits[actions_[k].id] = root_visits_[k];
    *tree.size = nodes;
    *tree.simulations = simulations_;
    *tree.steps = steps_;
    *tree.status = status_;
  }

  void read_tree(const TreeArrays& tree) {
    const int64_t S = shape_.S, A = shape_.A, nodes = *tree.size;
    history_.holds.resize(S);
    history_.fails.resize(S);
    history_.visited.resize(S + 1);
    holds_.assign(tree.holds, tree.holds + nodes * S);
    fails_.assign(tree.fails, tree.fails + nodes * S);
    visited_.assign(tree.visited, tree.visited + nodes * (S + 1));
    for (int64_t n = 0; n < nodes; ++n) {
      Node node{};
      node.left_by = kNone;
      node.first = entries_;
      node.location = tree.location[n];
      node.state = tree.state[n];
      const float* own = tree.values + n * 7;
      node.values = {{own[0], own[2], own[4]}, {own[1], own[3], own[5]}, own[6]};
      read_entries(tree, n * A, node);
      nodes_.push_back(node);
    }
    table_.assign(tree.table, tree.table + (settings_.slots + kProbes) * 3);
    root_visits_.resize(actions_.size());
    for (size_t k = 0; k < actions_.size(); ++k) root_visits_[k] = tree.root_visits[actions_[k].id];
    simulations_ = *tree.simulations;
    steps_ = *tree.steps;
    status_ = *tree.status;
    all_tried_ = false;
  }

  void read_entries(const TreeArrays& tree, int64_t row, Node& node) {
    node.product_state = node.location * shape_.Z + node.state;
    const StateActions& own = actions_from(node.state);
    find_stay(node, own);
    node.width = own.width;
    keep_entries(node.first + own.width);
    for (auto* costs : {&q_, &bound_, &floor_}) std::fill_n(costs->begin() + node.first, own.width, kInf);
    for (int i = 0; i < own.count; ++i) {
      const int64_t entry = row + actions_[own.action[i]].id;
      if (std::isinf(tree.q_values[entry])) continue;
      const int at = node.first + i;
      q_[at] = tree.q_values[entry];
      bound_[at] = tree.bounds[entry];
      floor_[at] = tree.floors[entry];
      chance_[at] = tree.chances[entry];
      success_cost_[at] = tree.success_costs[entry];
      for (int success = 0; success < 2; ++success) child_[success][at] = tree.children[2 * entry + success];
    }
  }

  // Empties the graph; a large one gives its memory back.
  void forget() {
    const bool large = q_.size() > kKeptEntries;
    entries_ = 0;
    if (large) {
      for (auto* values : {&q_, &bound_, &floor_, &chance_, &success_cost_}) empty(*values, large);
      for (auto& children : child_) empty(children, large);
    }
    empty(nodes_, large);
    empty(table_, large);
    for (auto* sets : {&holds_, &fails_, &visited_}) empty(*sets, large);
  }

  template <typename T>
  static void empty(std::vector<T>& values, bool large) {
    values.clear();
    if (large) values.shrink_to_fit();
  }

  Shape shape_;
  Settings settings_;
  Arrays in_;

  // What stays the same during a search.
  bool invalid_, coupled_, cyclic_, compound_;
  float dead_end_cost_, optimism_;
  int start_;
  std::vector<uint8_t> subgoal_real_, state_accepts_;
  std::vector<Set> reach_;
  std::vector<Action> actions_;
  std::vector<float> cube_probability_, cube_cost_;
  std::vector<Set> cube_bits_, forward_of_, backward_of_, cubes_of_, relevant_;
  std::vector<int> edge_order_, action_at_;
  std::vector<Guess> after_root_;
  std::vector<StateActions> state_actions_;

  // The graph.
  std::vector<Node> nodes_;
  std::vector<Set> holds_, fails_, visited_;
  std::vector<float> q_, bound_, floor_, chance_, success_cost_;
  std::vector<int32_t> child_[2];  // after a failure, after a success
  int entries_ = 0;
  std::vector<int32_t> table_, root_visits_;
  int32_t simulations_, steps_;
  uint32_t status_;
  bool all_tried_;  // found when a try is due

  // Used anew by every simulation.
  History history_;
  std::vector<Level> levels_;
  Candidates list_, valued_;
  std::vector<Candidates> tried_;
  Chain chain_, nested_[kNested + 1];
  std::vector<Guess> anew_, after_, new_values_;
  std::vector<float> path_, all_chance_, all_cost_, without_, dead_end_without_;
};

// One array of a batch: the row of every array lies behind that of the row before.
template <typename T>
struct Batched {
  T* first;
  int64_t length;

  T* row(int64_t index) const { return first + index * length; }
};

// Takes a call's arguments or results in order.
class Reader {
 public:
  Reader(const ffi::RemainingArgs& arguments, int64_t batch) : arguments_(arguments), batch_(batch) {}

  template <typename T>
  Batched<const T> next() {
    const ffi::AnyBuffer buffer = arguments_.get<ffi::AnyBuffer>(index_++).value();
    return {static_cast<const T*>(buffer.untyped_data()), static_cast<int64_t>(buffer.element_count()) / batch_};
  }

 private:
  const ffi::RemainingArgs& arguments_;
  int64_t batch_;
  size_t index_ = 0;
};

class Writer {
 public:
  Writer(const ffi::RemainingRets& results, int64_t batch) : results_(results), batch_(batch) {}

  template <typename T>
  Batched<T> next() {
    ffi::Result<ffi::AnyBuffer> buffer = results_.get<ffi::AnyBuffer>(index_++).value();
    return {static_cast<T*>(buffer->untyped_data()), static_cast<int64_t>(buffer->element_count()) / batch_};
  }

 private:
  const ffi::RemainingRets& results_;
  int64_t batch_;
  size_t index_ = 0;
};

// In the order of `native.PROBLEM_FIELDS`.
struct ProblemBatch {
  Batched<const bool> accepting, state_mask;
  Batched<const int32_t> edges;
  Batched<const bool> edge_mask;
  Batched<const int32_t> edge_condition;
  Batched<const bool> class_mask;
  Batched<const int32_t> condition_classes;
  Batched<const bool> condition_mask, implies;
  Batched<const float> travel, finish, success_probability, success_cost, failure_cost;
  Batched<const int32_t> dfa_state;
  Batched<const bool> subgoal_mask;
  Batched<const float> dead_end_cost;
  Batched<const int32_t> simulations;

  explicit ProblemBatch(Reader in)
      : accepting(in.next<bool>()), state_mask(in.next<bool>()), edges(in.next<int32_t>()), edge_mask(in.next<bool>()),
        edge_condition(in.next<int32_t>()), class_mask(in.next<bool>()), condition_classes(in.next<int32_t>()),
        condition_mask(in.next<bool>()), implies(in.next<bool>()), travel(in.next<float>()), finish(in.next<float>()),
        success_probability(in.next<float>()), success_cost(in.next<float>()), failure_cost(in.next<float>()),
        dfa_state(in.next<int32_t>()), subgoal_mask(in.next<bool>()), dead_end_cost(in.next<float>()),
        simulations(in.next<int32_t>()) {}

  Shape shape() const {
    Shape shape;
    shape.S = subgoal_mask.length;
    shape.Z = state_mask.length;
    shape.E = edge_mask.length;
    shape.C = class_mask.length;
    shape.M = condition_mask.length;
    shape.K = condition_classes.length / std::max<int64_t>(shape.M, 1);
    shape.A = shape.S * shape.E + 1;
    return shape;
  }

  Arrays row(int64_t i) const {
    return {accepting.row(i),      state_mask.row(i),     edges.row(i),
            edge_mask.row(i),      edge_condition.row(i), class_mask.row(i),
            condition_classes.row(i), condition_mask.row(i), implies.row(i),
            travel.row(i),         finish.row(i),         success_probability.row(i),
            success_cost.row(i),   failure_cost.row(i),   *dfa_state.row(i),
            subgoal_mask.row(i),   *dead_end_cost.row(i), *simulations.row(i)};
  }
};

// In the order of the fields of `search.plan.Plan`.
struct PlanBatch {
  Batched<int32_t> action, subgoal, from_state, to_state;
  Batched<float> value, q_values;
  Batched<int32_t> visits;
  Batched<float> optimism_gap, lower_bound;
  Batched<uint32_t> status;

  explicit PlanBatch(Writer& out)
      : action(out.next<int32_t>()), subgoal(out.next<int32_t>()), from_state(out.next<int32_t>()),
        to_state(out.next<int32_t>()), value(out.next<float>()), q_values(out.next<float>()),
        visits(out.next<int32_t>()), optimism_gap(out.next<float>()), lower_bound(out.next<float>()),
        status(out.next<uint32_t>()) {}

  PlanArrays row(int64_t i) const {
    return {action.row(i),   subgoal.row(i), from_state.row(i),   to_state.row(i),    value.row(i),
            q_values.row(i), visits.row(i),  optimism_gap.row(i), lower_bound.row(i), status.row(i)};
  }
};

// In the order of the fields of `search.graph.Tree`.
struct TreeBatch {
  Batched<float> q_values, bounds, floors, chances, success_costs;
  Batched<int32_t> children;
  Batched<float> values;
  Batched<int32_t> location, state;
  Batched<uint32_t> holds, fails, visited;
  Batched<int32_t> table, root_visits, size, simulations, steps;
  Batched<uint32_t> status;

  explicit TreeBatch(Writer& out)
      : q_values(out.next<float>()), bounds(out.next<float>()), floors(out.next<float>()), chances(out.next<float>()),
        success_costs(out.next<float>()), children(out.next<int32_t>()),
        values(out.next<float>()), location(out.next<int32_t>()), state(out.next<int32_t>()), holds(out.next<uint32_t>()),
        fails(out.next<uint32_t>()), visited(out.next<uint32_t>()), table(out.next<int32_t>()),
        root_visits(out.next<int32_t>()), size(out.next<int32_t>()), simulations(out.next<int32_t>()),
        steps(out.next<int32_t>()), status(out.next<uint32_t>()) {}

  TreeArrays row(int64_t i) const {
    return {q_values.row(i), bounds.row(i),      floors.row(i), chances.row(i),     success_costs.row(i), children.row(i),
            values.row(i),   location.row(i),    state.row(i),  holds.row(i),       fails.row(i),         visited.row(i),
            table.row(i),    root_visits.row(i), size.row(i),   simulations.row(i), steps.row(i),         status.row(i)};
  }
};

Search& search_of_thread() {
  static thread_local Search search;
  return search;
}

// `tree`: 0 for plans alone, 1 for trees too, 2 where the results of the trees hold trees to go on with.
ffi::Error search_rows(ffi::ThreadPool pool, int64_t tree, int64_t max_depth, int64_t capacity,
                       int64_t slots, int64_t guess_failures, float optimism, int64_t batch,
                       ffi::RemainingArgs arguments, ffi::RemainingRets results) {
  if (batch == 0) return ffi::Error::Success();
  const Settings settings{max_depth, capacity, slots, guess_failures, optimism};
  const ProblemBatch problems(Reader(arguments, batch));
  Writer writer(results, batch);
  const PlanBatch plans(writer);
  const Shape shape = problems.shape();
  if (tree == 0) {
    for_each_row(pool, batch, [&](int64_t row) {
      search_of_thread().run(shape, settings, problems.row(row), nullptr, false, plans.row(row));
    });
    return ffi::Error::Success();
  }
  const TreeBatch trees(writer);
  for_each_row(pool, batch, [&](int64_t row) {
    const TreeArrays own = trees.row(row);
    search_of_thread().run(shape, settings, problems.row(row), &own, tree == 2, plans.row(row));
  });
  return ffi::Error::Success();
}

}  // namespace

XLA_FFI_DEFINE_HANDLER_SYMBOL(best_first, search_rows,
                              ffi::Ffi::Bind()
                                  .Ctx<ffi::ThreadPool>()
                                  .Attr<int64_t>("tree")
                                  .Attr<int64_t>("max_depth")
                                  .Attr<int64_t>("capacity")
                                  .Attr<int64_t>("slots")
                                  .Attr<int64_t>("guess_failures")
                                  .Attr<float>("optimism")
                                  .Attr<int64_t>("batch")
                                  .RemainingArgs()
                                  .RemainingRets());
