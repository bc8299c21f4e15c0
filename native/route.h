// Routes: points 1 m apart in rows of x, y, z, cosine and sine of the heading, speed limit and lane.
#pragma once

#include "simd.h"

namespace drivax::TARGET {

enum RouteColumn { kRouteX, kRouteY, kRouteZ, kRouteCos, kRouteSin, kRouteLimit, kRouteLane, kRouteColumns };

// A row index that is inside of its array, whatever the caller passed; XLA counts negative ones from the end.
INLINE int64_t clamp_row(int64_t row, int64_t count) { return row < 0 ? 0 : row < count ? row : count - 1; }

// Arc length of the last of `points` points; negative for a route without two points, whatever a file says.
INLINE float end_of_route(int32_t points) { return points > 1 ? (float)(points - 1) : -1.0f; }

// A place between two points of a route.
struct RoutePlace {
  const float* row;
  const float* next;
  float part;

  float operator[](int column) const { return row[column] * (1 - part) + next[column] * part; }
};

// Beyond the last of `count` points the place lies on the continued line between the last two.
INLINE RoutePlace place_on_route(const float* route, int64_t count, float along_m) {
  const float at = along_m > 0 ? along_m : 0;
  const int64_t last = count > 1 ? count - 2 : 0;
  const int64_t low = at < (float)last ? (int64_t)at : last;
  const float* row = route + low * kRouteColumns;
  return {row, count > 1 ? row + kRouteColumns : row, at - (float)low};
}

// Asks for the points from `from_m` to `to_m`, which the next sample reads.
INLINE void prefetch_route(const float* route, int64_t count, float from_m, float to_m) {
  const char* address = (const char*)place_on_route(route, count, from_m).row;
  const char* end = (const char*)place_on_route(route, count, to_m).next;
  for (; address <= end; address += 64) __builtin_prefetch(address);
}

}  // namespace drivax::TARGET
