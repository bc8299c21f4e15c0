// The order of drivax.scenario.bank.smallest: by values without their low bits, then by number.
#pragma once

#include "simd.h"

namespace drivax::TARGET {

// Bits that hold the numbers below `count`.
INLINE int bits_for(int64_t count) {
  int bits = 0;
  for (int64_t left = count - 1; left > 0; left >>= 1) ++bits;
  return bits;
}

// Values as first_smallest compares them: larger than zero, and finite; NaN counts as zero.
INLINE Floats comparable(Floats value) { return smaller(larger(value, Floats{}), splat(1e30f)) + 1e-6f; }
INLINE float comparable(float value) { return smaller(larger(value, 0.0f), 1e30f) + 1e-6f; }

INLINE Ints pattern(Floats value) {
  Ints result;
  __builtin_memcpy(&result, &value, sizeof result);
  return result;
}

INLINE int32_t pattern(float value) {
  int32_t result;
  __builtin_memcpy(&result, &value, sizeof result);
  return result;
}

// Positive values with numbers in their low bits: the smallest of them has the smallest value and the first number.
INLINE Floats embed_numbers(Floats value, Ints number, int bits) {
  const Ints key = (pattern(value) & ~((1 << bits) - 1)) | number;
  Floats result;
  __builtin_memcpy(&result, &key, sizeof result);
  return result;
}

INLINE int32_t number_of(float key, int bits) { return pattern(key) & ((1 << bits) - 1); }

// The same order of single values, for any number.
INLINE int64_t order_of(float value, int64_t number, int bits) {
  return (int64_t)(pattern(value) >> bits) * (INT64_C(1) << 32) | number;
}

}  // namespace drivax::TARGET
