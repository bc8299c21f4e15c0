// A kernel is one file: its arguments, its functions for each target, and its binding to XLA.
//
// The build compiles it once per target, with TARGET defined, and once without, for the binding.
#pragma once

#include <cstdint>

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
