// Cheapest ways through squares; see learning/square_ways.py, its twin.
//
// The same sweeps in the same order, because where they end depends on it: with ways that could be cheaper by a few
// cells. What is left out is a step whose beginning has not changed since it was last taken, which changes nothing.

#include <algorithm>
#include <array>
#include <cstdint>
#include <cstring>
#include <limits>
#include <vector>

#include "xla/ffi/api/ffi.h"

namespace {

namespace ffi = xla::ffi;

using Floats = ffi::Buffer<ffi::F32>;
using Result = ffi::ResultBuffer<ffi::F32>;

// As in learning/squares.py.
constexpr int kWest = 0, kEast = 1, kNorth = 2, kSouth = 3, kPassages = 6;
constexpr int kPassage[4][4] = {{-1, 0, 2, 4}, {0, -1, 3, 5}, {2, 3, -1, 1}, {4, 5, 1, -1}};

constexpr int64_t kNever = -1;

bool is_finite(float cost) { return cost < std::numeric_limits<float>::infinity(); }

// Sides of one kind: costs and obstacles of the ways to them, and when each changed last.
struct Sides {
  float* cost;
  float* obstacles;
  std::vector<int64_t> changed;

  Sides(float* cost, float* obstacles, int64_t count, int64_t lanes) : cost(cost), obstacles(obstacles) {
    changed.reserve(count);
    for (int64_t side = 0; side < count; ++side) {
      // From sides that no way leads to there is nothing to pass on until one does.
      const bool reached = std::any_of(cost + side * lanes, cost + (side + 1) * lanes, is_finite);
      changed.push_back(reached ? 0 : kNever);
    }
  }
};

// ``kLanes`` is the number of lanes where it is known when compiling, which spares the vector units the ends of loops.
template <int kLanes>
class Squares {
 public:
  Squares(int64_t rows, int64_t columns, int64_t lanes, const float* step_cost, const float* step_obstacles,
          Sides upright, Sides level)
      : rows_(rows), columns_(columns), lanes_(kLanes > 0 ? kLanes : lanes), step_cost_(step_cost),
        step_obstacles_(step_obstacles), upright_(std::move(upright)), level_(std::move(level)),
        open_(rows * columns) {
    for (auto& done : done_) done.assign(rows * columns, {kNever, kNever, kNever});
    for (int64_t passage = 0; passage < kPassages; ++passage) {
      for (int64_t square = 0; square < rows * columns; ++square) {
        const float* cost = step_cost_ + (passage * rows * columns + square) * lanes_;
        open_[square] |= std::any_of(cost, cost + lanes_, is_finite);
      }
    }
  }

  // One round in all four directions.
  void sweep() {
    for (int64_t row = 0; row < rows_; ++row) sweep_row(row, kNorth, kSouth);
    for (int64_t row = rows_ - 1; row >= 0; --row) sweep_row(row, kSouth, kNorth);
    for (int64_t column = 0; column < columns_; ++column) sweep_column(column, kWest, kEast);
    for (int64_t column = columns_ - 1; column >= 0; --column) sweep_column(column, kEast, kWest);
  }

 private:
  void sweep_row(int64_t row, int near, int far) {
    for (int64_t column = 0; column < columns_; ++column) turn(row, column, near, kEast, kWest);
    for (int64_t column = 0; column < columns_; ++column) leave(row, column, near, far, kWest, kEast);
  }

  void sweep_column(int64_t column, int near, int far) {
    for (int64_t row = 0; row < rows_; ++row) turn(row, column, near, kSouth, kNorth);
    for (int64_t row = 0; row < rows_; ++row) leave(row, column, near, far, kNorth, kSouth);
  }

  // From the near side to those across, first to ``one``.
  void turn(int64_t row, int64_t column, int near, int one, int other) {
    const int64_t square = row * columns_ + column;
    if (!open_[square] || changed(row, column, near) <= done_[near][square][0]) return;
    step(row, column, near, one);
    step(row, column, near, other);
  }

  // To the far side: from the near one, from ``one`` and from ``other``.
  void leave(int64_t row, int64_t column, int near, int far, int one, int other) {
    const int64_t square = row * columns_ + column;
    if (!open_[square]) return;
    std::array<int64_t, 3>& done = done_[near][square];
    const int from[3] = {near, one, other};
    for (int number = 0; number < 3; ++number) {
      if (changed(row, column, from[number]) <= done[number]) continue;
      done[number] = clock_;
      step(row, column, from[number], far);
    }
  }

  int64_t side(int64_t row, int64_t column, int which) const {
    if (which == kWest || which == kEast) return row * (columns_ + 1) + column + (which == kEast);
    return (row + (which == kSouth)) * columns_ + column;
  }

  Sides& sides(int which) { return which == kWest || which == kEast ? upright_ : level_; }

  int64_t changed(int64_t row, int64_t column, int which) { return sides(which).changed[side(row, column, which)]; }

  void step(int64_t row, int64_t column, int from, int to) {
    const int64_t begin = side(row, column, from) * lanes_, target = side(row, column, to);
    const int64_t passage = (kPassage[from][to] * rows_ * columns_ + row * columns_ + column) * lanes_;
    const float* cost = sides(from).cost + begin;
    const float* obstacles = sides(from).obstacles + begin;
    const float* more_cost = step_cost_ + passage;
    const float* more_obstacles = step_obstacles_ + passage;
    float* least = sides(to).cost + target * lanes_;
    float* along = sides(to).obstacles + target * lanes_;
    int any = 0;
    for (int64_t lane = 0; lane < lanes_; ++lane) {
      const float arriving = cost[lane] + more_cost[lane], met = obstacles[lane] + more_obstacles[lane];
      const bool less = arriving < least[lane];
      along[lane] = less ? met : along[lane];
      least[lane] = less ? arriving : least[lane];
      any |= less;
    }
    if (any) sides(to).changed[target] = ++clock_;
  }

  int64_t rows_, columns_, lanes_;
  const float* step_cost_;       // [passage, row, column, lane]
  const float* step_obstacles_;  // likewise
  Sides upright_, level_;
  std::vector<uint8_t> open_;  // squares that some lane may pass
  // By near side and square: the time until which changes of the near side and of the two across were passed on.
  std::array<std::vector<std::array<int64_t, 3>>, 4> done_;
  int64_t clock_ = 0;
};

// Sweeps until no way is cheaper by more than ``gain`` than before the round.
template <int kLanes>
void Solve(Squares<kLanes> squares, float gain, const std::array<std::pair<const float*, int64_t>, 2>& costs) {
  std::array<std::vector<float>, 2> before;
  for (bool gained = true; gained;) {
    for (size_t kind = 0; kind < 2; ++kind) {
      const auto& [values, count] = costs[kind];
      before[kind].assign(values, values + count);
    }
    squares.sweep();
    gained = false;
    for (size_t kind = 0; kind < 2; ++kind) {
      for (int64_t index = 0; index < costs[kind].second; ++index) {
        gained |= costs[kind].first[index] < before[kind][index] - gain;
      }
    }
  }
}

ffi::Error CheapestWays(Floats upright_cost, Floats upright_obstacles, Floats level_cost, Floats level_obstacles,
                        Floats step_cost, Floats step_obstacles, float gain, Result out_upright_cost,
                        Result out_upright_obstacles, Result out_level_cost, Result out_level_obstacles) {
  const auto copy = [](const Floats& from, Result& to) {
    std::memcpy(to->typed_data(), from.typed_data(), from.size_bytes());
  };
  copy(upright_cost, out_upright_cost);
  copy(upright_obstacles, out_upright_obstacles);
  copy(level_cost, out_level_cost);
  copy(level_obstacles, out_level_obstacles);
  const auto shape = step_cost.dimensions();
  const int64_t rows = shape[1], columns = shape[2], lanes = shape[3];
  Sides upright(out_upright_cost->typed_data(), out_upright_obstacles->typed_data(), rows * (columns + 1), lanes);
  Sides level(out_level_cost->typed_data(), out_level_obstacles->typed_data(), (rows + 1) * columns, lanes);
  const std::array<std::pair<const float*, int64_t>, 2> costs = {
      std::pair<const float*, int64_t>{upright.cost, static_cast<int64_t>(upright_cost.element_count())},
      std::pair<const float*, int64_t>{level.cost, static_cast<int64_t>(level_cost.element_count())}};
  const float *cost = step_cost.typed_data(), *obstacles = step_obstacles.typed_data();
  if (lanes == 16) {
    Solve(Squares<16>(rows, columns, lanes, cost, obstacles, std::move(upright), std::move(level)), gain, costs);
  } else {
    Solve(Squares<0>(rows, columns, lanes, cost, obstacles, std::move(upright), std::move(level)), gain, costs);
  }
  return ffi::Error::Success();
}

}  // namespace

XLA_FFI_DEFINE_HANDLER_SYMBOL(cheapest_ways, CheapestWays,
                              ffi::Ffi::Bind()
                                  .Arg<Floats>()
                                  .Arg<Floats>()
                                  .Arg<Floats>()
                                  .Arg<Floats>()
                                  .Arg<Floats>()
                                  .Arg<Floats>()
                                  .Attr<float>("gain")
                                  .Ret<Floats>()
                                  .Ret<Floats>()
                                  .Ret<Floats>()
                                  .Ret<Floats>());
