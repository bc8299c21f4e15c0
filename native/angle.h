// Angles of vectors, as many at once as a vector holds.
#pragma once

#include "simd.h"

namespace drivax::TARGET {

// Returns the angle of (x, y) in [-pi, pi], within 3e-7; 0 for the zero vector.
//
// The ratio of the smaller to the larger component is reduced to [-tan(pi/8), tan(pi/8)], where a polynomial of degree
// 9 (that of Cephes) has the precision of floats.
INLINE Floats arctangent(Floats y, Floats x) {
  const Floats width = absolute(x), height = absolute(y);
  const Ints is_steep = height > width;
  const Floats larger_side = select(is_steep, height, width), smaller_side = select(is_steep, width, height);
  const Floats ratio = smaller_side / larger(larger_side, splat(1e-30f));
  const Ints is_large = ratio > 0.41421356237f;
  const Floats reduced = select(is_large, (ratio - 1.0f) / (ratio + 1.0f), ratio), squared = reduced * reduced;
  Floats angle = 8.05374449538e-2f * squared - 1.38776856032e-1f;
  angle = angle * squared + 1.99777106478e-1f;
  angle = (angle * squared - 3.33329491539e-1f) * squared * reduced + reduced;
  angle += select(is_large, splat(0.78539816340f), Floats{});
  angle = select(is_steep, 1.57079632679f - angle, angle);
  angle = select(x < 0, 3.14159265359f - angle, angle);
  return select(y < 0, -angle, angle);
}

}  // namespace drivax::TARGET
