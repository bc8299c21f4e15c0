// Vectors of floats for one instruction set: each kernel is compiled once per target, in a namespace of its own.
//
// TARGET (a namespace) and LANES (floats per vector) come from the build. Only this file knows intrinsics. Kernels use
// no templates of the standard library: a linker could choose the copy that was compiled for the largest target.
#pragma once

// GCC's headers use undefined values on purpose.
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wuninitialized"
#pragma GCC diagnostic ignored "-Wmaybe-uninitialized"
#include <immintrin.h>
#pragma GCC diagnostic pop

#include <cstdint>

#define INLINE static inline __attribute__((always_inline))

namespace drivax::TARGET {

using Floats = float __attribute__((vector_size(4 * LANES)));
using Ints = int32_t __attribute__((vector_size(4 * LANES)));

constexpr float kInfinity = __builtin_inff();

INLINE Floats load(const float* from) {
  Floats values;
  __builtin_memcpy(&values, from, sizeof values);
  return values;
}

INLINE Ints load(const int32_t* from) {
  Ints values;
  __builtin_memcpy(&values, from, sizeof values);
  return values;
}

INLINE void store(float* to, Floats values) { __builtin_memcpy(to, &values, sizeof values); }
INLINE void store(int32_t* to, Ints values) { __builtin_memcpy(to, &values, sizeof values); }

// Loads `count` values, at most LANES, and zeros after them.
INLINE Floats load_first(const float* from, int64_t count) {
  if (count >= LANES) return load(from);
  Floats values = {};
  for (int64_t lane = 0; lane < count; ++lane) values[lane] = from[lane];
  return values;
}

INLINE Floats splat(float value) { return Floats{} + value; }
INLINE Ints splat(int32_t value) { return Ints{} + value; }

INLINE Ints numbers() {
  Ints values;
  for (int32_t lane = 0; lane < LANES; ++lane) values[lane] = lane;
  return values;
}

INLINE Floats select(Ints condition, Floats yes, Floats no) { return condition ? yes : no; }
INLINE Ints select(Ints condition, Ints yes, Ints no) { return condition ? yes : no; }
INLINE Floats larger(Floats a, Floats b) { return a > b ? a : b; }
INLINE Floats smaller(Floats a, Floats b) { return a < b ? a : b; }
// NaN stays NaN, since comparisons with it are false.
INLINE Floats clamp(Floats value, Floats low, Floats high) { return smaller(high, larger(low, value)); }
INLINE Floats absolute(Floats value) { return value < 0 ? -value : value; }
INLINE Floats as_floats(Ints values) { return __builtin_convertvector(values, Floats); }
INLINE Ints as_ints(Floats values) { return __builtin_convertvector(values, Ints); }

#if LANES == 16
INLINE Floats square_root(Floats values) { return (Floats)_mm512_sqrt_ps((__m512)values); }
// One bit per lane.
INLINE uint32_t bits(Ints mask) { return _mm512_movepi32_mask((__m512i)mask); }
INLINE float smallest(Floats values) { return _mm512_reduce_min_ps((__m512)values); }
#elif LANES == 8
INLINE Floats square_root(Floats values) { return (Floats)_mm256_sqrt_ps((__m256)values); }
INLINE uint32_t bits(Ints mask) { return (uint32_t)_mm256_movemask_ps((__m256)mask); }
INLINE float smallest(Floats values) {
  __m128 half = _mm_min_ps(_mm256_castps256_ps128((__m256)values), _mm256_extractf128_ps((__m256)values, 1));
  half = _mm_min_ps(half, _mm_movehl_ps(half, half));
  return _mm_cvtss_f32(_mm_min_ss(half, _mm_shuffle_ps(half, half, 1)));
}
#else
INLINE Floats square_root(Floats values) { return (Floats)_mm_sqrt_ps((__m128)values); }
INLINE uint32_t bits(Ints mask) { return (uint32_t)_mm_movemask_ps((__m128)mask); }
INLINE float smallest(Floats values) {
  const __m128 half = _mm_min_ps((__m128)values, _mm_movehl_ps((__m128)values, (__m128)values));
  return _mm_cvtss_f32(_mm_min_ss(half, _mm_shuffle_ps(half, half, 1)));
}
#endif

INLINE float square_root(float value) { return __builtin_sqrtf(value); }
INLINE float larger(float a, float b) { return a > b ? a : b; }
INLINE float smaller(float a, float b) { return a < b ? a : b; }
INLINE float clamp(float value, float low, float high) { return smaller(high, larger(low, value)); }
INLINE float absolute(float value) { return __builtin_fabsf(value); }

INLINE float largest(Floats values) { return -smallest(-values); }
INLINE bool any(Ints mask) { return bits(mask) != 0; }

}  // namespace drivax::TARGET
