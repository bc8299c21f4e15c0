// What the bindings of kernels share: XLA's types, the choice of the target, and threads.
#pragma once

#include <algorithm>
#include <atomic>
#include <memory>
#include <thread>
#include <type_traits>
#include <vector>

#include "xla/ffi/api/ffi.h"

namespace drivax {

namespace ffi = xla::ffi;

using Float = ffi::Buffer<ffi::F32>;
using Int = ffi::Buffer<ffi::S32>;
using Short = ffi::Buffer<ffi::S16>;
using Byte = ffi::Buffer<ffi::S8>;
using Word = ffi::Buffer<ffi::U32>;
using Bool = ffi::Buffer<ffi::PRED>;
template <typename Buffer>
using Result = ffi::Result<Buffer>;
// An attribute: constants, such as columns.
using Numbers = ffi::Span<const int32_t>;

enum Target { kSse42, kAvx2, kAvx512 };
// The instruction set that is in use; see library.cc.
extern const Target kTarget;

// Calls a kernel of the target that is in use.
#define CALL(kernel, ...)                                 \
  (kTarget == kAvx512 ? avx512::kernel(__VA_ARGS__)       \
   : kTarget == kAvx2 ? avx2::kernel(__VA_ARGS__)         \
                      : sse42::kernel(__VA_ARGS__))

// Adds a name to those that Python registers; the handler's symbol is drivax_NAME.
struct Name {
  explicit Name(const char* name);
};

#define BIND(name, function, ...)                                                     \
  static const Name name##_name(#name);                                               \
  _Pragma("GCC visibility push(default)")                                             \
  XLA_FFI_DEFINE_HANDLER_SYMBOL(drivax_##name, function, ffi::Ffi::Bind() __VA_ARGS__); \
  _Pragma("GCC visibility pop")

// Size of an axis that is counted from the last, which is 1.
template <typename Buffer>
int64_t axis_from_last(const Buffer& buffer, int number) {
  const auto shape = buffer.dimensions();
  return shape[shape.size() - number];
}

// Work that threads share: each takes the next part until none is left.
struct Work {
  std::atomic<int64_t> next{0}, done{0};
};

// Calls `function(first, last)` for parts of [0, count), on the threads of the runtime's pool and on this one.
// This thread never waits for one that has not begun, so that a busy pool cannot block it.
template <typename Function>
void divide(ffi::ThreadPool& pool, int64_t count, int64_t part, const Function& function) {
  const int64_t parts = (count + part - 1) / part;
  const int64_t helpers = std::min<int64_t>(pool.num_threads(), parts) - 1;
  if (helpers < 1) return function(0, count);
  const auto work = std::make_shared<Work>();
  const Function* shared = &function;
  const auto run = [=] {
    for (int64_t i; (i = work->next.fetch_add(1)) < parts; work->done.fetch_add(1))
      (*shared)(i * part, std::min(count, (i + 1) * part));
  };
  for (int64_t i = 0; i < helpers; ++i) pool.Schedule(std::decay_t<decltype(run)>(run));
  run();
  while (work->done.load() < parts) std::this_thread::yield();
}

}  // namespace drivax
