// Line of sight, line by line; see world/sensing.py, its twin, for the definition.

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <vector>

#include "xla/ffi/api/ffi.h"

namespace potlp {
namespace {

namespace ffi = xla::ffi;

// A map with one ring of obstacles around it, and what of it is seen.
class Sight {
 public:
  Sight(const bool* occupied, int64_t height, int64_t width)
      : stride_(width + 2), occupied_((height + 2) * stride_, 1), seen_((height + 2) * stride_, 0) {
    for (int64_t row = 0; row < height; ++row) {
      std::memcpy(&occupied_[(row + 1) * stride_ + 1], occupied + row * width, width);
    }
  }

  int64_t at(int64_t row, int64_t column) const { return (row + 1) * stride_ + column + 1; }
  bool is_seen(int64_t cell) const { return seen_[cell] != 0; }

  // The cell and its eight neighbours are seen, and what touches those of them that are free.
  void look_around(int64_t cell) {
    for (const int64_t row : {-stride_, int64_t{0}, stride_}) {
      for (const int64_t column : {-1, 0, 1}) {
        const int64_t there = cell + row + column;
        if (occupied_[there]) {
          seen_[there] = 1;
        } else {
          see_free(there);
        }
      }
    }
  }

  // Follows the line to (``rise`` of ``half``, along ``main``): Bresenham, ties away from the axis.
  void follow(int64_t cell, int64_t main, int64_t across, int64_t rise, int64_t half, int64_t steps, double range) {
    int64_t position = cell, minor = 0;
    // Twice the running remainder of ``step * rise / half`` to the nearest whole number.
    int64_t error = half;
    for (int64_t step = 1; step <= steps; ++step) {
      error += 2 * rise;
      position += main;
      if (error >= 2 * half) {
        error -= 2 * half;
        ++minor;
        // Between two obstacles that touch at their corners there is no way.
        if (occupied_[position] && occupied_[position - main + across]) return;
        position += across;
      }
      const double distance = static_cast<double>(step * step + minor * minor);
      if (occupied_[position] || distance > range * range) return;
      see_free(position);
    }
  }

 private:
  // A free cell shows the obstacles that it touches.
  void see_free(int64_t cell) {
    if (seen_[cell]) return;
    seen_[cell] = 1;
    for (const int64_t row : {-stride_, int64_t{0}, stride_}) {
      for (const int64_t column : {-1, 0, 1}) seen_[cell + row + column] |= occupied_[cell + row + column];
    }
  }

  int64_t stride_;
  std::vector<uint8_t> occupied_, seen_;
};

ffi::Error Visible(ffi::Buffer<ffi::PRED> occupied, ffi::Buffer<ffi::S32> cell, double range, int64_t half,
                   int64_t steps, ffi::ResultBuffer<ffi::PRED> out) {
  const int64_t height = occupied.dimensions()[0], width = occupied.dimensions()[1];
  const int64_t row = cell.typed_data()[0], column = cell.typed_data()[1];
  bool* result = out->typed_data();
  std::fill_n(result, height * width, false);
  if (row < 0 || row >= height || column < 0 || column >= width) return ffi::Error::Success();
  Sight sight(occupied.typed_data(), height, width);
  const int64_t here = sight.at(row, column), stride = width + 2;
  sight.look_around(here);
  for (const auto& [main, across] : {std::pair{stride, int64_t{1}}, std::pair{int64_t{1}, stride}}) {
    for (const int64_t forward : {-1, 1}) {
      for (const int64_t side : {-1, 1}) {
        for (int64_t rise = side < 0 ? 1 : 0; rise <= half; ++rise) {
          sight.follow(here, forward * main, side * across, rise, half, steps, range);
        }
      }
    }
  }
  for (int64_t r = 0; r < height; ++r) {
    for (int64_t c = 0; c < width; ++c) result[r * width + c] = sight.is_seen(sight.at(r, c));
  }
  return ffi::Error::Success();
}

}  // namespace
}  // namespace potlp

XLA_FFI_DEFINE_HANDLER_SYMBOL(visible, potlp::Visible,
                              xla::ffi::Ffi::Bind()
                                  .Arg<xla::ffi::Buffer<xla::ffi::PRED>>()
                                  .Arg<xla::ffi::Buffer<xla::ffi::S32>>()
                                  .Attr<double>("range")
                                  .Attr<int64_t>("half")
                                  .Attr<int64_t>("steps")
                                  .Ret<xla::ffi::Buffer<xla::ffi::PRED>>());
