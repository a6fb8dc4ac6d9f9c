// How far the columns of a panorama look, and painting a panorama on the map; see world/renderer.py and
// learning/painting.py, their twins, for the definitions.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include "xla/ffi/api/ffi.h"

namespace potlp {
namespace {

namespace ffi = xla::ffi;

// Half the diagonal of a cell.
constexpr float kHalfDiagonal = 0.70710678f;

// A cell's entry in the table of looks: bits 0 to 14 columns from the axis, bit 15 whether its bearing is the border of
// two columns, from bit 16 on the row.
constexpr int32_t kColumns = 0x7fff, kOnBorder = 0x8000;
constexpr int kRowShift = 16;

ffi::Error ObstacleDistances(ffi::Buffer<ffi::PRED> occupied, ffi::Buffer<ffi::S32> cell, ffi::Buffer<ffi::S32> offset,
                             ffi::Buffer<ffi::F32> enter, ffi::ResultBuffer<ffi::F32> out) {
  const int64_t height = occupied.dimensions()[0], width = occupied.dimensions()[1], stride = width + 2;
  const int64_t steps = offset.dimensions()[0], columns = offset.dimensions()[1];
  // Beyond the array everything hides.
  std::vector<uint8_t> closed((height + 2) * stride, 1);
  for (int64_t row = 0; row < height; ++row) {
    std::memcpy(&closed[(row + 1) * stride + 1], occupied.typed_data() + row * width, width);
  }
  const int64_t last = static_cast<int64_t>(closed.size()) - 1;
  const int64_t base = (cell.typed_data()[0] + 1) * stride + cell.typed_data()[1] + 1;
  std::vector<int32_t> going(columns);
  for (int64_t column = 0; column < columns; ++column) going[column] = static_cast<int32_t>(column);
  // Step by step, because the tables lie so. The robot's own cell, step 0, hides nothing.
  for (int64_t step = 1; step < steps && !going.empty(); ++step) {
    const int32_t* there = offset.typed_data() + step * columns;
    const float* entered = enter.typed_data() + step * columns;
    size_t kept = 0;
    for (const int32_t column : going) {
      if (closed[std::clamp(base + there[column], int64_t{0}, last)]) {
        out->typed_data()[column] = entered[column];
      } else {
        going[kept++] = column;
      }
    }
    going.resize(kept);
  }
  for (const int32_t column : going) {
    out->typed_data()[column] = enter.typed_data()[(steps - 1) * columns + column];
  }
  return ffi::Error::Success();
}

// The column that looks at a cell ``down`` rows and ``right`` columns away, by its entry of the table, which is that of
// the quadrant in which both are positive.
int64_t ColumnOf(int32_t look, int64_t down, int64_t right, int64_t columns) {
  const int64_t turn = look & kColumns, back = turn + ((look & kOnBorder) ? 0 : 1);
  if (down >= 0) return right >= 0 ? columns / 2 + turn : (columns - back) % columns;
  return right >= 0 ? columns / 2 - back : turn;
}

// No line meets the cell.
constexpr int32_t kHidden = INT32_MAX;

// By how many columns one turns from a cell's bearing, as its rank in the order 0, 1, -1, 2, -2, ...
int32_t RankOfTurn(int64_t turn) { return static_cast<int32_t>(turn > 0 ? 2 * turn - 1 : -2 * turn); }
int64_t TurnOfRank(int32_t rank) { return rank % 2 ? (rank + 1) / 2 : -(rank / 2); }

// Of every cell the rank of the line nearest to its bearing among those that meet it before the sight ends.
std::vector<int32_t> Glances(const ffi::Buffer<ffi::S32>& offset, const ffi::Buffer<ffi::F32>& enter,
                             const float* free_until, const int32_t* cell, const int32_t* looks, int64_t height,
                             int64_t width) {
  const int64_t steps = offset.dimensions()[0], columns = offset.dimensions()[1], stride = width + 2;
  std::vector<int32_t> nearest(height * width, kHidden);
  std::vector<int32_t> going(columns);
  for (int64_t column = 0; column < columns; ++column) going[column] = static_cast<int32_t>(column);
  for (int64_t step = 0; step < steps && !going.empty(); ++step) {
    size_t kept = 0;
    for (const int32_t line : going) {
      // The first obstacle is met, at its side, where the sight ends.
      if (!(enter.typed_data()[step * columns + line] <= free_until[line])) continue;
      going[kept++] = line;
      const int64_t there = (cell[0] + 1) * stride + cell[1] + 1 + offset.typed_data()[step * columns + line];
      const int64_t row = there / stride - 1, column = there % stride - 1;
      if (there < stride || row >= height || column < 0 || column >= width) continue;
      const int64_t down = row - cell[0], right = column - cell[1];
      const int32_t look = looks[std::abs(down) * width + std::abs(right)];
      const int64_t away = line - ColumnOf(look, down, right, columns) + columns + columns / 2;
      const int32_t rank = RankOfTurn(away % columns - columns / 2);
      nearest[row * width + column] = std::min(nearest[row * width + column], rank);
    }
    going.resize(kept);
  }
  return nearest;
}

template <typename T, ffi::DataType type>
T* Continued(const ffi::Buffer<type>& before, ffi::ResultBuffer<type>& after) {
  if (after->typed_data() != before.typed_data()) {
    std::copy_n(before.typed_data(), before.element_count(), after->typed_data());
  }
  return after->typed_data();
}

ffi::Error Paint(ffi::Buffer<ffi::U8> floor_before, ffi::Buffer<ffi::U8> beyond_before,
                 ffi::Buffer<ffi::F32> distance_before, ffi::Buffer<ffi::U8> panorama, ffi::Buffer<ffi::PRED> occupied,
                 ffi::Buffer<ffi::S32> cell, ffi::Buffer<ffi::S32> extent, ffi::Buffer<ffi::F32> free_until,
                 ffi::Buffer<ffi::S32> looks, ffi::Buffer<ffi::S32> offset, ffi::Buffer<ffi::F32> enter,
                 int64_t horizon, ffi::ResultBuffer<ffi::U8> floor_after,
                 ffi::ResultBuffer<ffi::U8> beyond_after, ffi::ResultBuffer<ffi::F32> distance_after) {
  const int64_t height = occupied.dimensions()[0], width = occupied.dimensions()[1];
  const int64_t columns = panorama.dimensions()[1];
  uint8_t* floor = Continued<uint8_t>(floor_before, floor_after);
  uint8_t* beyond = Continued<uint8_t>(beyond_before, beyond_after);
  float* distance = Continued<float>(distance_before, distance_after);
  const uint8_t* pixels = panorama.typed_data();
  const float* free = free_until.typed_data();
  // Without lines cells are seen in the column of their bearing, or not at all.
  const bool glances = offset.dimensions()[0] > 0;
  std::vector<int32_t> nearest;
  if (glances) {
    nearest = Glances(offset, enter, free, cell.typed_data(), looks.typed_data(), height, width);
  }
  // No cell farther away than the longest look is in sight.
  const float farthest = *std::max_element(free, free + columns) + kHalfDiagonal;
  const int64_t rows_inside = std::min<int64_t>(height, extent.typed_data()[0]);
  const int64_t columns_inside = std::min<int64_t>(width, extent.typed_data()[1]);
  for (int64_t row = 0; row < rows_inside; ++row) {
    const int64_t down = row - cell.typed_data()[0], far_down = std::min(std::abs(down), height - 1);
    if (static_cast<float>(std::abs(down)) > farthest) continue;
    for (int64_t column = 0; column < columns_inside; ++column) {
      const int64_t right = column - cell.typed_data()[1], at = row * width + column;
      const float away = std::sqrt(static_cast<float>(down * down + right * right));
      if (!(away < distance[at]) || away > farthest) continue;
      const int32_t look = looks.typed_data()[far_down * width + std::min(std::abs(right), width - 1)];
      int64_t seen_in = ColumnOf(look, down, right, columns);
      // An obstacle is met at its side, and may be seen across up to half a diagonal of it.
      if (!(away <= free[seen_in] + (occupied.typed_data()[at] ? kHalfDiagonal : 0.0f))) {
        if (!glances || nearest[at] == kHidden) continue;
        seen_in = (seen_in + TurnOfRank(nearest[at]) + columns) % columns;
      }
      std::copy_n(pixels + ((look >> kRowShift) * columns + seen_in) * 3, 3, floor + at * 3);
      std::copy_n(pixels + (horizon * columns + seen_in) * 3, 3, beyond + at * 3);
      distance[at] = away;
    }
  }
  return ffi::Error::Success();
}

}  // namespace
}  // namespace potlp

XLA_FFI_DEFINE_HANDLER_SYMBOL(obstacle_distances, potlp::ObstacleDistances,
                              xla::ffi::Ffi::Bind()
                                  .Arg<xla::ffi::Buffer<xla::ffi::PRED>>()
                                  .Arg<xla::ffi::Buffer<xla::ffi::S32>>()
                                  .Arg<xla::ffi::Buffer<xla::ffi::S32>>()
                                  .Arg<xla::ffi::Buffer<xla::ffi::F32>>()
                                  .Ret<xla::ffi::Buffer<xla::ffi::F32>>());

XLA_FFI_DEFINE_HANDLER_SYMBOL(paint, potlp::Paint,
                              xla::ffi::Ffi::Bind()
                                  .Arg<xla::ffi::Buffer<xla::ffi::U8>>()
                                  .Arg<xla::ffi::Buffer<xla::ffi::U8>>()
                                  .Arg<xla::ffi::Buffer<xla::ffi::F32>>()
                                  .Arg<xla::ffi::Buffer<xla::ffi::U8>>()
                                  .Arg<xla::ffi::Buffer<xla::ffi::PRED>>()
                                  .Arg<xla::ffi::Buffer<xla::ffi::S32>>()
                                  .Arg<xla::ffi::Buffer<xla::ffi::S32>>()
                                  .Arg<xla::ffi::Buffer<xla::ffi::F32>>()
                                  .Arg<xla::ffi::Buffer<xla::ffi::S32>>()
                                  .Arg<xla::ffi::Buffer<xla::ffi::S32>>()
                                  .Arg<xla::ffi::Buffer<xla::ffi::F32>>()
                                  .Attr<int64_t>("horizon")
                                  .Ret<xla::ffi::Buffer<xla::ffi::U8>>()
                                  .Ret<xla::ffi::Buffer<xla::ffi::U8>>()
                                  .Ret<xla::ffi::Buffer<xla::ffi::F32>>());
