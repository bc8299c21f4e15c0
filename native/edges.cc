// Distances of the corners of a vehicle beyond the nearest road edge: drivax.scenario.bank.queries.offroad_distance.
//
// Which side of an edge a corner is on takes a second pass, since at a vertex two segments are equally near.
#include "segments.h"

namespace drivax {

struct EdgeQuery {
  SegmentGrid grid;         // of edges, with the features of drivax.scenario.bank.columns.EdgeRow
  const int32_t* sides;     // [scenarios, side_cells]: drivable sides, two bits for each of `split` x `split` parts
  const int32_t* scenario;  // [batch]
  const float* centre;      // [batch, 2]
  const float* corners;     // [batch, 4, 2]
  Mask near_lane;           // [batch, 4]: whether a lane is near the corner
  const float* ground;      // [batch]: height
  int64_t side_cells = -1, side_grid, split, not_drivable;
  float cutoff_m, level_m;
  bool long_ego;            // corners are outside of the cells around the centre: read those around each
  float* offroad_m;         // [batch, 4]: positive off the road
};

// Floats of scratch that a query needs: squared distances and signed distances to lines of all corners.
inline int64_t edge_scratch(const SegmentGrid& grid) {
  constexpr int64_t kMostLanes = 16;
  return 8 * (grid.side == 1 ? grid.size + kMostLanes : 3 * (grid.longest_run + kMostLanes));
}

EACH_TARGET(void query_edges(const EdgeQuery& query, float* scratch, int64_t first, int64_t last);)

}  // namespace drivax

#ifdef TARGET

namespace drivax::TARGET {

constexpr int kCorners = 4;

// Distances of points to all segments of some runs, in scratch.
template <int kPoints>
struct Measured {
  float *squared, *side;  // [kPoints, stride]
  int64_t stride, count;
  Floats nearest[kPoints];
};

template <int kPoints>
INLINE void measure(const EdgeQuery& q, const Runs& runs, const float* points, float ground, Measured<kPoints>& m) {
  for (int p = 0; p < kPoints; ++p) m.nearest[p] = splat(kFar);
  m.count = 0;
  for (int run = 0; run < kRuns; ++run) {
    for (int64_t i = runs.begin[run]; i < runs.end[run]; i += LANES, m.count += LANES) {
      const Ints inside = is_inside(q.grid, runs, run, i, ground, q.level_m);
      const Segments<Floats> segments = segments_at(q.grid, runs, i);
#pragma GCC unroll 4
      for (int p = 0; p < kPoints; ++p) {
        const Distances<Floats> distance = distances(segments, points[2 * p], points[2 * p + 1]);
        const Floats squared = select(inside, distance.squared, splat(kFar));
        m.nearest[p] = smaller(m.nearest[p], squared);
        store(m.squared + p * m.stride + m.count, squared);
        store(m.side + p * m.stride + m.count, distance.side);
      }
    }
  }
}

// Code of the stored side at a point; 0: unknown.
INLINE int32_t stored_side(const EdgeQuery& q, int64_t scenario, const float* point) {
  const float* origin = q.grid.origin + 2 * scenario;
  const float part_m = q.grid.cell_m / (float)q.split, parts = (float)(q.side_grid * q.split);
  const float x = __builtin_floorf((point[0] - origin[0]) / part_m);
  const float y = __builtin_floorf((point[1] - origin[1]) / part_m);
  if (!(x >= 0 && y >= 0 && x < parts && y < parts)) return 0;
  const int64_t column = (int64_t)x, row = (int64_t)y;
  const int64_t cell = row / q.split * q.side_grid + column / q.split;
  const int64_t part = row % q.split * q.split + column % q.split;
  return q.sides[scenario * q.side_cells + cell] >> (2 * part) & 3;
}

// Distance of a point beyond the edges that were measured, or by what else is known of its side.
template <int kPoints>
INLINE float beyond_edges(const EdgeQuery& q, int64_t scenario, const Measured<kPoints>& m, int p, const float* point,
                          bool near_lane) {
  const float nearest = smallest(m.nearest[p]);
  if (!(nearest <= q.cutoff_m * q.cutoff_m)) {
    const int32_t stored = stored_side(q, scenario, point);
    const bool is_off = stored ? stored == q.not_drivable : !near_lane;
    return is_off ? q.cutoff_m : -q.cutoff_m;
  }
  // Of equally near segments that whose line is further away decides.
  const Floats limit = splat(nearest + 1e-4f + 1e-4f * nearest);
  Floats left = splat(-kFar), right = left;
  for (int64_t i = 0; i < m.count; i += LANES) {
    const Ints is_tied = load(m.squared + p * m.stride + i) <= limit;
    const Floats side = load(m.side + p * m.stride + i);
    left = larger(left, select(is_tied, side, splat(-kFar)));
    right = larger(right, select(is_tied, -side, splat(-kFar)));
  }
  const float distance = square_root(larger(nearest, 0.0f));
  return largest(left) >= largest(right) ? -distance : distance;
}

// Queries points that read the cells around one of them or around their centre.
template <int kPoints>
INLINE void query(const EdgeQuery& q, int64_t scenario, const float* centre, int64_t sample, int corner,
                  float* scratch) {
  Measured<kPoints> measured;
  measured.stride = edge_scratch(q.grid) / (2 * kCorners);
  measured.squared = scratch;
  measured.side = scratch + kPoints * measured.stride;
  const int64_t first = kCorners * sample + corner;
  measure(q, runs_around(q.grid, scenario, centre), q.corners + 2 * first, q.ground[sample], measured);
  for (int p = 0; p < kPoints; ++p)
    q.offroad_m[first + p] =
        beyond_edges(q, scenario, measured, p, q.corners + 2 * (first + p), q.near_lane[first + p]);
}

void query_edges(const EdgeQuery& q, float* scratch, int64_t first, int64_t last) {
  for (int64_t sample = first; sample < last; ++sample) {
    const int64_t scenario = scenario_at(q.grid, q.scenario[sample]);
    prefetch_next(q.grid, q.scenario, q.centre, sample, last);
    if (!q.long_ego) {
      query<kCorners>(q, scenario, q.centre + 2 * sample, sample, 0, scratch);
      continue;
    }
    for (int corner = 0; corner < kCorners; ++corner)
      query<1>(q, scenario, q.corners + 2 * (kCorners * sample + corner), sample, corner, scratch);
  }
}

}  // namespace drivax::TARGET

#else

namespace drivax {

static ffi::Error query_edges(ffi::ThreadPool pool, ffi::RemainingArgs arguments, ffi::RemainingRets results,
                              float cell_m, int32_t longest_run, bool long_ego, float cutoff_m, float level_m,
                              int32_t split, int32_t not_drivable) {
  Arrays arrays(pool, arguments, results);
  EdgeQuery q;
  take_grid(arrays, q.grid, 5, cell_m, longest_run);
  arrays.common(q.sides, {q.grid.scenarios, q.side_cells});
  arrays.batched(q.scenario, {});
  arrays.batched(q.centre, {2});
  arrays.batched(q.corners, {4, 2});
  arrays.batched(q.near_lane, {4});
  arrays.batched(q.ground, {});
  arrays.batched(q.offroad_m, {4});
  q.side_grid = side_of_square(q.side_cells);
  q.split = split;
  q.not_drivable = not_drivable;
  q.cutoff_m = cutoff_m;
  q.level_m = level_m;
  q.long_ego = long_ego;
  arrays.require(q.side_grid * q.side_grid == q.side_cells, "no grid has this many cells");
  arrays.require(1 <= split && split <= 4, "a word has two bits for each of at most 4 x 4 parts");
  return arrays.run(64, [&](int64_t first, int64_t last) {
    thread_local std::vector<float> scratch;
    const size_t size = edge_scratch(q.grid);
    if (scratch.size() < size) scratch.resize(size);
    CALL(query_edges, q, scratch.data(), first, last);
  });
}

BIND(query_edges,
     .Attr<float>("cell_m").Attr<int32_t>("longest_run").Attr<bool>("long_ego").Attr<float>("cutoff_m")
     .Attr<float>("level_m").Attr<int32_t>("split").Attr<int32_t>("not_drivable"))

}  // namespace drivax

#endif
