// Components of the frontier and their subgoals; see world/frontiers.py, its twin.

#include <algorithm>
#include <cstdint>
#include <limits>
#include <tuple>
#include <vector>

#include "xla/ffi/api/ffi.h"

namespace {

namespace ffi = xla::ffi;

constexpr int32_t kNoSubgoal = -1;

// A connected part of the frontier.
struct Component {
  std::vector<int32_t> cells;
  int32_t subgoal = 0;
  float distance = 0;
};

// Cells are flat indices; a component's are found from its first one on.
std::vector<Component> Components(const bool* frontier, int64_t height, int64_t width) {
  std::vector<Component> components;
  std::vector<uint8_t> left(frontier, frontier + height * width);
  for (int64_t first = 0; first < height * width; ++first) {
    if (!left[first]) continue;
    left[first] = 0;
    std::vector<int32_t> cells = {static_cast<int32_t>(first)};
    for (size_t next = 0; next < cells.size(); ++next) {
      const int64_t row = cells[next] / width, column = cells[next] % width;
      for (int64_t r = std::max<int64_t>(row - 1, 0); r <= std::min(row + 1, height - 1); ++r) {
        for (int64_t c = std::max<int64_t>(column - 1, 0); c <= std::min(column + 1, width - 1); ++c) {
          if (!left[r * width + c]) continue;
          left[r * width + c] = 0;
          cells.push_back(static_cast<int32_t>(r * width + c));
        }
      }
    }
    std::sort(cells.begin(), cells.end());
    components.push_back({std::move(cells)});
  }
  return components;
}

// The cell nearest the centroid, the first of several; in whole numbers, as ``_summarise`` has it.
int32_t Subgoal(const std::vector<int32_t>& cells, int64_t width) {
  const int64_t count = static_cast<int64_t>(cells.size());
  int64_t rows = 0, columns = 0;
  for (const int64_t cell : cells) {
    rows += cell / width;
    columns += cell % width;
  }
  int64_t least = std::numeric_limits<int64_t>::max();
  int32_t best = 0;
  for (const int32_t cell : cells) {
    const int64_t row = cell / width - rows / count, column = cell % width - columns / count;
    const int64_t square = std::min(row * row + column * column, (int64_t{1} << 30) / count);
    const int64_t off_centre = count * square - 2 * (row * (rows % count) + column * (columns % count));
    if (off_centre < least) {
      least = off_centre;
      best = cell;
    }
  }
  return best;
}

ffi::Error FindComponents(ffi::Buffer<ffi::PRED> frontier, ffi::Buffer<ffi::F32> distance, int64_t min_size,
                          ffi::ResultBuffer<ffi::S32> out_cells, ffi::ResultBuffer<ffi::PRED> out_mask,
                          ffi::ResultBuffer<ffi::S32> out_size, ffi::ResultBuffer<ffi::F32> out_distance,
                          ffi::ResultBuffer<ffi::S32> out_component, ffi::ResultBuffer<ffi::PRED> out_overflow) {
  const int64_t height = frontier.dimensions()[0], width = frontier.dimensions()[1];
  std::vector<Component> components = Components(frontier.typed_data(), height, width);
  const auto is_large = [&](const Component& one) { return static_cast<int64_t>(one.cells.size()) >= min_size; };
  // Slivers are dropped while larger ones remain.
  if (std::any_of(components.begin(), components.end(), is_large)) {
    const auto dropped = [&](const Component& one) { return !is_large(one); };
    components.erase(std::remove_if(components.begin(), components.end(), dropped), components.end());
  }
  for (Component& component : components) {
    component.subgoal = Subgoal(component.cells, width);
    component.distance = distance.typed_data()[component.subgoal];
  }
  std::sort(components.begin(), components.end(), [](const Component& one, const Component& other) {
    return std::tie(one.distance, one.subgoal) < std::tie(other.distance, other.subgoal);
  });
  const int64_t most = out_mask->element_count();
  std::fill_n(out_component->typed_data(), height * width, kNoSubgoal);
  for (int64_t number = 0; number < most; ++number) {
    const bool exists = number < static_cast<int64_t>(components.size());
    out_mask->typed_data()[number] = exists;
    const Component none{{}, 0, std::numeric_limits<float>::infinity()};
    const Component& component = exists ? components[number] : none;
    out_cells->typed_data()[2 * number] = static_cast<int32_t>(component.subgoal / width);
    out_cells->typed_data()[2 * number + 1] = static_cast<int32_t>(component.subgoal % width);
    out_size->typed_data()[number] = static_cast<int32_t>(component.cells.size());
    out_distance->typed_data()[number] = component.distance;
    for (const int32_t cell : component.cells) out_component->typed_data()[cell] = static_cast<int32_t>(number);
  }
  out_overflow->typed_data()[0] = static_cast<int64_t>(components.size()) > most;
  return ffi::Error::Success();
}

ffi::Error LabelComponents(ffi::Buffer<ffi::PRED> mask, ffi::ResultBuffer<ffi::S32> out_part) {
  const int64_t height = mask.dimensions()[0], width = mask.dimensions()[1];
  std::fill_n(out_part->typed_data(), height * width, 0);
  for (const Component& component : Components(mask.typed_data(), height, width)) {
    for (const int32_t cell : component.cells) out_part->typed_data()[cell] = component.cells.front() + 1;
  }
  return ffi::Error::Success();
}

}  // namespace

XLA_FFI_DEFINE_HANDLER_SYMBOL(label_components, LabelComponents,
                              ffi::Ffi::Bind().Arg<ffi::Buffer<ffi::PRED>>().Ret<ffi::Buffer<ffi::S32>>());

XLA_FFI_DEFINE_HANDLER_SYMBOL(find_components, FindComponents,
                              ffi::Ffi::Bind()
                                  .Arg<ffi::Buffer<ffi::PRED>>()
                                  .Arg<ffi::Buffer<ffi::F32>>()
                                  .Attr<int64_t>("min_size")
                                  .Ret<ffi::Buffer<ffi::S32>>()
                                  .Ret<ffi::Buffer<ffi::PRED>>()
                                  .Ret<ffi::Buffer<ffi::S32>>()
                                  .Ret<ffi::Buffer<ffi::F32>>()
                                  .Ret<ffi::Buffer<ffi::S32>>()
                                  .Ret<ffi::Buffer<ffi::PRED>>());
