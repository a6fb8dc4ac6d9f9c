// True R_S and R_F of subgoals; see learning/labels.py, its twin, for what a path beyond a subgoal is.

#include <algorithm>
#include <cstdint>
#include <vector>

#include "grid_search.h"
#include "xla/ffi/api/ffi.h"

namespace potlp {
namespace {

namespace ffi = xla::ffi;

using Bools = ffi::Buffer<ffi::PRED>;
using Ints = ffi::Buffer<ffi::S32>;
using Floats = ffi::Buffer<ffi::F32>;

// Phases of a path.
constexpr int kPorch = 0, kHidden = 1, kSeen = 2, kPhases = 3;
// What a cell is to the paths of one subgoal, as bits; 0 on obstacles.
constexpr uint8_t kOnPorch = 1, kUnseen = 2, kWayBack = 4, kObserved = 8;
// By phase: where a path may end with its next move, whatever the letter there.
constexpr uint8_t kEnds[kPhases] = {kUnseen, kUnseen | kWayBack, kObserved};

// The phase after a move into a cell in which the path stays; -1 where it may not go.
int NextPhase(int phase, uint8_t kind) {
  if (phase == kSeen) return kind & kObserved ? kSeen : -1;
  if (kind & kUnseen) return kHidden;
  if (phase == kPorch) return kind & kOnPorch ? kPorch : -1;
  return kind & kWayBack ? kSeen : -1;
}

// A true map and what is known of it.
struct Building {
  int64_t height, width;
  const bool* free;
  const bool* hidden;
  const bool* frontier;
  const int32_t* component;  // subgoal of each cell of the frontier

  std::vector<uint8_t> kinds_for(int32_t subgoal) const {
    std::vector<uint8_t> kind(height * width);
    for (int64_t cell = 0; cell < height * width; ++cell) {
      const bool own = component[cell] == subgoal;
      if (hidden[cell]) kind[cell] |= kUnseen;
      if (frontier[cell] && !own) kind[cell] |= kWayBack;
      if (!hidden[cell] && !own) kind[cell] |= kObserved;
      if (own) mark_porch(cell, kind);
    }
    for (int64_t cell = 0; cell < height * width; ++cell) kind[cell] = free[cell] ? kind[cell] : 0;
    return kind;
  }

 private:
  void mark_porch(int64_t cell, std::vector<uint8_t>& kind) const {
    const int64_t row = cell / width, column = cell % width;
    for (int64_t r = std::max<int64_t>(row - 1, 0); r <= std::min(row + 1, height - 1); ++r) {
      for (int64_t c = std::max<int64_t>(column - 1, 0); c <= std::min(column + 1, width - 1); ++c) {
        if (!hidden[r * width + c]) kind[r * width + c] |= kOnPorch;
      }
    }
  }
};

// The paths of one subgoal that stay where the letters allow it.
class Paths {
 public:
  Paths(const Moves& moves, std::vector<int32_t> letter, int64_t letters, float resolution)
      : moves_(moves), letter_(std::move(letter)), resolution_(resolution), cost_(moves.cells() * kPhases),
        arrival_(letters) {}

  void solve(int32_t start, const std::vector<uint8_t>& kind, const bool* stays) {
    std::fill(cost_.begin(), cost_.end(), kUnreachable);
    std::fill(arrival_.begin(), arrival_.end(), kUnreachable);
    farthest_ = 0;
    cost_[start * kPhases + kPorch] = 0;
    open_.push(start, kPorch, 0);
    open_.drain(
        [&](const Open::Entry& entry) {
          if (cost_[entry.cell * kPhases + entry.state] < entry.cost) return;
          if (entry.state == kHidden) farthest_ = std::max(farthest_, entry.cost);
          // As it is after a round trip through the unit of cost.
          const float here = entry.cost * resolution_ / resolution_;
          moves_.each(entry.cell, [&](int32_t there, float length) {
            const uint8_t at = kind[there];
            if (at == 0) return;
            const int32_t letter = letter_[there];
            if (at & kEnds[entry.state]) arrival_[letter] = std::min(arrival_[letter], here + length);
            const int next = stays[letter] ? NextPhase(entry.state, at) : -1;
            if (next < 0) return;
            const float reached = entry.cost + length;
            float& best = cost_[there * kPhases + next];
            if (reached < best) {
              best = reached;
              open_.push(there, next, reached);
            }
          });
        },
        [](int64_t) { return true; });
  }

  // The cheapest success at a cell with one of the letters.
  float success(const bool* go) const {
    float cheapest = kUnreachable;
    for (size_t letter = 0; letter < arrival_.size(); ++letter) {
      if (go[letter]) cheapest = std::min(cheapest, arrival_[letter]);
    }
    return cheapest * resolution_;
  }

  float failure() const { return farthest_ * resolution_; }

 private:
  const Moves& moves_;
  std::vector<int32_t> letter_;
  float resolution_;
  std::vector<float> cost_;     // [cell, phase]
  std::vector<float> arrival_;  // by letter: cost of the cheapest move that ends a path on it
  float farthest_ = 0;
  Open open_;
};

// ``wanted`` says of which pairs of a subgoal and a state paths are asked.
ffi::Error TrueLabels(Bools free, Ints letters, Bools hidden, Bools frontier, Ints component, Ints cells, Bools wanted,
                      Bools stays, Bools class_go, Floats resolution, ffi::ResultBuffer<ffi::F32> success,
                      ffi::ResultBuffer<ffi::F32> failure) {
  const int64_t height = free.dimensions()[0], width = free.dimensions()[1];
  const int64_t subgoals = wanted.dimensions()[0], states = wanted.dimensions()[1];
  const int64_t classes = class_go.dimensions()[0], letter_count = class_go.dimensions()[1];
  const Moves moves(free.typed_data(), height, width);
  const Building building{height, width, free.typed_data(), hidden.typed_data(), frontier.typed_data(),
                          component.typed_data()};
  std::vector<int32_t> letter(moves.cells());
  for (int64_t cell = 0; cell < moves.cells(); ++cell) {
    letter[cell] = std::clamp<int32_t>(letters.typed_data()[cell], 0, static_cast<int32_t>(letter_count) - 1);
  }
  Paths paths(moves, std::move(letter), letter_count, resolution.typed_data()[0]);
  std::fill_n(success->typed_data(), success->element_count(), kUnreachable);
  std::fill_n(failure->typed_data(), failure->element_count(), 0.0f);
  for (int64_t subgoal = 0; subgoal < subgoals; ++subgoal) {
    const bool* asked = wanted.typed_data() + subgoal * states;
    const int64_t row = cells.typed_data()[2 * subgoal], column = cells.typed_data()[2 * subgoal + 1];
    if (!moves.holds(row, column) || std::none_of(asked, asked + states, [](bool one) { return one; })) continue;
    const auto kind = building.kinds_for(static_cast<int32_t>(subgoal));
    for (int64_t state = 0; state < states; ++state) {
      if (!asked[state]) continue;
      paths.solve(static_cast<int32_t>(row * width + column), kind, stays.typed_data() + state * letter_count);
      const int64_t pair = subgoal * states + state;
      failure->typed_data()[pair] = paths.failure();
      for (int64_t number = 0; number < classes; ++number) {
        success->typed_data()[pair * classes + number] =
            paths.success(class_go.typed_data() + number * letter_count);
      }
    }
  }
  return ffi::Error::Success();
}

}  // namespace
}  // namespace potlp

XLA_FFI_DEFINE_HANDLER_SYMBOL(true_labels, potlp::TrueLabels,
                              xla::ffi::Ffi::Bind()
                                  .Arg<potlp::Bools>()
                                  .Arg<potlp::Ints>()
                                  .Arg<potlp::Bools>()
                                  .Arg<potlp::Bools>()
                                  .Arg<potlp::Ints>()
                                  .Arg<potlp::Ints>()
                                  .Arg<potlp::Bools>()
                                  .Arg<potlp::Bools>()
                                  .Arg<potlp::Bools>()
                                  .Arg<potlp::Floats>()
                                  .Ret<potlp::Floats>()
                                  .Ret<potlp::Floats>());
