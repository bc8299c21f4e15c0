// A kernel is one file: its arguments, its functions for each target, and its binding to XLA.
//
// The build compiles it once per target, with TARGET defined, and once without, for the binding.
#pragma once

#include <cstdint>

namespace drivax {

// Booleans of an argument, which may hold any byte: files are not trusted, and a `bool` of another byte is undefined.
struct Mask {
  const uint8_t* bytes;

  __attribute__((always_inline)) bool operator[](int64_t i) const { return bytes[i] != 0; }
  __attribute__((always_inline)) Mask operator+(int64_t i) const { return {bytes + i}; }
};

}  // namespace drivax

// Declares functions in the namespace of each target.
#define EACH_TARGET(...)            \
  namespace sse42 { __VA_ARGS__ }   \
  namespace avx2 { __VA_ARGS__ }    \
  namespace avx512 { __VA_ARGS__ }

#ifdef TARGET
#include "simd.h"
#else
#include "binding.h"
#endif
