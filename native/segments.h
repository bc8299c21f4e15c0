// Segments of a map around a point, as drivax.scenario.bank.queries reads and measures them.
//
// Segments are sorted by the cells of a grid, so that the 3 x 3 cells around a point are three contiguous runs.
#pragma once

#include "kernel.h"
#ifndef TARGET
#include <cmath>
#endif

namespace drivax {

// The segments of one kind of all scenarios, and their grid; a grid of a single cell is read whole.
struct SegmentGrid {
  const float* segments;  // [scenarios, features, size]: x and y of both ends, height, and other features
  const int16_t* start;   // [scenarios, cells + 1]: first segment of each cell, and the end
  const float* origin;    // [scenarios, 2]
  int64_t scenarios = -1, features, size = -1, cells, side;
  int64_t longest_run;  // of three neighbouring cells in a row
  float cell_m;
};

#ifdef TARGET
namespace TARGET {

constexpr int kRuns = 3;
// Larger than all squared distances.
constexpr float kFar = 1e9f;

// The runs of one scenario around a point: segments [begin, end).
struct Runs {
  const float* segments;
  int64_t begin[kRuns], end[kRuns];
};

INLINE int64_t clamp_index(int64_t value, int64_t low, int64_t high) {
  return value > high ? high : value < low ? low : value;
}

INLINE int64_t scenario_at(const SegmentGrid& grid, int32_t index) {
  return clamp_index(index, 0, grid.scenarios - 1);
}

// Number of the cell along an axis, such that its neighbours are in the grid; 1 for NaN.
INLINE int64_t inner_cell(float coordinate, float origin, float cell_m, int64_t side) {
  const float cell = __builtin_floorf((coordinate - origin) / cell_m);
  const int64_t last = side - 2;
  return cell > 1 ? cell < (float)last ? (int64_t)cell : last : 1;
}

// First of the starts of the 3 x 3 cells around a point; the next rows follow after `side`.
INLINE const int16_t* first_cell(const SegmentGrid& grid, int64_t scenario, const float* point) {
  const float* origin = grid.origin + 2 * scenario;
  const int64_t column = inner_cell(point[0], origin[0], grid.cell_m, grid.side);
  const int64_t row = inner_cell(point[1], origin[1], grid.cell_m, grid.side);
  return grid.start + scenario * (grid.cells + 1) + (row - 1) * grid.side + column - 1;
}

INLINE Runs runs_around(const SegmentGrid& grid, int64_t scenario, const float* point) {
  Runs runs = {};
  runs.segments = grid.segments + scenario * grid.features * grid.size;
  if (grid.side == 1) {
    runs.end[0] = clamp_index(grid.start[2 * scenario + 1], 0, grid.size);
    return runs;
  }
  const int16_t* cell = first_cell(grid, scenario, point);
  // Files are not trusted. As in XLA, runs are cut at the longest length; it counts negative starts from the end.
  for (int run = 0; run < kRuns; ++run, cell += grid.side) {
    runs.begin[run] = clamp_index(cell[0], 0, grid.size - grid.longest_run);
    runs.end[run] = runs.begin[run] + clamp_index(cell[3] - cell[0], 0, grid.longest_run);
  }
  return runs;
}

// Fetches what queries of later samples read: samples are of different scenarios, so caches do not hold them.
INLINE void prefetch_starts(const SegmentGrid& grid, int64_t scenario, const float* point) {
  if (grid.side == 1) return;
  const int16_t* cell = first_cell(grid, scenario, point);
  for (int run = 0; run < kRuns; ++run) __builtin_prefetch(cell + run * grid.side);
}

INLINE void prefetch_segments(const SegmentGrid& grid, int64_t scenario, const float* point) {
  constexpr int64_t kCacheLine = 64 / sizeof(float);
  if (grid.side == 1) return;
  const Runs runs = runs_around(grid, scenario, point);
  for (int run = 0; run < kRuns; ++run)
    for (int64_t feature = 0; feature < grid.features; ++feature)
      for (int64_t i = runs.begin[run]; i < runs.end[run] + kCacheLine - 1; i += kCacheLine)
        __builtin_prefetch(runs.segments + feature * grid.size + i);
}

// Prefetches for samples after this one.
INLINE void prefetch_next(const SegmentGrid& grid, const int32_t* scenario, const float* centre, int64_t sample,
                          int64_t last) {
  if (sample + 1 < last && scenario[sample + 1] != scenario[sample])
    prefetch_segments(grid, scenario_at(grid, scenario[sample + 1]), centre + 2 * (sample + 1));
  if (sample + 3 < last)
    prefetch_starts(grid, scenario_at(grid, scenario[sample + 3]), centre + 2 * (sample + 3));
}

// Features of a vector of segments from `i` on, zero beyond the array.
INLINE Floats feature(const SegmentGrid& grid, const Runs& runs, int number, int64_t i) {
  return load_first(runs.segments + number * grid.size + i, grid.size - i);
}

// Mask of the segments from `i` on that are in a run, and on the level of a height.
INLINE Ints is_inside(const SegmentGrid& grid, const Runs& runs, int run, int64_t i, float height, float level_m) {
  const Ints is_level = absolute(feature(grid, runs, 4, i) - height) <= splat(level_m);
  return is_level & (numbers() < splat((int32_t)(runs.end[run] - i)));
}

// Segments, one (float) or a vector of them (Floats): where they begin, the vector to their end, and its length.
template <typename Value>
struct Segments {
  Value x, y, ux, uy, inverse_square, inverse_length;
};

template <typename Value>
INLINE Segments<Value> segments_between(Value x, Value y, Value end_x, Value end_y) {
  const Value ux = end_x - x, uy = end_y - y;
  const Value inverse_square = 1.0f / larger(ux * ux + uy * uy, Value{} + 1e-9f);
  return {x, y, ux, uy, inverse_square, square_root(inverse_square)};
}

INLINE Segments<Floats> segments_at(const SegmentGrid& grid, const Runs& runs, int64_t i) {
  return segments_between(feature(grid, runs, 0, i), feature(grid, runs, 1, i), feature(grid, runs, 2, i),
                          feature(grid, runs, 3, i));
}

// Squared distance of a point to segments, and signed distance to their lines (positive: left of them).
template <typename Value>
struct Distances {
  Value squared, side;
};

template <typename Value>
INLINE Distances<Value> distances(const Segments<Value>& s, float x, float y) {
  const Value wx = x - s.x, wy = y - s.y;
  const Value along = clamp((wx * s.ux + wy * s.uy) * s.inverse_square, Value{}, Value{} + 1.0f);
  const Value dx = wx - along * s.ux, dy = wy - along * s.uy;
  return {dx * dx + dy * dy, (s.ux * wy - s.uy * wx) * s.inverse_length};
}

}  // namespace TARGET
#else

inline int64_t side_of_square(int64_t cells) { return cells > 0 ? std::lround(std::sqrt((double)cells)) : 0; }

// Takes a bank's arrays of segments.
inline void take_grid(Arrays& arrays, SegmentGrid& grid, int features, float cell_m, int32_t longest_run) {
  int64_t starts = -1;
  arrays.common(grid.segments, {grid.scenarios, features, grid.size});
  arrays.common(grid.start, {grid.scenarios, starts});
  arrays.common(grid.origin, {grid.scenarios, 2});
  arrays.nonempty({grid.scenarios});
  grid.features = features;
  grid.cells = starts - 1;
  grid.side = side_of_square(grid.cells);
  grid.longest_run = longest_run;
  grid.cell_m = cell_m;
  arrays.require(grid.side * grid.side == grid.cells && grid.side > 0 && grid.side != 2, "no grid has this many cells");
  arrays.require(grid.side == 1 || (0 <= longest_run && longest_run <= grid.size), "runs are longer than their array");
}

#endif

}  // namespace drivax
