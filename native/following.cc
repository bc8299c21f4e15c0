// The look ahead of a car-following driver along its route: the leader, lights that require a stop, and curves.
#include "kernel.h"

namespace drivax {

// As in drivax.simulator.ahead and drivax.simulator.traffic.corridor; the binding checks that they are the same.
constexpr int kPoints = 46;      // ahead on the route
constexpr int kRectangles = 9;   // around equal numbers of pieces between the points
constexpr int kClosest = 8;      // agents that are measured against the points, at most
constexpr int kPieces = (kPoints - 1) / kRectangles;

struct FollowingRules {
  int32_t points, rectangles, closest;
  int32_t slot_bits;                     // low bits of a squared distance that hold a slot
  int32_t red, red_arrow, yellow, yellow_arrow;
  float step_m;                          // between points
  float near_m;                          // margin of the rectangles on either side of the driven agent
  float ends_m;                          // by which the first and the last rectangle are longer
  float level_m;                         // largest difference of heights
  float side_m;                          // free space next to the driven agent
  float least_gap_m;                     // lower bound of gaps that are compared
  float free_m;                          // gap of a free road
  float limit_mps;                       // speed limit where it is unknown
  float curve_mps2, curve_braking_mps2;  // lateral acceleration in curves, braking towards them
  float yellow_braking_mps2;             // of a car that can stop at a yellow light
  float stop_short_m;                    // distance before a line at which cars stop
};

struct Following : FollowingRules {
  const float* routes;          // [rows, route_size, 7]
  const int32_t* route_points;  // [rows]
  const float* light_line;      // [scenarios, light_rows, lights]
  const float* box;             // [batch, slots, 6]
  const float* velocity;        // [batch, slots, 2]
  const float* z;               // [batch, slots]
  Mask valid;                   // [batch, slots]
  const int8_t* light_state;    // [batch, lights]
  const int32_t* slot;          // [batch]: the driven agent
  const int32_t* index;         // [batch]: its scenario
  const int32_t* row;           // [batch]: its route
  const int32_t* arc;           // [batch]: row of `light_line` with the arc lengths on it
  const float* route_m;         // [batch]: its arc length
  const float* speed;           // [batch]
  const float* min_gap_m;       // [batch]: that the driver keeps behind a standing leader
  int64_t slots = -1, rows = -1, route_size = -1, scenarios = -1, light_rows = -1, lights = -1;
  float* gap_m;                 // [batch]
  float* leader_mps;            // [batch]
  float* desired_mps;           // [batch]
};

EACH_TARGET(void look_ahead(const Following& arguments, int64_t first, int64_t last);)

}  // namespace drivax

#ifdef TARGET

#include "angle.h"
#include "order.h"
#include "overlap.h"
#include "route.h"

namespace drivax::TARGET {

// Whole vectors, and one more for the next of each.
constexpr int kPointSpace = (kPoints + 15) / 16 * 16 + 16, kRectangleSpace = (kRectangles + 15) / 16 * 16 + 16;

struct Path {
  alignas(64) float x[kPointSpace], y[kPointSpace], cos[kPointSpace], sin[kPointSpace];
  // The same positions by rectangle, and by number in it.
  alignas(64) float node_x[kPieces][kRectangleSpace], node_y[kPieces][kRectangleSpace];
  int count;        // points that the route reaches: the first ones
  float limit_mps;  // at the first point
};

// Rectangles around the path, by column: centre, direction, half length and half width.
struct Corridor {
  alignas(64) float x[kRectangleSpace], y[kRectangleSpace], cos[kRectangleSpace], sin[kRectangleSpace];
  alignas(64) float length[kRectangleSpace], width[kRectangleSpace];
};

static void read_path(const Following& a, int64_t sample, Path* path) {
  const int64_t row = clamp_row(a.row[sample], a.rows);
  const float* route = a.routes + row * a.route_size * kRouteColumns;
  const float along_m = a.route_m[sample];
  const float end_m = end_of_route(a.route_points[row]);
  path->count = 0;
  // The first point counts for leaders even where the route has ended.
  for (int i = 0; i < kPoints; ++i) {
    const float at = along_m + a.step_m * i;
    const bool is_on_route = at <= end_m && end_m > 0;
    if (i && !is_on_route) break;
    const RoutePlace place = place_on_route(route, a.route_size, at);
    path->x[i] = place[kRouteX];
    path->y[i] = place[kRouteY];
    path->cos[i] = place[kRouteCos];
    path->sin[i] = place[kRouteSin];
    if (i == 0) path->limit_mps = place.row[kRouteLimit];
    path->count += is_on_route;
  }
  for (int i = path->count > 1 ? path->count : 1; i < kPoints; ++i) {
    path->x[i] = path->x[0];
    path->y[i] = path->y[0];
    path->cos[i] = path->cos[0];
    path->sin[i] = path->sin[0];
  }
  for (int point = 0; point < kPoints; ++point) {
    path->node_x[point % kPieces][point / kPieces] = path->x[point];
    path->node_y[point % kPieces][point / kPieces] = path->y[point];
  }
}

static void surround(const Following& a, const Path& path, float half_m, Corridor* corridor) {
  for (int start = 0; start < kRectangles; start += LANES) {
    const Floats x = load(path.node_x[0] + start), y = load(path.node_y[0] + start);
    // The next rectangle begins where this one ends.
    const Floats chord_x = load(path.node_x[0] + start + 1) - x, chord_y = load(path.node_y[0] + start + 1) - y;
    const Floats chord = square_root(larger(chord_x * chord_x + chord_y * chord_y, splat(1e-6f)));
    // Beyond the end of a route all points are equal, and any direction works.
    const Ints has_direction = chord > 1e-2f;
    const Floats cos = select(has_direction, chord_x / chord, splat(1.0f));
    const Floats sin = select(has_direction, chord_y / chord, Floats{});
    Floats rear = {}, front = chord, right = {}, left = {};
    for (int i = 1; i < kPieces; ++i) {
      const Floats dx = load(path.node_x[i] + start) - x, dy = load(path.node_y[i] + start) - y;
      const Floats along = dx * cos + dy * sin, across = dy * cos - dx * sin;
      rear = smaller(rear, along);
      front = larger(front, along);
      right = smaller(right, across);
      left = larger(left, across);
    }
    const Ints number = numbers() + start;
    rear = rear - half_m - select(number == 0, splat(a.ends_m), Floats{});
    front = front + half_m + select(number == kRectangles - 1, splat(a.ends_m), Floats{});
    right -= half_m;
    left += half_m;
    const Floats along = (rear + front) / 2.0f, across = (right + left) / 2.0f;
    store(corridor->x + start, x + along * cos - across * sin);
    store(corridor->y + start, y + along * sin + across * cos);
    store(corridor->cos + start, cos);
    store(corridor->sin + start, sin);
    // Nothing reaches into rectangles that do not exist.
    store(corridor->length + start, select(number < kRectangles, (front - rear) / 2.0f, splat(-kInfinity)));
    store(corridor->width + start, (left - right) / 2.0f);
  }
}

INLINE bool reaches(const Corridor& corridor, const float* box) {
  const Floats x = splat(box[kBoxX]), y = splat(box[kBoxY]), cos = splat(box[kBoxCos]), sin = splat(box[kBoxSin]);
  const Floats half_length = splat(box[kBoxLength] / 2), half_width = splat(box[kBoxWidth] / 2);
  Ints inside = {};
  for (int i = 0; i < kRectangles; i += LANES) {
    const Floats axis_x = load(corridor.cos + i), axis_y = load(corridor.sin + i);
    const Floats dx = x - load(corridor.x + i), dy = y - load(corridor.y + i);
    const Floats turn_cos = absolute(cos * axis_x + sin * axis_y), turn_sin = absolute(sin * axis_x - cos * axis_y);
    const Floats length = load(corridor.length + i) + turn_cos * half_length + turn_sin * half_width;
    const Floats width = load(corridor.width + i) + turn_sin * half_length + turn_cos * half_width;
    inside |= (absolute(dx * axis_x + dy * axis_y) < length) & (absolute(dy * axis_x - dx * axis_y) < width);
  }
  return any(inside);
}

// The closest agents in or near the corridor, in the order of their distances.
struct Closest {
  int64_t orders[kClosest];
  int count = 0;

  __attribute__((always_inline)) void include(int64_t order) {
    if (count == kClosest && order >= orders[count - 1]) return;
    int place = count < kClosest ? count++ : count - 1;
    for (; place > 0 && orders[place - 1] > order; --place) orders[place] = orders[place - 1];
    orders[place] = order;
  }

  int32_t slot(int number) const { return (int32_t)orders[number]; }
};

struct Leader {
  float gap_m, speed_mps;
};

// Measures an agent against the path: gap, infinite unless it blocks the path, and speed along the path.
static Leader measure_leader(const Following& a, const Path& path, const float* ego, const float* box,
                             const float* velocity) {
  constexpr int kBits = 6;
  static_assert(kPoints <= 1 << kBits && kPoints > 1 << (kBits - 1));
  const Floats x = splat(box[kBoxX]), y = splat(box[kBoxY]);
  Floats smallest_key = splat(kInfinity);
  for (int i = 0; i < kPoints; i += LANES) {
    const Floats dx = x - load(path.x + i), dy = y - load(path.y + i);
    const Floats squared = select(numbers() + i < path.count, dx * dx + dy * dy, splat(kInfinity));
    smallest_key = smaller(smallest_key, embed_numbers(comparable(squared), numbers() + i, kBits));
  }
  const int nearest = number_of(smallest(smallest_key), kBits);
  const float dx = box[kBoxX] - path.x[nearest], dy = box[kBoxY] - path.y[nearest];
  const float axis_x = path.cos[nearest], axis_y = path.sin[nearest];
  const float forward = dx * axis_x + dy * axis_y, lateral = dy * axis_x - dx * axis_y;
  const float cos = box[kBoxCos] * axis_x + box[kBoxSin] * axis_y, sin = box[kBoxSin] * axis_x - box[kBoxCos] * axis_y;
  const float turn_cos = __builtin_fabsf(cos), turn_sin = __builtin_fabsf(sin);
  const float half_length = turn_cos * box[kBoxLength] / 2 + turn_sin * box[kBoxWidth] / 2;
  const float half_width = turn_sin * box[kBoxLength] / 2 + turn_cos * box[kBoxWidth] / 2;
  const float along = a.step_m * nearest + forward;
  const bool is_alongside = __builtin_fabsf(forward) <= 2 * a.step_m;
  const bool reaches_in = __builtin_fabsf(lateral) < half_width + ego[kBoxWidth] / 2 + a.side_m;
  const bool blocks = is_alongside && reaches_in && along > 0;
  const float gap_m = blocks ? along - half_length - ego[kBoxLength] / 2 : kInfinity;
  return {gap_m, __builtin_sqrtf(velocity[0] * velocity[0] + velocity[1] * velocity[1]) * cos};
}

static Leader find_leader(const Following& a, int64_t sample, const Path& path) {
  const int64_t start = sample * a.slots;
  const float* boxes = a.box + start * kBoxColumns;
  const float* velocities = a.velocity + start * 2;
  const int32_t own = a.slot[sample];
  const int64_t slot = clamp_row(own, a.slots);
  const float* ego = boxes + slot * kBoxColumns;
  const float height = a.z[start + slot];
  Corridor corridor;
  surround(a, path, ego[kBoxWidth] / 2 + a.near_m, &corridor);
  Closest closest;
  for (int32_t i = 0; i < a.slots; ++i) {
    const bool counts = a.valid[start + i] & (i != own) & (__builtin_fabsf(a.z[start + i] - height) <= a.level_m);
    const float* box = boxes + i * (int64_t)kBoxColumns;
    if (!counts || !reaches(corridor, box)) continue;
    const float dx = box[kBoxX] - ego[kBoxX], dy = box[kBoxY] - ego[kBoxY];
    closest.include(order_of(1.0f + (dx * dx + dy * dy), i, a.slot_bits));
  }
  // Without any agent the speed is that of the first slot, which means nothing.
  if (!closest.count) return {kInfinity, measure_leader(a, path, ego, boxes, velocities).speed_mps};
  Leader leader = {};
  int64_t smallest_order = INT64_MAX;
  for (int i = 0; i < closest.count; ++i) {
    const int64_t other = closest.slot(i);
    const Leader found = measure_leader(a, path, ego, boxes + other * kBoxColumns, velocities + other * 2);
    const int64_t order = order_of(comparable(found.gap_m - a.least_gap_m), i, bits_for(kClosest));
    if (order >= smallest_order) continue;
    smallest_order = order;
    leader = found;
  }
  return leader;
}

// Distance from the front bumper to the nearest stop line that requires a stop; infinite without one.
static float stop_line_m(const Following& a, int64_t sample, float half_length) {
  const int64_t index = clamp_row(a.index[sample], a.scenarios), row = clamp_row(a.arc[sample], a.light_rows);
  const float* arc = a.light_line + (index * a.light_rows + row) * a.lights;
  const int8_t* states = a.light_state + sample * a.lights;
  const float speed = a.speed[sample];
  float nearest = kInfinity;
  for (int64_t i = 0; i < a.lights; ++i) {
    const int8_t state = states[i];
    const bool is_red = state == a.red || state == a.red_arrow;
    const bool is_yellow = state == a.yellow || state == a.yellow_arrow;
    if (!is_red && !is_yellow) continue;
    const float distance = arc[i] - a.route_m[sample] - half_length;
    const float braking_m = distance > 0.1f ? distance : 0.1f;
    if (is_yellow && !(speed * speed / (2 * braking_m) < a.yellow_braking_mps2)) continue;
    if (distance > 0 && distance < kPoints * a.step_m && distance < nearest) nearest = distance;
  }
  return nearest;
}

// The present speed limit, or the lower speed that the curves ahead require.
static float desired_speed(const Following& a, const Path& path) {
  Floats squared = splat(kInfinity);
  for (int i = 0; i < kPoints - 1; i += LANES) {
    const Floats cos = load(path.cos + i), sin = load(path.sin + i);
    const Floats next_cos = load(path.cos + i + 1), next_sin = load(path.sin + i + 1);
    const Floats dot = next_cos * cos + next_sin * sin, cross = cos * next_sin - next_cos * sin;
    const Ints number = numbers() + i;
    Floats curvature = arctangent(absolute(cross), dot) / a.step_m;
    curvature = select(number + 1 < path.count, curvature, Floats{});
    const Floats offset = as_floats(number) * a.step_m;
    const Floats here = a.curve_mps2 / larger(curvature, splat(1e-4f)) + 2 * a.curve_braking_mps2 * offset;
    squared = smaller(squared, select(number < kPoints - 1, here, splat(kInfinity)));
  }
  const float limit = path.limit_mps > 0 ? path.limit_mps : a.limit_mps;
  const float curves = __builtin_sqrtf(smallest(squared));
  return limit < curves ? limit : curves;
}

void look_ahead(const Following& a, int64_t first, int64_t last) {
  Path path = {};
  for (int64_t sample = first; sample < last; ++sample) {
    if (sample + 1 < last) {
      const int64_t row = clamp_row(a.row[sample + 1], a.rows);
      const float along_m = a.route_m[sample + 1];
      prefetch_route(a.routes + row * a.route_size * kRouteColumns, a.route_size, along_m,
                     along_m + kPoints * a.step_m);
    }
    read_path(a, sample, &path);
    const Leader leader = find_leader(a, sample, path);
    const int64_t slot = clamp_row(a.slot[sample], a.slots);
    const float half_length = a.box[(sample * a.slots + slot) * kBoxColumns + kBoxLength] / 2;
    // The driver stops min_gap_m behind a leader, but stop_short_m before a line.
    const float stop = stop_line_m(a, sample, half_length) + a.min_gap_m[sample] - a.stop_short_m;
    const float gap = leader.gap_m < stop ? leader.gap_m : stop;
    a.gap_m[sample] = gap < kInfinity ? gap : a.free_m;
    a.leader_mps[sample] = stop < leader.gap_m ? 0 : leader.speed_mps;
    // Without a second point the route ends within one step.
    a.desired_mps[sample] = path.count > 1 ? desired_speed(a, path) : 0;
  }
}

}  // namespace drivax::TARGET

#else

XLA_FFI_REGISTER_STRUCT_ATTR_DECODING(
    drivax::FollowingRules, StructMember<int32_t>("points"), StructMember<int32_t>("rectangles"),
    StructMember<int32_t>("closest"), StructMember<int32_t>("slot_bits"), StructMember<int32_t>("red"),
    StructMember<int32_t>("red_arrow"), StructMember<int32_t>("yellow"), StructMember<int32_t>("yellow_arrow"),
    StructMember<float>("step_m"), StructMember<float>("near_m"), StructMember<float>("ends_m"),
    StructMember<float>("level_m"), StructMember<float>("side_m"), StructMember<float>("least_gap_m"),
    StructMember<float>("free_m"), StructMember<float>("limit_mps"), StructMember<float>("curve_mps2"),
    StructMember<float>("curve_braking_mps2"), StructMember<float>("yellow_braking_mps2"),
    StructMember<float>("stop_short_m"));

namespace drivax {

static ffi::Error look_ahead(ffi::ThreadPool pool, ffi::RemainingArgs arguments, ffi::RemainingRets results,
                             FollowingRules rules) {
  Arrays arrays(pool, arguments, results);
  Following a = {rules};
  arrays.common(a.routes, {a.rows, a.route_size, 7});
  arrays.common(a.route_points, {a.rows});
  arrays.common(a.light_line, {a.scenarios, a.light_rows, a.lights});
  arrays.batched(a.box, {a.slots, 6});
  arrays.batched(a.velocity, {a.slots, 2});
  arrays.batched(a.z, {a.slots});
  arrays.batched(a.valid, {a.slots});
  arrays.batched(a.light_state, {a.lights});
  arrays.batched(a.slot, {});
  arrays.batched(a.index, {});
  arrays.batched(a.row, {});
  arrays.batched(a.arc, {});
  arrays.batched(a.route_m, {});
  arrays.batched(a.speed, {});
  arrays.batched(a.min_gap_m, {});
  arrays.batched(a.gap_m, {});
  arrays.batched(a.leader_mps, {});
  arrays.batched(a.desired_mps, {});
  arrays.nonempty({a.rows, a.route_size, a.scenarios, a.light_rows, a.slots});
  arrays.require(rules.points == kPoints && rules.rectangles == kRectangles && rules.closest == kClosest,
                 "compiled for other numbers of points, rectangles or agents");
  arrays.require(0 <= rules.slot_bits && rules.slot_bits < 32, "slots take up all bits of a distance");
  return arrays.run(32, [&](int64_t first, int64_t last) { CALL(look_ahead, a, first, last); });
}

BIND(look_ahead, .Attrs<FollowingRules>())

}  // namespace drivax

#endif
