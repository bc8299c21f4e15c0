// Ego's frame: x ahead, y left.
#pragma once

#include "simd.h"

namespace drivax::TARGET {

struct View {
  float x, y, cos, sin;
};

// From ego's x, y, heading and speed, and the cosine and sine of its heading.
INLINE View view_of(const float* motion, const float* direction) {
  return {motion[0], motion[1], direction[0], direction[1]};
}

// Components of directions, velocities or offsets, one or a vector of them.
template <typename Value>
INLINE Value ahead(const View& view, Value x, Value y) {
  return x * view.cos + y * view.sin;
}

template <typename Value>
INLINE Value left(const View& view, Value x, Value y) {
  return y * view.cos - x * view.sin;
}

}  // namespace drivax::TARGET
