// Distances through the product of a grid and an automaton; see planning/distances/product.py, their twin.

#include <algorithm>
#include <bitset>
#include <cstdint>
#include <string>
#include <utility>
#include <vector>

#include "grid_search.h"
#include "xla/ffi/api/ffi.h"

namespace potlp {
namespace {

namespace ffi = xla::ffi;

using Bools = ffi::Buffer<ffi::PRED>;
using Ints = ffi::Buffer<ffi::S32>;
using Floats = ffi::Buffer<ffi::F32>;

// The product: where a move into a cell leads from a state, and cells whose letter may be any.
struct Product {
  const int32_t* transitions;  // [cell, state]
  int32_t states;
  const bool* wild;                             // [cell], or null
  std::vector<std::vector<int32_t>> successors;  // by state, of wild cells; itself among them

  // Calls ``visit(next)`` for every state that entering ``cell`` in ``state`` leads to.
  template <bool kWild, typename Visit>
  void enter(int32_t cell, int32_t state, Visit visit) const {
    const int32_t next = transitions[int64_t{cell} * states + state];
    if (static_cast<uint32_t>(next) < static_cast<uint32_t>(states)) visit(next);
    if constexpr (kWild) {
      if (wild[cell]) {
        for (const int32_t other : successors[state]) visit(other);
      }
    }
  }
};

// Costs in cells from one source to all of ``cost`` ([cell, state]), which holds infinity everywhere.
template <bool kWild>
void Solve(const Moves& moves, const Product& product, int32_t cell, int32_t state, Open& open, float* cost) {
  const int64_t states = product.states;
  cost[cell * states + state] = 0;
  open.push(cell, state, 0);
  open.drain(
      [&](const Open::Entry& entry) {
        // One that was reached more cheaply since has another entry.
        if (cost[entry.cell * states + entry.state] < entry.cost) return;
        moves.each(entry.cell, [&](int32_t there, float length) {
          product.enter<kWild>(there, entry.state, [&](int32_t next) {
            const float reached = entry.cost + length;
            float& best = cost[there * states + next];
            if (reached < best) {
              best = reached;
              open.push(there, next, reached);
            }
          });
        });
      },
      [](int64_t) { return true; });
}

// The flat index of a source; -1 where there is none, as in ``NO_STATE`` or off the grid.
int64_t SourceCell(const Moves& moves, const int32_t* cells, const int32_t* states, int64_t source, int64_t width,
                   int32_t count) {
  const int64_t row = cells[2 * source], column = cells[2 * source + 1];
  const bool exists = states[source] >= 0 && states[source] < count && moves.holds(row, column);
  return exists ? row * width + column : -1;
}

void Scale(float* costs, int64_t count, float resolution) {
  if (resolution == 1.0f) return;
  for (int64_t index = 0; index < count; ++index) costs[index] *= resolution;
}

ffi::Error ProductDistances(Ints transitions, Bools free, Ints cells, Ints source_states, Floats resolution, Bools wild,
                            Bools successors, ffi::ResultBuffer<ffi::F32> out) {
  const auto shape = transitions.dimensions();
  const int64_t width = shape[1];
  const Moves moves(free.typed_data(), shape[0], width);
  Product product{transitions.typed_data(), static_cast<int32_t>(shape[2]), nullptr, {}};
  // Without a wildcard both arrays are empty.
  const bool has_wild = wild.element_count() > 0;
  if (has_wild) {
    product.wild = wild.typed_data();
    product.successors.resize(product.states);
    for (int32_t state = 0; state < product.states; ++state) {
      for (int32_t next = 0; next < product.states; ++next) {
        if (next == state || successors.typed_data()[state * product.states + next]) {
          product.successors[state].push_back(next);
        }
      }
    }
  }
  Open open;
  const int64_t sources = source_states.element_count(), size = moves.cells() * product.states;
  float* costs = out->typed_data();
  std::fill_n(costs, sources * size, kUnreachable);
  for (int64_t source = 0; source < sources; ++source) {
    const int64_t cell =
        SourceCell(moves, cells.typed_data(), source_states.typed_data(), source, width, product.states);
    if (cell < 0) continue;
    const int32_t state = source_states.typed_data()[source];
    if (has_wild) {
      Solve<true>(moves, product, cell, state, open, costs + source * size);
    } else {
      Solve<false>(moves, product, cell, state, open, costs + source * size);
    }
  }
  Scale(costs, sources * size, resolution.typed_data()[0]);
  return ffi::Error::Success();
}

// What decides between portals and sweeps, and what portals need; see planning/distances/portals.py.
struct Letters {
  std::vector<uint8_t> neutral;      // by cell
  std::vector<int32_t> active;       // in row-major order, at most as many as fit
  int64_t active_count = 0;
  std::vector<uint8_t> follows;      // [state, next]
};

Letters ReadLetters(const Product& product, int64_t cells, int64_t capacity) {
  const int32_t states = product.states;
  Letters letters{std::vector<uint8_t>(cells), {}, 0, std::vector<uint8_t>(states * states)};
  std::vector<uint8_t> moving(states);
  // Most cells are like the one before: what a row of the product is good for is looked at when it changes.
  const auto same = [&](int64_t cell) {
    const int32_t* row = product.transitions + cell * states;
    return cell > 0 && std::equal(row, row + states, row - states);
  };
  for (int64_t cell = 0; cell < cells; ++cell) {
    if (same(cell)) continue;
    for (int32_t state = 0; state < states; ++state) {
      const int32_t next = product.transitions[cell * states + state];
      if (next == kNoState) continue;
      moving[state] = 1;
      if (next >= 0 && next < states) letters.follows[state * states + next] = 1;
    }
  }
  const bool any = std::any_of(moving.begin(), moving.end(), [](uint8_t moves) { return moves != 0; });
  bool neutral = false, active = false;
  for (int64_t cell = 0; cell < cells; ++cell) {
    if (!same(cell)) {
      neutral = any;
      bool enterable = false;
      for (int32_t state = 0; state < states; ++state) {
        const int32_t next = product.transitions[cell * states + state];
        neutral &= next == state || !moving[state];
        enterable |= next != kNoState;
      }
      active = !neutral && enterable;
    }
    letters.neutral[cell] = neutral;
    if (active && ++letters.active_count <= capacity) letters.active.push_back(static_cast<int32_t>(cell));
  }
  return letters;
}

// The sources of a table that exist, and the distinct cells that they are on.
struct Sources {
  std::vector<int64_t> cell;      // by source; -1 where there is none
  std::vector<int32_t> distinct;  // in row-major order
};

// Whether portals need fewer grids than sweeps, as ``portals.portals_pay``.
bool PortalsPay(const Letters& letters, const Sources& sources, const int32_t* source_states, int32_t states,
                int64_t capacity) {
  std::vector<uint8_t> reached = letters.follows;
  for (int32_t state = 0; state < states; ++state) reached[state * states + state] = 1;
  for (int32_t via = 0; via < states; ++via) {
    for (int32_t from = 0; from < states; ++from) {
      if (!reached[from * states + via]) continue;
      for (int32_t to = 0; to < states; ++to) reached[from * states + to] |= reached[via * states + to];
    }
  }
  std::vector<int64_t> grids(states);
  for (int32_t to = 0; to < states; ++to) {
    const auto begin = letters.follows.begin() + to * states;
    if (std::none_of(begin, begin + states, [](uint8_t follows) { return follows != 0; })) continue;
    for (int32_t from = 0; from < states; ++from) grids[from] += reached[from * states + to];
  }
  int64_t by_sweeps = 0;
  for (size_t source = 0; source < sources.cell.size(); ++source) {
    if (sources.cell[source] >= 0) by_sweeps += grids[source_states[source]];
  }
  const int64_t by_portals = letters.active_count + static_cast<int64_t>(sources.distinct.size());
  return letters.active_count <= capacity && by_portals <= by_sweeps;
}

// Costs of entering each end from one key over neutral cells.
class Arrivals {
 public:
  Arrivals(const Moves& moves, const std::vector<uint8_t>& neutral, const std::vector<int64_t>& ends)
      : moves_(moves), kind_(neutral.begin(), neutral.end()), ends_(ends), cost_(moves.cells()),
        arrival_(moves.cells()) {
    for (const int64_t end : ends_) {
      if (end >= 0) kind_[end] |= kEnd;
    }
  }

  void solve(int32_t key, float* lengths) {
    std::fill(cost_.begin(), cost_.end(), kUnreachable);
    std::fill(arrival_.begin(), arrival_.end(), kUnreachable);
    cost_[key] = 0;
    open_.push(key, 0, 0);
    open_.drain(
        [&](const Open::Entry& entry) {
          if (cost_[entry.cell] < entry.cost) return;
          moves_.each(entry.cell, [&](int32_t there, float length) {
            const uint8_t kind = kind_[there];
            if (kind == 0) return;
            const float reached = entry.cost + length;
            if (kind & kEnd) arrival_[there] = std::min(arrival_[there], reached);
            if ((kind & kNeutral) && reached < cost_[there]) {
              cost_[there] = reached;
              open_.push(there, 0, reached);
            }
          });
        },
        // What is still to come costs at least the level.
        [&](int64_t level) {
          return std::any_of(ends_.begin(), ends_.end(),
                             [&](int64_t end) { return end >= 0 && arrival_[end] > static_cast<float>(level); });
        });
    for (size_t end = 0; end < ends_.size(); ++end) {
      lengths[end] = ends_[end] < 0 ? kUnreachable : arrival_[ends_[end]];
    }
  }

 private:
  static constexpr uint8_t kNeutral = 1, kEnd = 2;
  const Moves& moves_;
  std::vector<uint8_t> kind_;
  const std::vector<int64_t>& ends_;
  std::vector<float> cost_, arrival_;
  Open open_;
};

// A table of costs, to be filled by either method.
struct Table {
  const bool* accepting;
  const int32_t* source_states;
  std::vector<int64_t> targets;  // flat cells; -1 off the grid
  float* travel;                 // [source, target, state]
  float* finish;                 // [source]
};

void ByPortals(const Moves& moves, const Product& product, const Letters& letters, const Sources& sources,
               const Table& table) {
  const int32_t states = product.states;
  const size_t active = letters.active.size(), targets = table.targets.size(), ends = active + targets;
  std::vector<int64_t> end_cells(letters.active.begin(), letters.active.end());
  end_cells.insert(end_cells.end(), table.targets.begin(), table.targets.end());
  Arrivals arrivals(moves, letters.neutral, end_cells);
  std::vector<float> from_active(active * ends), from_start(sources.distinct.size() * ends);
  for (size_t key = 0; key < active; ++key) arrivals.solve(letters.active[key], &from_active[key * ends]);
  for (size_t key = 0; key < sources.distinct.size(); ++key) {
    arrivals.solve(sources.distinct[key], &from_start[key * ends]);
  }
  const auto entering = [&](size_t end, int32_t state) {
    return end_cells[end] < 0 ? kNoState : product.transitions[end_cells[end] * states + state];
  };
  std::vector<float> best;                           // [state, active]
  std::vector<std::pair<int32_t, int32_t>> pending;  // (state, active) from which nothing was relaxed yet
  std::vector<uint8_t> waits;
  for (size_t source = 0; source < sources.cell.size(); ++source) {
    if (sources.cell[source] < 0) continue;
    const int32_t state = table.source_states[source];
    const auto place = std::lower_bound(sources.distinct.begin(), sources.distinct.end(), sources.cell[source]);
    const float* first = &from_start[(place - sources.distinct.begin()) * ends];
    best.assign(states * active, kUnreachable);
    waits.assign(states * active, 0);
    const auto reach = [&](size_t end, int32_t in, float cost) {
      const int32_t next = entering(end, in);
      if (next < 0 || next >= states || !(cost < best[next * active + end])) return;
      best[next * active + end] = cost;
      if (!waits[next * active + end]) pending.emplace_back(next, static_cast<int32_t>(end));
      waits[next * active + end] = 1;
    };
    for (size_t end = 0; end < active; ++end) reach(end, state, first[end]);
    // By any order: costs only fall, and the fixed point is one.
    while (!pending.empty()) {
      const auto [in, from] = pending.back();
      pending.pop_back();
      waits[in * active + from] = 0;
      const float so_far = best[in * active + from];
      for (size_t end = 0; end < active; ++end) reach(end, in, so_far + from_active[from * ends + end]);
    }
    float* travel = table.travel + source * targets * states;
    for (size_t target = 0; target < targets; ++target) {
      const size_t end = active + target;
      for (int32_t in = 0; in < states; ++in) {
        float arrived = in == state ? first[end] : kUnreachable;
        for (size_t from = 0; from < active; ++from) {
          arrived = std::min(arrived, best[in * active + from] + from_active[from * ends + end]);
        }
        const int32_t next = entering(end, in);
        if (next >= 0 && next < states) {
          travel[target * states + next] = std::min(travel[target * states + next], arrived);
        }
      }
      // Arrivals are costs of entering, and a source that is its own target need not leave and come back.
      if (table.targets[target] == sources.cell[source]) travel[target * states + state] = 0;
    }
    // A state changes at active cells only: the first accepting product state of a path is the source or one of them.
    float finish = table.accepting[state] ? 0 : kUnreachable;
    for (int32_t in = 0; in < states; ++in) {
      if (!table.accepting[in]) continue;
      for (size_t from = 0; from < active; ++from) finish = std::min(finish, best[in * active + from]);
    }
    table.finish[source] = finish;
  }
}

void BySearch(const Moves& moves, const Product& product, const Sources& sources, const Table& table) {
  const int32_t states = product.states;
  const size_t targets = table.targets.size();
  std::vector<float> cost(moves.cells() * states);
  Open open;
  for (size_t source = 0; source < sources.cell.size(); ++source) {
    if (sources.cell[source] < 0) continue;
    std::fill(cost.begin(), cost.end(), kUnreachable);
    Solve<false>(moves, product, static_cast<int32_t>(sources.cell[source]), table.source_states[source], open,
                 cost.data());
    for (size_t target = 0; target < targets; ++target) {
      if (table.targets[target] < 0) continue;
      std::copy_n(&cost[table.targets[target] * states], states, table.travel + (source * targets + target) * states);
    }
    float finish = kUnreachable;
    for (int32_t state = 0; state < states; ++state) {
      if (!table.accepting[state]) continue;
      for (int64_t cell = 0; cell < moves.cells(); ++cell) finish = std::min(finish, cost[cell * states + state]);
    }
    table.finish[source] = finish;
  }
}

ffi::Error DistanceTable(Ints transitions, Bools free, Bools accepting, Ints cells, Ints source_states,
                         Ints target_cells, Floats resolution, int64_t capacity, ffi::ResultBuffer<ffi::F32> travel,
                         ffi::ResultBuffer<ffi::F32> finish) {
  const auto shape = transitions.dimensions();
  const int64_t width = shape[1];
  const Moves moves(free.typed_data(), shape[0], width);
  const Product product{transitions.typed_data(), static_cast<int32_t>(shape[2]), nullptr, {}};
  Sources sources;
  for (int64_t source = 0; source < static_cast<int64_t>(source_states.element_count()); ++source) {
    sources.cell.push_back(
        SourceCell(moves, cells.typed_data(), source_states.typed_data(), source, width, product.states));
    if (sources.cell.back() >= 0) sources.distinct.push_back(static_cast<int32_t>(sources.cell.back()));
  }
  std::sort(sources.distinct.begin(), sources.distinct.end());
  sources.distinct.erase(std::unique(sources.distinct.begin(), sources.distinct.end()), sources.distinct.end());
  Table table{accepting.typed_data(), source_states.typed_data(), {}, travel->typed_data(), finish->typed_data()};
  for (int64_t target = 0; target < target_cells.dimensions()[0]; ++target) {
    const int64_t row = target_cells.typed_data()[2 * target], column = target_cells.typed_data()[2 * target + 1];
    table.targets.push_back(moves.holds(row, column) ? row * width + column : -1);
  }
  std::fill_n(table.travel, travel->element_count(), kUnreachable);
  std::fill_n(table.finish, finish->element_count(), kUnreachable);
  const int64_t fits = std::min(capacity, moves.cells());
  const Letters letters = ReadLetters(product, moves.cells(), fits);
  if (PortalsPay(letters, sources, table.source_states, product.states, fits)) {
    ByPortals(moves, product, letters, sources, table);
  } else {
    BySearch(moves, product, sources, table);
  }
  Scale(table.travel, travel->element_count(), resolution.typed_data()[0]);
  Scale(table.finish, finish->element_count(), resolution.typed_data()[0]);
  return ffi::Error::Success();
}

}  // namespace
}  // namespace potlp

XLA_FFI_DEFINE_HANDLER_SYMBOL(product_distances, potlp::ProductDistances,
                              xla::ffi::Ffi::Bind()
                                  .Arg<potlp::Ints>()
                                  .Arg<potlp::Bools>()
                                  .Arg<potlp::Ints>()
                                  .Arg<potlp::Ints>()
                                  .Arg<potlp::Floats>()
                                  .Arg<potlp::Bools>()
                                  .Arg<potlp::Bools>()
                                  .Ret<potlp::Floats>());

XLA_FFI_DEFINE_HANDLER_SYMBOL(distance_table, potlp::DistanceTable,
                              xla::ffi::Ffi::Bind()
                                  .Arg<potlp::Ints>()
                                  .Arg<potlp::Bools>()
                                  .Arg<potlp::Bools>()
                                  .Arg<potlp::Ints>()
                                  .Arg<potlp::Ints>()
                                  .Arg<potlp::Ints>()
                                  .Arg<potlp::Floats>()
                                  .Attr<int64_t>("capacity")
                                  .Ret<potlp::Floats>()
                                  .Ret<potlp::Floats>());
