// Rows of a batch, spread over the threads that XLA has for one operation.

#pragma once

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <memory>
#include <mutex>

#include "xla/ffi/api/ffi.h"

namespace {

// Shared by the threads of one call. Kept alive by each of them, because one may begin after all rows are done.
struct RowQueue {
  std::atomic<int64_t> next{0};
  int64_t done = 0;
  std::mutex mutex;
  std::condition_variable all_done;
};

// Calls body(row) once for every row; results must not depend on the order. The caller works too, so that rows are
// done also where the pool has no thread to spare, and only waits for rows that others have begun.
template <typename Body>
void for_each_row(xla::ffi::ThreadPool& pool, int64_t rows, const Body& body) {
  const int64_t helpers = std::min(pool.num_threads(), rows) - 1;
  if (helpers <= 0) {
    for (int64_t row = 0; row < rows; ++row) body(row);
    return;
  }
  auto queue = std::make_shared<RowQueue>();
  // `body` is read only while a row is left, and the caller stays until all are done.
  auto work = [queue, rows, &body] {
    int64_t finished = 0;
    for (int64_t row = queue->next++; row < rows; row = queue->next++, ++finished) body(row);
    std::lock_guard<std::mutex> lock(queue->mutex);
    queue->done += finished;
    if (queue->done == rows) queue->all_done.notify_all();
  };
  for (int64_t helper = 0; helper < helpers; ++helper) pool.Schedule([work] { work(); });
  work();
  std::unique_lock<std::mutex> lock(queue->mutex);
  queue->all_done.wait(lock, [&] { return queue->done == rows; });
}

}  // namespace
