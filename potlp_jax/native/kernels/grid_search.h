// Shortest costs on a grid from one source: buckets of width 1, which is the shortest move.
//
// A cost in bucket k leads to costs of at least k + 1, so that all of a bucket are final when it is taken up, in
// whatever order: no heap is needed, and three buckets at a time hold all that is open (a move is at most sqrt 2 long).
// Costs are float32 sums of the moves in the order of the path, the smallest of all paths: the fixed point that any
// relaxation ends at, because rounding is monotone.
#ifndef POTLP_GRID_SEARCH_H_
#define POTLP_GRID_SEARCH_H_

#include <array>
#include <cstdint>
#include <cstring>
#include <limits>
#include <vector>

namespace potlp {

inline constexpr float kUnreachable = std::numeric_limits<float>::infinity();
inline constexpr float kDiagonal = 1.41421356237309504880f;
inline constexpr int32_t kNoState = -1;

// In the order of ``world.moves.NEIGHBOURS``.
inline constexpr std::array<int, 8> kRowStep = {-1, -1, -1, 0, 0, 1, 1, 1};
inline constexpr std::array<int, 8> kColumnStep = {-1, 0, 1, -1, 1, -1, 0, 1};
inline constexpr std::array<float, 8> kLength = {kDiagonal, 1, kDiagonal, 1, 1, kDiagonal, 1, kDiagonal};

// Which of the eight moves from each cell stay on the grid and cut no corner; one bit each.
class Moves {
 public:
  Moves(const bool* free, int64_t height, int64_t width) : height_(height), width_(width), allowed_(height * width) {
    const int64_t stride = width + 2;
    std::vector<uint8_t> padded((height + 2) * stride, 0);
    for (int64_t row = 0; row < height; ++row) {
      std::memcpy(&padded[(row + 1) * stride + 1], free + row * width, width);
    }
    for (int64_t row = 0; row < height; ++row) {
      const uint8_t* here = &padded[(row + 1) * stride + 1];
      const uint8_t* above = here - stride;
      const uint8_t* below = here + stride;
      uint8_t* out = &allowed_[row * width];
      const uint8_t straight = (row > 0 ? 1 << 1 : 0) | 1 << 3 | 1 << 4 | (row + 1 < height ? 1 << 6 : 0);
      for (int64_t column = 0; column < width; ++column) {
        const uint8_t left = here[column - 1], right = here[column + 1];
        out[column] = straight | (above[column] & left) | (above[column] & right) << 2 | (below[column] & left) << 5 |
                      (below[column] & right) << 7;
      }
      out[0] &= static_cast<uint8_t>(~(1 << 3));
      out[width - 1] &= static_cast<uint8_t>(~(1 << 4));
    }
    for (int move = 0; move < 8; ++move) {
      offset_[move] = static_cast<int32_t>(kRowStep[move] * width + kColumnStep[move]);
    }
  }

  int64_t cells() const { return height_ * width_; }
  bool holds(int64_t row, int64_t column) const { return row >= 0 && row < height_ && column >= 0 && column < width_; }

  // Calls ``visit(neighbour, length)`` for every move from a cell.
  template <typename Visit>
  void each(int32_t cell, Visit visit) const {
    for (unsigned left = allowed_[cell]; left != 0; left &= left - 1) {
      const int move = __builtin_ctz(left);
      visit(cell + offset_[move], kLength[move]);
    }
  }

 private:
  int64_t height_, width_;
  std::vector<uint8_t> allowed_;
  std::array<int32_t, 8> offset_;
};

// What is open of a search. ``state`` is that of an automaton or a phase; 0 where there is none.
class Open {
 public:
  struct Entry {
    int32_t cell;
    int32_t state;
    float cost;
  };

  void push(int32_t cell, int32_t state, float cost) {
    buckets_[static_cast<int64_t>(cost) % 3].push_back({cell, state, cost});
  }

  // Calls ``visit(entry)``, which may push, by buckets; ``go_on(k)`` is asked before bucket k.
  template <typename Visit, typename GoOn>
  void drain(Visit visit, GoOn go_on) {
    for (int64_t level = 0;; ++level) {
      if (buckets_[level % 3].empty()) {
        if (buckets_[(level + 1) % 3].empty() && buckets_[(level + 2) % 3].empty()) break;
        continue;
      }
      if (!go_on(level)) break;
      current_.swap(buckets_[level % 3]);
      for (const Entry& entry : current_) visit(entry);
      current_.clear();
    }
    for (auto& bucket : buckets_) bucket.clear();
  }

 private:
  std::array<std::vector<Entry>, 3> buckets_;
  std::vector<Entry> current_;
};

}  // namespace potlp

#endif  // POTLP_GRID_SEARCH_H_
