// The observation group `route`: points ahead on the route, in ego's frame.
#include "kernel.h"

namespace drivax {

struct RouteRows {
  const float* routes;        // [routes, points, 7]
  const int32_t* route_points;  // [routes]
  const float* goal;          // [routes, 2]
  const float* offsets_m;     // [count]
  const int32_t* row;         // [batch]: route
  const float* route_m;       // [batch]: arc length of ego
  Mask has_route;             // [batch]
  const float* motion;        // [batch, 4]: ego's x, y, heading, speed
  const float* direction;     // [batch, 2]: ego's cos, sin
  int64_t routes_count = -1, points = -1, count = -1;
  float half_window_m;  // of the curvature
  float position_m, speed_mps, curvature_pm, max_curvature, max_goal;  // units, and largest values in their units
  const int32_t* columns;  // [column_count]: RouteRowColumn
  int64_t column_count;
  float* rows;  // [batch, count, column_count]
  bool* mask;   // [batch, count]
};

// As in tasks/features.py.
enum RouteRowColumn {
  kX, kY, kSin, kCos, kLimit, kCurvature, kRecommendedSpeed, kGoalX, kGoalY, kRouteRowColumns
};

EACH_TARGET(void observe_route(const RouteRows& arguments, int64_t first, int64_t last);)

}  // namespace drivax

#ifdef TARGET

#include "angle.h"
#include "route.h"
#include "view.h"

namespace drivax::TARGET {

// What is read of each point, before it is transformed.
enum RoutePointField { kPointX, kPointY, kPointCos, kPointSin, kPointLimit, kWindow, kTurnCross, kTurnDot, kFields };

INLINE void read_point(const RouteRows& a, const float* route, float along_m, bool has_curvature, float end_m,
                       float (*fields)[LANES], int lane) {
  const RoutePlace place = place_on_route(route, a.points, along_m);
  fields[kPointX][lane] = place[kRouteX];
  fields[kPointY][lane] = place[kRouteY];
  fields[kPointCos][lane] = place[kRouteCos];
  fields[kPointSin][lane] = place[kRouteSin];
  fields[kPointLimit][lane] = place.row[kRouteLimit];
  if (!has_curvature) return;
  const float from_m = clamp(along_m - a.half_window_m, 0, end_m), to_m = clamp(along_m + a.half_window_m, 0, end_m);
  const RoutePlace from = place_on_route(route, a.points, from_m), to = place_on_route(route, a.points, to_m);
  const float cos0 = from[kRouteCos], sin0 = from[kRouteSin], cos1 = to[kRouteCos], sin1 = to[kRouteSin];
  fields[kWindow][lane] = to_m - from_m;
  fields[kTurnCross][lane] = cos0 * sin1 - sin0 * cos1;
  fields[kTurnDot][lane] = cos0 * cos1 + sin0 * sin1;
}

// Curvature, 1/m, averaged over the window.
INLINE Floats curvature(const float (*fields)[LANES]) {
  const Floats window = load(fields[kWindow]);
  const Floats turn = arctangent(load(fields[kTurnCross]), load(fields[kTurnDot]));
  return select(window > 0, turn, Floats{}) / larger(window, splat(1.0f));
}

INLINE void write_columns(const RouteRows& a, const View& view, const float (*fields)[LANES], bool has_curvature,
                          const float* goal, float (*values)[LANES]) {
  const Floats dx = load(fields[kPointX]) - view.x, dy = load(fields[kPointY]) - view.y;
  const Floats cos = load(fields[kPointCos]), sin = load(fields[kPointSin]), limit = load(fields[kPointLimit]);
  store(values[kX], ahead(view, dx, dy) / a.position_m);
  store(values[kY], left(view, dx, dy) / a.position_m);
  store(values[kSin], left(view, cos, sin));
  store(values[kCos], ahead(view, cos, sin));
  store(values[kLimit], select(limit > 0, limit / a.speed_mps, Floats{}));
  if (has_curvature) {
    const Floats per_m = curvature(fields), bound = splat(a.max_curvature);
    store(values[kCurvature], clamp(per_m / a.curvature_pm, -bound, bound));
    // The published speed, as in features.recommended_speed.
    const Floats speed = clamp(30.0f - 25.0f * absolute(per_m), splat(5.0f), splat(30.0f));
    store(values[kRecommendedSpeed], speed / a.speed_mps);
  }
  const float goal_x = goal[0] - view.x, goal_y = goal[1] - view.y;
  store(values[kGoalX], splat(clamp(ahead(view, goal_x, goal_y) / a.position_m, -a.max_goal, a.max_goal)));
  store(values[kGoalY], splat(clamp(left(view, goal_x, goal_y) / a.position_m, -a.max_goal, a.max_goal)));
}

void observe_route(const RouteRows& a, int64_t first, int64_t last) {
  bool has_curvature = false;
  for (int64_t i = 0; i < a.column_count; ++i)
    has_curvature |= a.columns[i] == kCurvature || a.columns[i] == kRecommendedSpeed;
  for (int64_t sample = first; sample < last; ++sample) {
    const int64_t number = clamp_row(a.row[sample], a.routes_count);
    const float* route = a.routes + number * a.points * kRouteColumns;
    const float end_m = end_of_route(a.route_points[number]), route_m = a.route_m[sample];
    if (sample + 1 < last) {
      const float* next = a.routes + clamp_row(a.row[sample + 1], a.routes_count) * a.points * kRouteColumns;
      for (int64_t i = 0; i < a.count; ++i)
        __builtin_prefetch(place_on_route(next, a.points, a.route_m[sample + 1] + a.offsets_m[i]).row);
    }
    const View view = view_of(a.motion + 4 * sample, a.direction + 2 * sample);
    float* row = a.rows + sample * a.count * a.column_count;
    bool* mask = a.mask + sample * a.count;
    if (!a.has_route[sample] || end_m < 0) {
      __builtin_memset(row, 0, sizeof(float) * a.count * a.column_count);
      __builtin_memset(mask, false, a.count);
      continue;
    }
    for (int64_t point = 0; point < a.count; point += LANES) {
      const int size = (int)(a.count - point < LANES ? a.count - point : LANES);
      alignas(64) float fields[kFields][LANES] = {}, values[kRouteRowColumns][LANES];
      for (int lane = 0; lane < size; ++lane) {
        const float along_m = route_m + a.offsets_m[point + lane];
        mask[point + lane] = along_m <= end_m;
        if (along_m <= end_m) read_point(a, route, along_m, has_curvature, end_m, fields, lane);
      }
      write_columns(a, view, fields, has_curvature, a.goal + 2 * number, values);
      for (int lane = 0; lane < size; ++lane)
        for (int64_t i = 0; i < a.column_count; ++i)
          *row++ = mask[point + lane] ? values[a.columns[i]][lane] : 0;
    }
  }
}

}  // namespace drivax::TARGET

#else

namespace drivax {

static ffi::Error observe_route(ffi::ThreadPool pool, ffi::RemainingArgs arguments, ffi::RemainingRets results,
                                Numbers columns, float half_window_m, float position_m, float speed_mps,
                                float curvature_pm, float max_curvature, float max_goal) {
  Arrays arrays(pool, arguments, results);
  RouteRows a;
  a.columns = columns.begin();
  a.column_count = columns.size();
  arrays.common(a.routes, {a.routes_count, a.points, 7});
  arrays.common(a.route_points, {a.routes_count});
  arrays.common(a.goal, {a.routes_count, 2});
  arrays.common(a.offsets_m, {a.count});
  arrays.batched(a.row, {});
  arrays.batched(a.route_m, {});
  arrays.batched(a.has_route, {});
  arrays.batched(a.motion, {4});
  arrays.batched(a.direction, {2});
  arrays.batched(a.rows, {a.count, a.column_count});
  arrays.batched(a.mask, {a.count});
  arrays.nonempty({a.routes_count, a.points});
  arrays.columns(columns, kRouteRowColumns);
  a.half_window_m = half_window_m;
  a.position_m = position_m;
  a.speed_mps = speed_mps;
  a.curvature_pm = curvature_pm;
  a.max_curvature = max_curvature;
  a.max_goal = max_goal;
  return arrays.run(64, [&](int64_t first, int64_t last) { CALL(observe_route, a, first, last); });
}

BIND(observe_route,
     .Attr<Numbers>("columns").Attr<float>("half_window_m").Attr<float>("position_m").Attr<float>("speed_mps")
     .Attr<float>("curvature_pm").Attr<float>("max_curvature").Attr<float>("max_goal"))

}  // namespace drivax

#endif
