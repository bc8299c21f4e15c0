// The observation group `agents` at the present step: the agents nearest to ego, nearest first.
#include "kernel.h"

namespace drivax {

struct AgentRows {
  const float* size;            // [scenarios, slots, 4]: length, width, height, kind
  const float* routes;          // [routes, points, 7]
  const int32_t* route_points;  // [routes]
  const float* offsets_m;       // [offsets]: points on the route on which agents are projected, relative to ego
  const float* box;             // [batch, slots, 6]: x, y, cos, sin, length, width
  const float* velocity;        // [batch, slots, 2]
  const bool* valid;            // [batch, slots]
  const int32_t* kind;          // [batch, slots]
  const int32_t* slot;          // [batch], of ego
  const int32_t* index;         // [batch]: scenario
  const int32_t* row;           // [batch]: route
  const float* route_m;         // [batch]: arc length of ego
  const bool* has_route;        // [batch]
  const float* motion;          // [batch, 4]: ego's x, y, heading, speed
  const float* direction;       // [batch, 2]: ego's cos, sin
  int64_t scenarios, routes_count, points, offsets, batch, slots, count;
  const int32_t* kinds;  // [4], of the columns of the type
  // Units; largest distances beside the route and, along it, from the nearest point; horizon.
  float position_m, speed_mps, size_m, side_m, alongside_m, horizon_s;
  const int32_t* columns;  // [column_count]: AgentRowColumn
  int64_t column_count;
  float* rows;  // [batch, count, column_count]
  bool* mask;   // [batch, count]
};

// As in tasks/features.py.
enum AgentRowColumn {
  kX, kY, kSin, kCos, kAhead, kLeft, kRelativeAhead, kRelativeLeft, kTime, kLength, kWidth, kHeight,
  kIsVehicle, kIsPedestrian, kIsCyclist, kIsOther, kRouteAlong, kRouteLeft, kRouteSine, kRouteCosine,
  kClosingSpeed, kImminence, kAgentRowColumns
};

struct AgentScratch {
  float* distance;   // [slots + 16]: squared, of valid agents
  int32_t* agent;    // [slots + 16]: their slots
  int32_t* nearest;  // [count]: the slots of the nearest agents
  float* path;       // [offsets, 4]: x, y, cos, sin of the route
  int32_t* on_route; // [offsets]: numbers of the points that are on the route
};

EACH_TARGET(void observe_agents(const AgentRows& arguments, int64_t first, int64_t last, const AgentScratch& scratch);)

}  // namespace drivax

#ifdef TARGET

#include "overlap.h"
#include "route.h"
#include "view.h"

namespace drivax::TARGET {

enum PathColumn { kPathX, kPathY, kPathCos, kPathSin, kPathColumns };
enum { kSizeHeight = 2, kSizeColumns = 4, kMotionSpeed = 3, kTypes = 4 };

// Writes the slots of the nearest agents in ascending order, and returns how many there are, at most `count`.
//
// The rank of an agent is the number of agents that are nearer, or as near with a lower slot.
INLINE int64_t find_nearest(const AgentRows& a, int64_t sample, const View& view, const AgentScratch& scratch) {
  const float* box = a.box + sample * a.slots * kBoxColumns;
  const bool* valid = a.valid + sample * a.slots;
  int64_t size = 0;
  for (int64_t slot = 0; slot < a.slots; ++slot) {
    const float dx = box[slot * kBoxColumns + kBoxX] - view.x, dy = box[slot * kBoxColumns + kBoxY] - view.y;
    const float squared = dx * dx + dy * dy;
    scratch.agent[size] = (int32_t)slot;
    // NaN would have no rank.
    scratch.distance[size] = squared < kInfinity ? squared : kInfinity;
    size += valid[slot] & (slot != a.slot[sample]);
  }
  store(scratch.distance + size, splat(kInfinity));
  for (int64_t i = 0; i < size; ++i) {
    const Floats distance = splat(scratch.distance[i]);
    int64_t rank = 0;
    for (int64_t j = 0; j < size; j += LANES) {
      const Floats others = load(scratch.distance + j);
      const Ints is_before = numbers() < (int32_t)(i - j);
      rank += __builtin_popcount(bits((others < distance) | ((others == distance) & is_before)));
    }
    if (rank < a.count) scratch.nearest[rank] = scratch.agent[i];
  }
  return size < a.count ? size : a.count;
}

// Writes the points of the route around ego, and returns how many of them are on it.
INLINE int64_t read_path(const AgentRows& a, const float* route, float route_m, float end_m,
                         const AgentScratch& scratch) {
  int64_t size = 0;
  for (int64_t i = 0; i < a.offsets; ++i) {
    const float along_m = route_m + a.offsets_m[i];
    const RoutePlace place = place_on_route(route, a.points, along_m);
    float* point = scratch.path + i * kPathColumns;
    point[kPathX] = place[kRouteX];
    point[kPathY] = place[kRouteY];
    point[kPathCos] = place[kRouteCos];
    point[kPathSin] = place[kRouteSin];
    scratch.on_route[size] = (int32_t)i;
    size += (along_m >= 0) & (along_m <= end_m);
  }
  return size;
}

// Numbers of the points that are nearest to agents; of nearly equal distances the first, as in bank/smallest.py.
INLINE Ints nearest_point(const float* path, const int32_t* on_route, int64_t size, int32_t number_mask, Floats x,
                          Floats y) {
  Floats smallest_key = (Floats)((Ints)splat(1e30f) & ~number_mask);
  for (int64_t i = 0; i < size; ++i) {
    const float* point = path + on_route[i] * kPathColumns;
    const Floats dx = x - point[kPathX], dy = y - point[kPathY];
    const Floats distance = smaller(dx * dx + dy * dy, splat(1e30f)) + 1e-6f;
    smallest_key = smaller(smallest_key, (Floats)(((Ints)distance & ~number_mask) | on_route[i]));
  }
  return (Ints)smallest_key & number_mask;
}

// A vector of agents.
struct AgentVector {
  MovingBoxes boxes;
  const int32_t* slot;  // [size]
  int size;
};

INLINE void write_motion(const AgentRows& a, const View& view, float speed, const MovingBoxes& boxes,
                         float (*values)[LANES]) {
  const Floats dx = boxes.x - view.x, dy = boxes.y - view.y;
  const Floats vx = boxes.vx - speed * view.cos, vy = boxes.vy - speed * view.sin;
  const float per_position = 1 / a.position_m, per_speed = 1 / a.speed_mps, per_size = 1 / a.size_m;
  store(values[kX], ahead(view, dx, dy) * per_position);
  store(values[kY], left(view, dx, dy) * per_position);
  store(values[kSin], left(view, boxes.cos, boxes.sin));
  store(values[kCos], ahead(view, boxes.cos, boxes.sin));
  store(values[kAhead], ahead(view, boxes.vx, boxes.vy) * per_speed);
  store(values[kLeft], left(view, boxes.vx, boxes.vy) * per_speed);
  store(values[kRelativeAhead], ahead(view, vx, vy) * per_speed);
  store(values[kRelativeLeft], left(view, vx, vy) * per_speed);
  store(values[kTime], Floats{});
  store(values[kLength], boxes.length * per_size);
  store(values[kWidth], boxes.width * per_size);
}

INLINE void write_kind(const AgentRows& a, int64_t sample, const AgentVector& agents, float (*values)[LANES]) {
  const float* sizes = a.size + clamp_row(a.index[sample], a.scenarios) * a.slots * kSizeColumns;
  for (int lane = 0; lane < agents.size; ++lane) {
    const int64_t slot = agents.slot[lane];
    const int32_t kind = a.kind[sample * a.slots + slot];
    for (int type = 0; type < kTypes; ++type) values[kIsVehicle + type][lane] = kind == a.kinds[type];
    values[kHeight][lane] = sizes[slot * kSizeColumns + kSizeHeight] / a.size_m;
  }
}

INLINE void write_route(const AgentRows& a, const MovingBoxes& boxes, const float* path, const int32_t* on_route,
                        int64_t size, int32_t number_mask, float (*values)[LANES]) {
  alignas(64) int32_t nearest[LANES];
  alignas(64) float points[kPathColumns][LANES], offset[LANES];
  store(nearest, nearest_point(path, on_route, size, number_mask, boxes.x, boxes.y));
  for (int lane = 0; lane < LANES; ++lane) {
    const int64_t number = nearest[lane] < a.offsets ? nearest[lane] : a.offsets - 1;
    for (int column = 0; column < kPathColumns; ++column) points[column][lane] = path[number * kPathColumns + column];
    offset[lane] = a.offsets_m[number];
  }
  const Floats dx = boxes.x - load(points[kPathX]), dy = boxes.y - load(points[kPathY]);
  const Floats cos = load(points[kPathCos]), sin = load(points[kPathSin]);
  const Floats forward = dx * cos + dy * sin, left = dy * cos - dx * sin;
  const Floats side = splat(a.side_m);
  const Floats clipped = select(absolute(forward) <= a.alongside_m, clamp(left, -side, side), side);
  store(values[kRouteAlong], (load(offset) + forward) / a.position_m);
  store(values[kRouteLeft], clipped / a.size_m);
  store(values[kRouteSine], boxes.sin * cos - boxes.cos * sin);
  store(values[kRouteCosine], boxes.cos * cos + boxes.sin * sin);
}

INLINE void write_approach(const AgentRows& a, const MovingBoxes& ego, const MovingBoxes& boxes,
                           float (*values)[LANES]) {
  const Floats dx = boxes.x - ego.x, dy = boxes.y - ego.y, vx = boxes.vx - ego.vx, vy = boxes.vy - ego.vy;
  const Floats distance = larger(square_root(dx * dx + dy * dy), splat(1.0f));
  store(values[kClosingSpeed], -(dx * vx + dy * vy) / distance / a.speed_mps);
  Ints overlaps_now;
  store(values[kImminence], 1.0f - time_to_overlap(ego, boxes, a.horizon_s, &overlaps_now) / a.horizon_s);
}

// Reads a vector of agents, the first one in place of those that are missing.
INLINE MovingBoxes read_agents(const float* box, const float* velocity, const int32_t* slots, int size) {
  alignas(64) float fields[kBoxColumns + 2][LANES];
  for (int lane = 0; lane < LANES; ++lane) {
    const int64_t slot = slots[lane < size ? lane : 0];
    for (int column = 0; column < kBoxColumns; ++column) fields[column][lane] = box[slot * kBoxColumns + column];
    for (int axis = 0; axis < 2; ++axis) fields[kBoxColumns + axis][lane] = velocity[slot * 2 + axis];
  }
  return {load(fields[kBoxX]),      load(fields[kBoxY]),     load(fields[kBoxCos]),     load(fields[kBoxSin]),
          load(fields[kBoxLength]), load(fields[kBoxWidth]), load(fields[kBoxColumns]), load(fields[kBoxColumns + 1])};
}

INLINE bool has_column(const AgentRows& a, int32_t first, int32_t last) {
  bool found = false;
  for (int64_t i = 0; i < a.column_count; ++i) found |= a.columns[i] >= first && a.columns[i] <= last;
  return found;
}

void observe_agents(const AgentRows& a, int64_t first, int64_t last, const AgentScratch& scratch) {
  const bool has_kind = has_column(a, kHeight, kIsOther), has_path = has_column(a, kRouteAlong, kRouteCosine);
  const bool has_approach = has_column(a, kClosingSpeed, kImminence);
  int32_t number_mask = 0;
  while (number_mask < a.offsets - 1) number_mask = 2 * number_mask + 1;
  for (int64_t sample = first; sample < last; ++sample) {
    if (has_path && sample + 1 < last) {
      const float* route = a.routes + clamp_row(a.row[sample + 1], a.routes_count) * a.points * kRouteColumns;
      const float route_m = a.route_m[sample + 1];
      prefetch_route(route, a.points, route_m + a.offsets_m[0], route_m + a.offsets_m[a.offsets - 1]);
    }
    const View view = view_of(a.motion + 4 * sample, a.direction + 2 * sample);
    const float *box = a.box + sample * a.slots * kBoxColumns, *velocity = a.velocity + sample * a.slots * 2;
    const int64_t ego_slot = clamp_row(a.slot[sample], a.slots);
    const MovingBoxes ego = splat_box(box + ego_slot * kBoxColumns, velocity + ego_slot * 2);
    const int64_t size = find_nearest(a, sample, view, scratch);
    const bool is_on_path = has_path && a.has_route[sample];
    int64_t on_route = 0;
    if (is_on_path && size) {
      const int64_t number = clamp_row(a.row[sample], a.routes_count);
      const float end_m = a.route_points[number] > 1 ? (float)(a.route_points[number] - 1) : -1;
      on_route = read_path(a, a.routes + number * a.points * kRouteColumns, a.route_m[sample], end_m, scratch);
    }
    float* row = a.rows + sample * a.count * a.column_count;
    bool* mask = a.mask + sample * a.count;
    for (int64_t agent = 0; agent < size; agent += LANES) {
      AgentVector agents;
      agents.slot = scratch.nearest + agent;
      agents.size = (int)(size - agent < LANES ? size - agent : LANES);
      agents.boxes = read_agents(box, velocity, agents.slot, agents.size);
      alignas(64) float values[kAgentRowColumns][LANES];
      write_motion(a, view, a.motion[4 * sample + kMotionSpeed], agents.boxes, values);
      if (has_kind) write_kind(a, sample, agents, values);
      if (is_on_path) write_route(a, agents.boxes, scratch.path, scratch.on_route, on_route, number_mask, values);
      else if (has_path) __builtin_memset(values[kRouteAlong], 0, 4 * sizeof values[0]);
      if (has_approach) write_approach(a, ego, agents.boxes, values);
      for (int lane = 0; lane < agents.size; ++lane)
        for (int64_t i = 0; i < a.column_count; ++i) *row++ = values[a.columns[i]][lane];
    }
    __builtin_memset(row, 0, sizeof(float) * (a.count - size) * a.column_count);
    __builtin_memset(mask, true, size);
    __builtin_memset(mask + size, false, a.count - size);
  }
}

}  // namespace drivax::TARGET

#else

namespace drivax {

// Scratch of a thread, grown only.
static AgentScratch scratch_of(const AgentRows& a) {
  thread_local std::vector<float> floats;
  thread_local std::vector<int32_t> ints;
  const size_t slots = a.slots + 16;
  if (floats.size() < slots + 4 * a.offsets) floats.resize(slots + 4 * a.offsets);
  if (ints.size() < slots + a.count + a.offsets + 1) ints.resize(slots + a.count + a.offsets + 1);
  AgentScratch scratch;
  scratch.distance = floats.data();
  scratch.path = scratch.distance + slots;
  scratch.agent = ints.data();
  scratch.nearest = scratch.agent + slots;
  scratch.on_route = scratch.nearest + a.count;
  return scratch;
}

static ffi::Error observe_agents(ffi::ThreadPool pool, Float size, Float routes, Int route_points, Float offsets_m,
                                 Float box, Float velocity, Bool valid, Int kind, Int slot, Int index, Int row,
                                 Float route_m, Bool has_route, Float motion, Float direction, Numbers columns,
                                 Numbers kinds, float position_m, float speed_mps, float size_m, float side_m,
                                 float alongside_m, float horizon_s, Result<Float> rows, Result<Bool> mask) {
  AgentRows a;
  a.size = size.typed_data();
  a.routes = routes.typed_data();
  a.route_points = route_points.typed_data();
  a.offsets_m = offsets_m.typed_data();
  a.box = box.typed_data();
  a.velocity = velocity.typed_data();
  a.valid = valid.typed_data();
  a.kind = kind.typed_data();
  a.slot = slot.typed_data();
  a.index = index.typed_data();
  a.row = row.typed_data();
  a.route_m = route_m.typed_data();
  a.has_route = has_route.typed_data();
  a.motion = motion.typed_data();
  a.direction = direction.typed_data();
  a.scenarios = axis_from_last(size, 3);
  a.routes_count = axis_from_last(routes, 3);
  a.points = axis_from_last(routes, 2);
  a.offsets = offsets_m.element_count();
  a.batch = slot.element_count();
  a.slots = axis_from_last(valid, 1);
  a.count = axis_from_last(*mask, 1);
  a.kinds = kinds.begin();
  a.position_m = position_m;
  a.speed_mps = speed_mps;
  a.size_m = size_m;
  a.side_m = side_m;
  a.alongside_m = alongside_m;
  a.horizon_s = horizon_s;
  a.columns = columns.begin();
  a.column_count = columns.size();
  a.rows = rows->typed_data();
  a.mask = mask->typed_data();
  divide(pool, a.batch, 32, [&](int64_t first, int64_t last) {
    const AgentScratch scratch = scratch_of(a);
    CALL(observe_agents, a, first, last, scratch);
  });
  return ffi::Error::Success();
}

BIND(observe_agents, observe_agents,
     .Ctx<ffi::ThreadPool>().Arg<Float>().Arg<Float>().Arg<Int>().Arg<Float>().Arg<Float>().Arg<Float>().Arg<Bool>()
     .Arg<Int>().Arg<Int>().Arg<Int>().Arg<Int>().Arg<Float>().Arg<Bool>().Arg<Float>().Arg<Float>()
     .Attr<Numbers>("columns").Attr<Numbers>("kinds").Attr<float>("position_m").Attr<float>("speed_mps")
     .Attr<float>("size_m").Attr<float>("side_m").Attr<float>("alongside_m").Attr<float>("horizon_s")
     .Ret<Float>().Ret<Bool>())

}  // namespace drivax

#endif
