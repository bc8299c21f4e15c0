// Lanes around the bounding box of a vehicle; native version of drivax.scenario.bank.queries.around_lanes.
//
// One vectorised pass over the lane segments in the 3 x 3 grid cells around the box centre accumulates the results. For
// the driven and the nearest lane, the pass keeps only the minimum of a key: a rank or squared distance whose low bits
// hold the number of the segment (order.h). After the pass, these two segments are read again by their numbers.
#include "segments.h"

namespace drivax {

struct LaneQuery {
  SegmentGrid grid;          // lane segments with the features of drivax.scenario.bank.columns.LaneRow
  const float* map_box;      // [scenarios, 4]: smallest x and y, largest x and y of the map
  const int32_t* scenario;   // [batch]
  const int32_t* ego;        // [batch]: index of the ego whose route corridor is used
  const float* centre;       // [batch, 2]: box centre
  const float* heading;      // [batch, 2]: cosine and sine
  const float* corners;      // [batch, 4, 2]: box corners
  const float* ground;       // [batch]: height of the ground, m
  Mask routed;               // [batch]: whether lanes of the corridor take precedence as the driven lane
  // Constants of queries.py: LANE_CUTOFF_M, LEVEL_M, LANE_MARGIN_M, _GOES_ON_M, _JOINT_M, _PARALLEL_COS.
  float cutoff_m, level_m, margin_m, goes_on_m, joint_m, parallel_cos;
  bool long_ego;             // corners may lie outside the cells around the centre: search around each corner
  // Results: the attributes of queries.LaneHits.
  bool* near;                // [batch]
  bool* corners_near;        // [batch, 4]
  bool* on_corridor;         // [batch], as are all results below
  bool* wrong_way;
  bool* straddling;
  bool* leaving_lane;
  float* limit;
  float* nearest_z;
};

EACH_TARGET(void query_lanes(const LaneQuery& query, int64_t first, int64_t last);)

}  // namespace drivax

#ifdef TARGET

#include "order.h"

namespace drivax::TARGET {

constexpr int kCorners = 4;
enum LaneRow { kHeight = 4, kHalfWidth, kLimit, kLane };
// Cosine of 45 degrees. A lane is opposed to the ego if its direction is within 45 degrees of the opposite heading.
constexpr float kAgainstCos = 0.70710678118654752f;

INLINE float squared(float value) { return value * value; }

// Accumulated results of the pass over the lane segments. Each vector element covers every LANES-th segment; they are
// reduced at the end.
struct Visited {
  // Smallest keys: rank of the driven lane, squared distance of the nearest lane.
  Floats driven, nearest;
  // Smallest squared distance from the centre to a lane that contains it and is opposed to the heading (`opposed`), and
  // to a lane in the direction of the heading, within 90 degrees (`friendly`). Smallest overhang of the farthest corner
  // beyond a lane border, over lanes in the direction of the heading that run alongside the centre (`outside_m`).
  Floats opposed, friendly, outside_m;
  // Whether the centre is inside a lane of the corridor.
  Ints on_corridor;
  // Whether a lane centre is within the cut-off of the corner; whether the corner is inside a lane in the direction of
  // the heading.
  Ints corner_near[kCorners], corner_held[kCorners];
};

// One lane segment, with its squared distance from the box centre.
struct Lane {
  bool exists;
  Segments<float> segment;
  float squared, height, half_width, limit;
  float side[kCorners];  // signed distance of each corner from the line of the segment, left positive
};

// Reads the segment whose number is in the low bits of a key. There is none if the key is that of an empty minimum.
INLINE Lane lane_of(const LaneQuery& q, const Runs& runs, float key, int64_t stride, int bits, int64_t sample) {
  Lane lane = {};
  lane.exists = key < kFar / 2;
  if (!lane.exists) return lane;
  const int64_t last = (q.grid.side == 1 ? stride : kRuns * stride) - 1;
  const int64_t number = clamp_index(number_of(key, bits), 0, last), run = number / stride;
  const float* features = runs.segments + runs.begin[run] + number - run * stride;
  const int64_t size = q.grid.size;
  lane.segment = segments_between(features[0], features[size], features[2 * size], features[3 * size]);
  lane.squared = distances(lane.segment, q.centre[2 * sample], q.centre[2 * sample + 1]).squared;
  lane.height = features[kHeight * size];
  lane.half_width = features[kHalfWidth * size];
  lane.limit = features[kLimit * size];
  const float* corner = q.corners + 2 * kCorners * sample;
  for (int c = 0; c < kCorners; ++c) lane.side[c] = distances(lane.segment, corner[2 * c], corner[2 * c + 1]).side;
  return lane;
}

// Mask of lanes in the corridor of ego k. The integer part of `code` is the lane index, and bit k after the binary
// point is set for lanes in the corridor of ego k. Multiplying by `scale` = 2^k makes it the first bit of the fraction.
INLINE Ints in_corridor(Floats code, float scale) {
  const Floats scaled = code * scale;
  return scaled - as_floats(as_ints(scaled)) >= 0.5f;  // truncation is floor: codes are not negative
}

// Accumulates all results over the lane segments in the cells around the centre.
INLINE Visited visit_lanes(const LaneQuery& q, const Runs& runs, int64_t stride, int bits, int64_t sample) {
  const Floats far = splat(kFar);
  const float x = q.centre[2 * sample], y = q.centre[2 * sample + 1];
  const float cosine = q.heading[2 * sample], sine = q.heading[2 * sample + 1], ground = q.ground[sample];
  const float* corner = q.corners + 2 * kCorners * sample;
  const Ints routed = splat(-(int32_t)q.routed[sample]);
  const float corridor_scale = (float)(1 << clamp_index(q.ego[sample], 0, 30));
  // `corner_m` is the distance of the farthest corner from the centre. From it follows `reach` below, the distance from
  // the centre beyond which a segment changes no result.
  float corner_m = 0;
  for (int c = 0; c < kCorners; ++c)
    corner_m = larger(corner_m, squared(corner[2 * c] - x) + squared(corner[2 * c + 1] - y));
  corner_m = square_root(corner_m);
  const float least_reach_m = larger(q.goes_on_m, q.cutoff_m + corner_m);
  Visited v = {};
  v.driven = v.nearest = v.opposed = v.friendly = v.outside_m = far;
  for (int run = 0; run < kRuns; ++run) {
    for (int64_t i = runs.begin[run]; i < runs.end[run]; i += LANES) {
      const Ints inside = is_inside(q.grid, runs, run, i, ground, q.level_m);
      const Segments<Floats> segments = segments_at(q.grid, runs, i);
      const Floats half_width = feature(q.grid, runs, kHalfWidth, i), limit = feature(q.grid, runs, kLimit, i);
      const Distances<Floats> centre = distances(segments, x, y);
      const Floats own = select(inside, centre.squared, far);
      const Floats reach = larger(half_width + (q.margin_m + q.joint_m + corner_m), splat(least_reach_m));
      if (!any(inside & (own <= reach * reach))) continue;

      const Floats aligned_cos = (segments.ux * cosine + segments.uy * sine) * segments.inverse_length;
      const Ints is_aligned = inside & (aligned_cos > 0.0f), is_against = aligned_cos < -kAgainstCos;
      const Ints holds_centre = inside & (own <= half_width * half_width);
      const Ints is_alongside = inside & (own - centre.side * centre.side <= squared(q.joint_m));
      const Ints is_parallel = is_alongside & (aligned_cos > q.parallel_cos);
      const Ints is_corridor = inside & in_corridor(feature(q.grid, runs, kLane, i), corridor_scale);

      // The driven lane has the lowest rank. Parallel lanes that contain the centre rank below 1: lanes of the corridor
      // first (if `routed`), then by descending speed limit. Other parallel lanes within the cut-off rank 1 plus their
      // squared distance, all other lanes within 90 degrees of the heading 100 plus their squared distance.
      const Floats by_limit = select(is_corridor & routed, Floats{}, splat(0.2f)) + 1e-3f * (100.0f - limit);
      const Floats by_distance =
          select(is_parallel & (own <= squared(q.cutoff_m)), splat(1.0f), splat(100.0f)) + own;
      const Floats rank = select(is_parallel & holds_centre, by_limit, select(is_aligned, by_distance, far));
      const Ints number = numbers() + (int32_t)(run * stride + i - runs.begin[run]);
      v.driven = smaller(v.driven, embed_numbers(comparable(select(inside, rank, far)), number, bits));
      v.nearest = smaller(v.nearest, embed_numbers(comparable(own), number, bits));
      v.opposed = smaller(v.opposed, select(is_against & holds_centre, own, far));
      v.friendly = smaller(v.friendly, select(is_aligned, own, far));

      const Floats widened = (half_width + q.margin_m) * (half_width + q.margin_m);
      v.on_corridor |= is_corridor & (own <= widened);
      Floats widest = {};
#pragma GCC unroll 4
      for (int c = 0; c < kCorners; ++c) {
        const Distances<Floats> distance = distances(segments, corner[2 * c], corner[2 * c + 1]);
        v.corner_near[c] |= inside & (distance.squared <= squared(q.cutoff_m));
        v.corner_held[c] |= is_aligned & (distance.squared <= widened);
        widest = larger(widest, absolute(distance.side));
      }
      v.outside_m = smaller(v.outside_m, select(is_aligned & is_alongside, widest - half_width, far));
    }
  }
  return v;
}

// Recomputes corner_near and corner_held of one corner of a long vehicle from the cells around that corner.
INLINE void visit_corner(const LaneQuery& q, int64_t scenario, int64_t sample, int c, Visited& v) {
  const float* corner = q.corners + 2 * (kCorners * sample + c);
  const float cosine = q.heading[2 * sample], sine = q.heading[2 * sample + 1];
  const Runs runs = runs_around(q.grid, scenario, corner);
  v.corner_near[c] = v.corner_held[c] = Ints{};
  for (int run = 0; run < kRuns; ++run) {
    for (int64_t i = runs.begin[run]; i < runs.end[run]; i += LANES) {
      const Ints inside = is_inside(q.grid, runs, run, i, q.ground[sample], q.level_m);
      const Segments<Floats> segments = segments_at(q.grid, runs, i);
      const Floats distance = distances(segments, corner[0], corner[1]).squared;
      const Floats reach = feature(q.grid, runs, kHalfWidth, i) + q.margin_m;
      v.corner_near[c] |= inside & (distance <= squared(q.cutoff_m));
      v.corner_held[c] |=
          inside & (segments.ux * cosine + segments.uy * sine > 0.0f) & (distance <= reach * reach);
    }
  }
}

// Reduces the accumulated vectors and writes the results of a sample.
INLINE void write_hits(const LaneQuery& q, int64_t scenario, int64_t sample, const Visited& v, const Lane& driven,
                       const Lane& nearest) {
  const float* corner = q.corners + 2 * kCorners * sample;
  const float* box = q.map_box + 4 * scenario;
  bool straddling = false;
  float widest = 0;
  for (int c = 0; c < kCorners; ++c) {
    const float x = corner[2 * c], y = corner[2 * c + 1];
    // A corner outside the map's box is near a lane if the nearest lane, extended beyond its end, passes within the
    // cut-off of it, or if there is no lane within `goes_on_m` of the centre.
    const bool is_outside_box = x < box[0] || y < box[1] || x > box[2] || y > box[3];
    const bool goes_on = !nearest.exists || absolute(nearest.side[c]) <= q.cutoff_m ||
                         nearest.squared > squared(q.goes_on_m);
    q.corners_near[kCorners * sample + c] = any(v.corner_near[c]) || (is_outside_box && goes_on);
    straddling |= !any(v.corner_held[c]);
    widest = larger(widest, absolute(driven.side[c]));
  }
  const float along = driven.segment.ux * q.heading[2 * sample] + driven.segment.uy * q.heading[2 * sample + 1];
  const bool has_lane = driven.exists && driven.squared <= squared(q.cutoff_m) && along > 0;
  const float outside_m = smaller(smallest(v.outside_m), widest - driven.half_width);
  const float opposed = smallest(v.opposed);
  q.near[sample] = nearest.exists && nearest.squared <= squared(q.cutoff_m);
  q.on_corridor[sample] = any(v.on_corridor);
  q.wrong_way[sample] = opposed < kFar / 2 && opposed < smallest(v.friendly);
  q.straddling[sample] = straddling;
  q.leaving_lane[sample] = has_lane && outside_m > q.margin_m;
  q.limit[sample] = has_lane ? driven.limit : -1.0f;
  q.nearest_z[sample] = nearest.height;
}

void query_lanes(const LaneQuery& q, int64_t first, int64_t last) {
  // The i-th segment of a run has number run * stride + i, its index in the array of queries.lanes_around. Equal keys
  // are therefore resolved as in JAX.
  const int64_t stride = q.grid.side == 1 ? q.grid.size : q.grid.longest_run;
  const int bits = bits_for(q.grid.side == 1 ? stride : kRuns * stride);
  for (int64_t sample = first; sample < last; ++sample) {
    const int64_t scenario = scenario_at(q.grid, q.scenario[sample]);
    prefetch_next(q.grid, q.scenario, q.centre, sample, last);
    const Runs runs = runs_around(q.grid, scenario, q.centre + 2 * sample);
    Visited visited = visit_lanes(q, runs, stride, bits, sample);
    if (q.long_ego)
      for (int c = 0; c < kCorners; ++c) visit_corner(q, scenario, sample, c, visited);
    const Lane driven = lane_of(q, runs, smallest(visited.driven), stride, bits, sample);
    const Lane nearest = lane_of(q, runs, smallest(visited.nearest), stride, bits, sample);
    write_hits(q, scenario, sample, visited, driven, nearest);
  }
}

}  // namespace drivax::TARGET

#else

namespace drivax {

static ffi::Error query_lanes(ffi::ThreadPool pool, ffi::RemainingArgs arguments, ffi::RemainingRets results,
                              float cell_m, int32_t longest_run, bool long_ego, float cutoff_m, float level_m,
                              float margin_m, float goes_on_m, float joint_m, float parallel_cos) {
  Arrays arrays(pool, arguments, results);
  LaneQuery q;
  take_grid(arrays, q.grid, 8, cell_m, longest_run);
  arrays.common(q.map_box, {q.grid.scenarios, 4});
  arrays.batched(q.scenario, {});
  arrays.batched(q.ego, {});
  arrays.batched(q.centre, {2});
  arrays.batched(q.heading, {2});
  arrays.batched(q.corners, {4, 2});
  arrays.batched(q.ground, {});
  arrays.batched(q.routed, {});
  arrays.batched(q.near, {});
  arrays.batched(q.corners_near, {4});
  arrays.batched(q.on_corridor, {});
  arrays.batched(q.wrong_way, {});
  arrays.batched(q.straddling, {});
  arrays.batched(q.leaving_lane, {});
  arrays.batched(q.limit, {});
  arrays.batched(q.nearest_z, {});
  q.cutoff_m = cutoff_m;
  q.level_m = level_m;
  q.margin_m = margin_m;
  q.goes_on_m = goes_on_m;
  q.joint_m = joint_m;
  q.parallel_cos = parallel_cos;
  q.long_ego = long_ego;
  return arrays.run(64, [&](int64_t first, int64_t last) { CALL(query_lanes, q, first, last); });
}

BIND(query_lanes,
     .Attr<float>("cell_m").Attr<int32_t>("longest_run").Attr<bool>("long_ego").Attr<float>("cutoff_m")
     .Attr<float>("level_m").Attr<float>("margin_m").Attr<float>("goes_on_m").Attr<float>("joint_m")
     .Attr<float>("parallel_cos"))

}  // namespace drivax

#endif
