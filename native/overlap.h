// Oriented rectangles, a vector of them at once: see geometry/boxes.py.
#pragma once

#include "simd.h"

namespace drivax::TARGET {

enum BoxColumn { kBoxX, kBoxY, kBoxCos, kBoxSin, kBoxLength, kBoxWidth, kBoxColumns };

// Boxes that move with constant velocity and heading.
struct MovingBoxes {
  Floats x, y, cos, sin, length, width, vx, vy;
};

// One box in all lanes; `box` has the columns above.
INLINE MovingBoxes splat_box(const float* box, const float* velocity) {
  return {splat(box[kBoxX]),     splat(box[kBoxY]),      splat(box[kBoxCos]),  splat(box[kBoxSin]),
          splat(box[kBoxLength]), splat(box[kBoxWidth]), splat(velocity[0]), splat(velocity[1])};
}

// The time in which boxes overlap on the axes so far.
struct OverlapInterval {
  Floats begin, end;
  Ints overlaps_now;
};

// Intersects the interval with that on one axis; `reach` is the sum of the half extents along it.
INLINE void include_axis(OverlapInterval& interval, Floats distance, Floats speed, Floats reach, float horizon_s) {
  const Ints is_moving = absolute(speed) > 1e-9f;
  const Floats inverse = 1.0f / select(is_moving, speed, splat(1.0f));
  const Floats first = (-reach - distance) * inverse, second = (reach - distance) * inverse;
  const Ints overlaps = absolute(distance) < reach;
  const Floats never = splat(horizon_s);
  const Floats enter = select(is_moving, smaller(first, second), select(overlaps, Floats{}, never));
  const Floats leave = select(is_moving, larger(first, second), never);
  interval.begin = larger(interval.begin, enter);
  interval.end = smaller(interval.end, leave);
  interval.overlaps_now &= overlaps;
}

// Returns the first time at which boxes overlap, at most the horizon, and whether they overlap now.
INLINE Floats time_to_overlap(const MovingBoxes& a, const MovingBoxes& b, float horizon_s, Ints* overlaps_now) {
  const Floats dx = b.x - a.x, dy = b.y - a.y, vx = b.vx - a.vx, vy = b.vy - a.vy;
  const Floats length_a = a.length * 0.5f, width_a = a.width * 0.5f;
  const Floats length_b = b.length * 0.5f, width_b = b.width * 0.5f;
  const Floats cos = absolute(a.cos * b.cos + a.sin * b.sin), sin = absolute(a.cos * b.sin - a.sin * b.cos);
  OverlapInterval interval = {Floats{}, splat(horizon_s), ~Ints{}};
  const auto axis = [&](Floats x, Floats y, Floats reach) __attribute__((always_inline)) {
    include_axis(interval, dx * x + dy * y, vx * x + vy * y, reach, horizon_s);
  };
  axis(a.cos, a.sin, length_a + length_b * cos + width_b * sin);
  axis(-a.sin, a.cos, width_a + length_b * sin + width_b * cos);
  axis(b.cos, b.sin, length_b + length_a * cos + width_a * sin);
  axis(-b.sin, b.cos, width_b + length_a * sin + width_a * cos);
  *overlaps_now = interval.overlaps_now;
  return select(interval.begin < interval.end, interval.begin, splat(horizon_s));
}

}  // namespace drivax::TARGET
