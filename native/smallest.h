// The index of the smallest value by one minimum, with the rule of drivax.scenario.bank.smallest: the low bits of each
// float hold its number, so that the first of nearly equal values wins.
#pragma once

#include "kernel.h"

#ifdef TARGET
namespace drivax::TARGET {

// Number of bits that hold the numbers 0 to `count` - 1.
INLINE int bits_for(int64_t count) {
  int bits = 0;
  while ((count - 1) >> bits) ++bits;
  return bits;
}

INLINE Floats embed_numbers(Floats values, Ints numbers, int bits) {
  const Ints key = (Ints)(clamp(values, Floats{}, splat(1e30f)) + 1e-6f);
  return (Floats)((key & splat((int32_t)-(1 << bits))) | numbers);
}

INLINE int32_t number_of(float key, int bits) {
  int32_t value;
  __builtin_memcpy(&value, &key, sizeof value);
  return value & ((1 << bits) - 1);
}

}  // namespace drivax::TARGET
#endif
