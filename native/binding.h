// What the bindings of kernels share: XLA's types, the choice of the target, and threads.
#pragma once

#include <algorithm>
#include <atomic>
#include <initializer_list>
#include <memory>
#include <string>
#include <thread>
#include <type_traits>
#include <vector>

#include "xla/ffi/api/ffi.h"

namespace drivax {

namespace ffi = xla::ffi;

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

// Binds a function of that name, whose first parameters are pool, arguments and results, to a kernel with attributes.
#define BIND(name, ...)                                                                                    \
  static const Name name##_name(#name);                                                                    \
  _Pragma("GCC visibility push(default)")                                                                  \
  XLA_FFI_DEFINE_HANDLER_SYMBOL(                                                                           \
      drivax_##name, name,                                                                                 \
      ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().RemainingArgs().RemainingRets() __VA_ARGS__);                \
  _Pragma("GCC visibility pop")

// Work that threads share: each takes the next part until none is left.
struct Work {
  std::atomic<int64_t> next{0}, done{0};
};

// Calls `function(first, last)` for parts of [0, count), on the threads of the runtime's pool and on this one.
// This thread never waits for one that has not begun, so that a busy pool cannot block it.
template <typename Function>
void divide(ffi::ThreadPool& pool, int64_t count, int64_t part, const Function& function) {
  const int64_t parts = count / part + (count % part != 0);
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

// The size of an axis: a number, or a variable that the first array with this axis sets if it is negative.
struct Axis {
  int64_t size = 0;
  int64_t* variable = nullptr;

  Axis(int size) : size(size) {}
  Axis(int64_t& variable) : variable(&variable) {}

  bool accepts(int64_t other) const {
    if (variable && *variable < 0) *variable = other;
    return other == (variable ? *variable : size);
  }
};

template <typename Value>
constexpr ffi::DataType kType = std::is_same_v<Value, float>      ? ffi::F32
                                : std::is_same_v<Value, int32_t>  ? ffi::S32
                                : std::is_same_v<Value, int16_t>  ? ffi::S16
                                : std::is_same_v<Value, int8_t>   ? ffi::S8
                                : std::is_same_v<Value, uint32_t> ? ffi::U32
                                                                  : ffi::PRED;

// Arguments (pointers to constants) and results of a call, in order, with types and shapes checked: what kernels read
// and write lies inside of the arrays. `run` returns the first error.
class Arrays {
 public:
  Arrays(ffi::ThreadPool pool, ffi::RemainingArgs arguments, ffi::RemainingRets results)
      : pool_(pool), arguments_(arguments), results_(results) {}

  // Takes an array that all samples share.
  template <typename Value>
  void common(Value*& array, std::initializer_list<Axis> axes) {
    take(array, axes, false);
  }

  // Takes an array of the batch, which may have several axes before those of a sample.
  template <typename Value>
  void batched(Value*& array, std::initializer_list<Axis> axes) {
    take(array, axes, true);
  }

  void batched(Mask& mask, std::initializer_list<Axis> axes) {
    const bool* array = nullptr;
    take(array, axes, true);
    mask.bytes = reinterpret_cast<const uint8_t*>(array);
  }

  void require(bool condition, const char* what) {
    if (!condition && message_.empty()) message_ = what;
  }

  // Kernels clamp indices, so that axes which these follow must not be empty.
  void nonempty(std::initializer_list<int64_t> sizes) {
    for (const int64_t size : sizes) require(size > 0, "an array is empty");
  }

  // Numbers of the columns of a group, of which there are `count`.
  void columns(Numbers numbers, int count) {
    for (const int32_t number : numbers) require(0 <= number && number < count, "a column does not exist");
  }

  // Calls `function(first, last)` for parts of the batch if all arrays are as they must be.
  template <typename Function>
  ffi::Error run(int64_t part, const Function& function) {
    require(argument_ == arguments_.size() && result_ == results_.size(), "the number of arrays is wrong");
    if (!message_.empty()) return ffi::Error::InvalidArgument("native kernel: " + message_);
    divide(pool_, batch_, part, function);
    return ffi::Error::Success();
  }

 private:
  // Sizes up to this one can be multiplied and counted in 32 bits.
  static constexpr int64_t kLargest = 1 << 24;

  template <typename Value>
  void take(Value*& array, std::initializer_list<Axis> axes, bool is_batched) {
    const auto accept = [&](const ffi::AnyBuffer& buffer) {
      if (buffer.element_type() != kType<std::remove_const_t<Value>>) return false;
      array = static_cast<Value*>(buffer.untyped_data());
      return has_shape(buffer.dimensions(), axes, is_batched);
    };
    bool is_accepted = false;
    if constexpr (std::is_const_v<Value>) {
      const auto buffer = arguments_.get<ffi::AnyBuffer>(argument_++);
      is_accepted = buffer.has_value() && accept(*buffer);
    } else {
      auto buffer = results_.get<ffi::AnyBuffer>(result_++);
      is_accepted = buffer.has_value() && accept(**buffer);
    }
    if (is_accepted || !message_.empty()) return;
    message_ = "argument " + std::to_string(argument_) + " or result " + std::to_string(result_) +
               " has another type or shape than it must have";
  }

  bool has_shape(ffi::AnyBuffer::Dimensions sizes, std::initializer_list<Axis> axes, bool is_batched) {
    const size_t lead = sizes.size() - axes.size();
    if (sizes.size() < axes.size() || (lead && !is_batched)) return false;
    int64_t batch = 1;
    for (size_t i = 0; i < lead; ++i)
      if (__builtin_mul_overflow(batch, sizes[i], &batch)) return false;
    if (is_batched && !Axis(batch_).accepts(batch)) return false;
    const int64_t* size = sizes.begin() + lead;
    for (const Axis& axis : axes)
      if (*size > kLargest || !axis.accepts(*size++)) return false;
    return true;
  }

  ffi::ThreadPool pool_;
  ffi::RemainingArgs arguments_;
  ffi::RemainingRets results_;
  size_t argument_ = 0, result_ = 0;
  int64_t batch_ = -1;
  std::string message_;
};

}  // namespace drivax
