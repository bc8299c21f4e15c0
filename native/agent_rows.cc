// The observation group `agents` at the present step: the agents nearest to ego, nearest first.
#include "kernel.h"

namespace drivax {

struct AgentRows {
  const float* size;            // [scenarios, slots, 4]: length, width, height, kind
  const float* routes;          // [routes, points, 7]
  const int32_t* route_points;  // [routes]
  const float* offsets_m;       // [offsets]: ascending places on the route, relative to ego, to project agents on
  const float* box;             // [batch, slots, 6]: x, y, cos, sin, length, width
  const float* velocity;        // [batch, slots, 2]
  Mask valid;                   // [batch, slots]
  const int32_t* kind;          // [batch, slots]
  const int32_t* slot;          // [batch], of ego
  const int32_t* index;         // [batch]: scenario
  const int32_t* row;           // [batch]: route
  const float* route_m;         // [batch]: arc length of ego
  Mask has_route;               // [batch]
  const float* motion;          // [batch, 4]: ego's x, y, heading, speed
  const float* direction;       // [batch, 2]: ego's cos, sin
  int64_t scenarios = -1, routes_count = -1, points = -1, offsets = -1, slots = -1, count = -1;
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
  int32_t* nearest;  // [count]: slots of the nearest agents
  // Places on the route: element of the point before each, share of the way to the next point, x and y.
  int32_t* element;  // [offsets + 16]
  float* part;       // [offsets + 16]
  float* xy;         // [offsets, 2]
};

EACH_TARGET(void observe_agents(const AgentRows& arguments, int64_t first, int64_t last, const AgentScratch& scratch);)

}  // namespace drivax

#ifdef TARGET

#include "order.h"
#include "overlap.h"
#include "route.h"
#include "view.h"

namespace drivax::TARGET {

enum { kSizeHeight = 2, kSizeColumns = 4, kMotionSpeed = 3, kTypes = 4 };

// Writes the slots of the nearest agents, nearest first, and returns how many there are, at most `count`.
//
// The rank of an agent is the number of agents that are nearer, or as near with a lower slot.
INLINE int64_t find_nearest(const AgentRows& a, int64_t sample, const View& view, const AgentScratch& scratch) {
  const float* box = a.box + sample * a.slots * kBoxColumns;
  const Mask valid = a.valid + sample * a.slots;
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
  for (int64_t i = 0; i < size; i += LANES) {
    const Floats distance = load(scratch.distance + i);
    const int64_t end = i + LANES < size ? i + LANES : size;
    Ints rank = {};  // minus the number of agents before each of these
    for (int64_t j = 0; j < i; ++j) rank += scratch.distance[j] <= distance;
    for (int64_t j = i; j < end; ++j) {
      const Floats other = splat(scratch.distance[j]);
      rank += (other < distance) | ((other == distance) & (numbers() > (int32_t)(j - i)));
    }
    for (int64_t j = end; j < size; ++j) rank += scratch.distance[j] < distance;
    for (int64_t j = i; j < end; ++j)
      if (-rank[j - i] < a.count) scratch.nearest[-rank[j - i]] = scratch.agent[j];
  }
  return size < a.count ? size : a.count;
}

// The route around ego, in the scratch of a thread.
struct Path {
  const float* route;   // [points, 7]
  int64_t next;         // elements from one point to the next
  int64_t begin, end;   // places that are on the route
  int number_bits;      // that hold the number of a place
  const AgentScratch* scratch;
};

INLINE RoutePlace place_on_path(const Path& path, int64_t number) {
  const float* row = path.route + path.scratch->element[number];
  return {row, row + path.next, path.scratch->part[number]};
}

INLINE Path read_path(const AgentRows& a, int64_t sample, const AgentScratch& scratch) {
  const int64_t number = clamp_row(a.row[sample], a.routes_count);
  const float end_m = end_of_route(a.route_points[number]);
  const int64_t last = a.points > 1 ? a.points - 2 : 0;
  Path path = {a.routes + number * a.points * kRouteColumns, a.points > 1 ? kRouteColumns : 0};
  path.begin = a.offsets;
  path.scratch = &scratch;
  path.number_bits = bits_for(a.offsets);
  for (int64_t i = 0; i < a.offsets; i += LANES) {
    const Floats along = a.route_m[sample] + load_first(a.offsets_m + i, a.offsets - i), at = larger(along, Floats{});
    const Ints low = as_ints(smaller(at, splat((float)last)));
    store(scratch.element + i, low * (int32_t)kRouteColumns);
    store(scratch.part + i, at - as_floats(low));
    const Ints is_place = numbers() < (int32_t)(a.offsets - i);
    const uint32_t on_route = bits((along >= 0) & (along <= end_m) & is_place);
    if (!on_route) continue;
    if (path.begin > path.end) path.begin = i + __builtin_ctz(on_route);
    path.end = i + 32 - __builtin_clz(on_route);
  }
  for (int64_t i = path.begin; i < path.end; ++i) {
    const RoutePlace place = place_on_path(path, i);
    scratch.xy[2 * i] = place[kRouteX];
    scratch.xy[2 * i + 1] = place[kRouteY];
  }
  return path;
}

// Numbers of the places that are nearest to agents; of nearly equal distances the first, as in bank/smallest.py.
INLINE Ints nearest_place(const Path& path, Floats x, Floats y) {
  Floats smallest_key = splat(kInfinity);
  for (int64_t i = path.begin; i < path.end; ++i) {
    const Floats dx = x - path.scratch->xy[2 * i], dy = y - path.scratch->xy[2 * i + 1];
    const Floats key = embed_numbers(comparable(dx * dx + dy * dy), splat((int32_t)i), path.number_bits);
    smallest_key = smaller(smallest_key, key);
  }
  return pattern(smallest_key) & ((1 << path.number_bits) - 1);
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
  for (int lane = 0; lane < agents.size; ++lane) {
    const int32_t kind = a.kind[sample * a.slots + agents.slot[lane]];
    for (int type = 0; type < kTypes; ++type) values[kIsVehicle + type][lane] = kind == a.kinds[type];
  }
}

INLINE void write_height(const AgentRows& a, int64_t sample, const AgentVector& agents, float (*values)[LANES]) {
  const float* sizes = a.size + clamp_row(a.index[sample], a.scenarios) * a.slots * kSizeColumns;
  for (int lane = 0; lane < agents.size; ++lane)
    values[kHeight][lane] = sizes[agents.slot[lane] * kSizeColumns + kSizeHeight] / a.size_m;
}

INLINE void write_route(const AgentRows& a, const MovingBoxes& boxes, const Path& path, float (*values)[LANES]) {
  alignas(64) int32_t nearest[LANES];
  alignas(64) float x[LANES], y[LANES], cosine[LANES], sine[LANES], offset[LANES];
  store(nearest, nearest_place(path, boxes.x, boxes.y));
  for (int lane = 0; lane < LANES; ++lane) {
    const int64_t number = nearest[lane] < a.offsets ? nearest[lane] : a.offsets - 1;
    const RoutePlace place = place_on_path(path, number);
    x[lane] = place[kRouteX];
    y[lane] = place[kRouteY];
    cosine[lane] = place[kRouteCos];
    sine[lane] = place[kRouteSin];
    offset[lane] = a.offsets_m[number];
  }
  const Floats dx = boxes.x - load(x), dy = boxes.y - load(y), cos = load(cosine), sin = load(sine);
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

// Columns that cost more than the motion.
struct AgentColumns {
  bool kind, height, route, approach;
};

INLINE AgentColumns columns_of(const AgentRows& a) {
  AgentColumns has = {};
  for (int64_t i = 0; i < a.column_count; ++i) {
    const int32_t column = a.columns[i];
    has.kind |= column >= kIsVehicle && column <= kIsOther;
    has.height |= column == kHeight;
    has.route |= column >= kRouteAlong && column <= kRouteCosine;
    has.approach |= column == kClosingSpeed || column == kImminence;
  }
  return has;
}

void observe_agents(const AgentRows& a, int64_t first, int64_t last, const AgentScratch& scratch) {
  const AgentColumns has = columns_of(a);
  for (int64_t sample = first; sample < last; ++sample) {
    if (has.route && sample + 1 < last) {
      const float* route = a.routes + clamp_row(a.row[sample + 1], a.routes_count) * a.points * kRouteColumns;
      const float route_m = a.route_m[sample + 1];
      prefetch_route(route, a.points, route_m + a.offsets_m[0], route_m + a.offsets_m[a.offsets - 1]);
    }
    const View view = view_of(a.motion + 4 * sample, a.direction + 2 * sample);
    const float *box = a.box + sample * a.slots * kBoxColumns, *velocity = a.velocity + sample * a.slots * 2;
    const int64_t ego_slot = clamp_row(a.slot[sample], a.slots);
    const MovingBoxes ego = splat_box(box + ego_slot * kBoxColumns, velocity + ego_slot * 2);
    const int64_t size = find_nearest(a, sample, view, scratch);
    const bool has_route = has.route && a.has_route[sample];
    Path path = {};
    if (has_route && size) path = read_path(a, sample, scratch);
    float* row = a.rows + sample * a.count * a.column_count;
    bool* mask = a.mask + sample * a.count;
    for (int64_t agent = 0; agent < size; agent += LANES) {
      AgentVector agents;
      agents.slot = scratch.nearest + agent;
      agents.size = (int)(size - agent < LANES ? size - agent : LANES);
      agents.boxes = read_agents(box, velocity, agents.slot, agents.size);
      alignas(64) float values[kAgentRowColumns][LANES];
      write_motion(a, view, a.motion[4 * sample + kMotionSpeed], agents.boxes, values);
      if (has.kind) write_kind(a, sample, agents, values);
      if (has.height) write_height(a, sample, agents, values);
      if (has_route) write_route(a, agents.boxes, path, values);
      else if (has.route) __builtin_memset(values[kRouteAlong], 0, 4 * sizeof values[0]);
      if (has.approach) write_approach(a, ego, agents.boxes, values);
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
  const size_t slots = a.slots + 16, offsets = a.offsets + 16;
  if (floats.size() < slots + 3 * offsets) floats.resize(slots + 3 * offsets);
  if (ints.size() < slots + offsets + a.count) ints.resize(slots + offsets + a.count);
  AgentScratch scratch;
  scratch.distance = floats.data();
  scratch.part = scratch.distance + slots;
  scratch.xy = scratch.part + offsets;
  scratch.agent = ints.data();
  scratch.element = scratch.agent + slots;
  scratch.nearest = scratch.element + offsets;
  return scratch;
}

static ffi::Error observe_agents(ffi::ThreadPool pool, ffi::RemainingArgs arguments, ffi::RemainingRets results,
                                 Numbers columns, Numbers kinds, float position_m, float speed_mps, float size_m,
                                 float side_m, float alongside_m, float horizon_s) {
  Arrays arrays(pool, arguments, results);
  AgentRows a;
  a.columns = columns.begin();
  a.column_count = columns.size();
  arrays.common(a.size, {a.scenarios, a.slots, 4});
  arrays.common(a.routes, {a.routes_count, a.points, 7});
  arrays.common(a.route_points, {a.routes_count});
  arrays.common(a.offsets_m, {a.offsets});
  arrays.batched(a.box, {a.slots, 6});
  arrays.batched(a.velocity, {a.slots, 2});
  arrays.batched(a.valid, {a.slots});
  arrays.batched(a.kind, {a.slots});
  arrays.batched(a.slot, {});
  arrays.batched(a.index, {});
  arrays.batched(a.row, {});
  arrays.batched(a.route_m, {});
  arrays.batched(a.has_route, {});
  arrays.batched(a.motion, {4});
  arrays.batched(a.direction, {2});
  arrays.batched(a.rows, {a.count, a.column_count});
  arrays.batched(a.mask, {a.count});
  arrays.nonempty({a.scenarios, a.slots, a.routes_count, a.points, a.offsets});
  arrays.columns(columns, kAgentRowColumns);
  arrays.require(kinds.size() == 4, "there are four types of agents");
  a.kinds = kinds.begin();
  a.position_m = position_m;
  a.speed_mps = speed_mps;
  a.size_m = size_m;
  a.side_m = side_m;
  a.alongside_m = alongside_m;
  a.horizon_s = horizon_s;
  return arrays.run(32, [&](int64_t first, int64_t last) {
    const AgentScratch scratch = scratch_of(a);
    CALL(observe_agents, a, first, last, scratch);
  });
}

BIND(observe_agents,
     .Attr<Numbers>("columns").Attr<Numbers>("kinds").Attr<float>("position_m").Attr<float>("speed_mps")
     .Attr<float>("size_m").Attr<float>("side_m").Attr<float>("alongside_m").Attr<float>("horizon_s"))

}  // namespace drivax

#endif
