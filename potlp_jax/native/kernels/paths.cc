// Shortest paths, walked back along known distances; see planning/distances/paths.py, its twin.

#include <algorithm>
#include <array>
#include <cstdint>
#include <limits>
#include <vector>

#include "grid_search.h"
#include "xla/ffi/api/ffi.h"

namespace {

namespace ffi = xla::ffi;

using Bools = ffi::Buffer<ffi::PRED>;
using Ints = ffi::Buffer<ffi::S32>;
using Floats = ffi::Buffer<ffi::F32>;

struct Place {
  int64_t row, column, state;
  bool operator==(const Place& other) const {
    return row == other.row && column == other.column && state == other.state;
  }
};

// A product with the costs from the source; see paths.py for the arrays.
struct Field {
  int64_t height, width, states;
  const float* distances;
  const int32_t* transitions;
  const bool* free;
  const float* steps;
  const bool* wild;        // null without a wildcard
  const bool* successors;

  bool holds(int64_t row, int64_t column) const { return row >= 0 && row < height && column >= 0 && column < width; }
  bool holds(const Place& place) const {
    return holds(place.row, place.column) && place.state >= 0 && place.state < states;
  }
  bool is_free(int64_t row, int64_t column) const { return holds(row, column) && free[row * width + column]; }
  float cost(const Place& place) const {
    return distances[(place.row * width + place.column) * states + place.state];
  }

  // Whether entering the cell of ``place`` in ``state`` leads to the state there.
  bool leads(int64_t state, const Place& place) const {
    const int64_t cell = place.row * width + place.column;
    if (transitions[cell * states + state] == place.state) return true;
    return wild != nullptr && wild[cell] && (state == place.state || successors[state * states + place.state]);
  }

  // The cheapest product state from which a move enters ``place``: the first in the order of moves, then of states.
  Place predecessor(const Place& place) const {
    float least = std::numeric_limits<float>::infinity();
    Place best = place;
    for (size_t move = 0; move < potlp::kRowStep.size(); ++move) {
      const int64_t row = place.row + potlp::kRowStep[move], column = place.column + potlp::kColumnStep[move];
      if (!holds(row, column) || !is_free(row, place.column) || !is_free(place.row, column)) continue;
      for (int64_t state = 0; state < states; ++state) {
        const Place there{row, column, state};
        const float arriving = cost(there) + steps[move];
        if (arriving < least && leads(state, place)) {
          least = arriving;
          best = there;
        }
      }
    }
    return best;
  }
};

ffi::Error ShortestPath(Floats distances, Ints transitions, Bools free, Ints source_cell, Ints source_state,
                        Ints target_cell, Ints target_state, Floats steps, Bools wild, Bools successors,
                        ffi::ResultBuffer<ffi::S32> out_cells, ffi::ResultBuffer<ffi::S32> out_states,
                        ffi::ResultBuffer<ffi::S32> out_length, ffi::ResultBuffer<ffi::F32> out_cost) {
  const auto shape = distances.dimensions();
  const bool has_wild = wild.element_count() > 0;
  const Field field{shape[0],
                    shape[1],
                    shape[2],
                    distances.typed_data(),
                    transitions.typed_data(),
                    free.typed_data(),
                    steps.typed_data(),
                    has_wild ? wild.typed_data() : nullptr,
                    successors.typed_data()};
  const Place source{source_cell.typed_data()[0], source_cell.typed_data()[1], source_state.typed_data()[0]};
  const Place target{target_cell.typed_data()[0], target_cell.typed_data()[1], target_state.typed_data()[0]};
  const float cost = field.holds(target) ? field.cost(target) : potlp::kUnreachable;
  // From the target back to the source; without a way to it, the source alone.
  std::vector<Place> back = {cost < potlp::kUnreachable ? target : source};
  while (!(back.back() == source)) {
    // Costs fall with every step back, so that no product state comes twice.
    if (static_cast<int64_t>(back.size()) > field.height * field.width * field.states) {
      return ffi::Error::InvalidArgument("the distances do not lead back from the target to the source");
    }
    back.push_back(field.predecessor(back.back()));
  }
  const int64_t entries = out_states->element_count();
  const int64_t length = std::min(static_cast<int64_t>(back.size()), entries) - 1;
  for (int64_t entry = 0; entry < entries; ++entry) {
    const Place& place = back[back.size() - 1 - std::min(entry, length)];
    out_cells->typed_data()[2 * entry] = static_cast<int32_t>(place.row);
    out_cells->typed_data()[2 * entry + 1] = static_cast<int32_t>(place.column);
    out_states->typed_data()[entry] = static_cast<int32_t>(place.state);
  }
  out_length->typed_data()[0] = static_cast<int32_t>(length);
  out_cost->typed_data()[0] = cost;
  return ffi::Error::Success();
}

}  // namespace

XLA_FFI_DEFINE_HANDLER_SYMBOL(shortest_path, ShortestPath,
                              ffi::Ffi::Bind()
                                  .Arg<Floats>()
                                  .Arg<Ints>()
                                  .Arg<Bools>()
                                  .Arg<Ints>()
                                  .Arg<Ints>()
                                  .Arg<Ints>()
                                  .Arg<Ints>()
                                  .Arg<Floats>()
                                  .Arg<Bools>()
                                  .Arg<Bools>()
                                  .Ret<Ints>()
                                  .Ret<Ints>()
                                  .Ret<Ints>()
                                  .Ret<Floats>());
