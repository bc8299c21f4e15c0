// The observation group `road`: the first pieces of road, in order of rank, that lie in a box around ego.
//
// Most of the time goes into the search, which reads only positions and layers; few pieces are read whole.
#include "kernel.h"

namespace drivax {

struct RoadRows {
  const float* at;         // [scenarios, 3, pieces]: x, y, layer
  const float* road;       // [scenarios, pieces, 7]: x, y, cos, sin, length, layer, limit
  const float* curvature;  // [scenarios, pieces]
  const int32_t* index;    // [batch]: scenario
  const float* motion;     // [batch, 4]: ego's x, y, heading, speed
  const float* direction;  // [batch, 2]: ego's cos, sin
  int64_t scenarios = -1, pieces = -1;
  float ahead_m, behind_m, side_m;
  const int32_t* layers;  // [layer_count]: those that are observed
  int64_t layer_count;
  float position_m, piece_m, speed_mps, curvature_pm, max_curvature;  // units, and the largest curvature in its unit
  const int32_t* columns;  // [column_count]: RoadRowColumn
  int64_t column_count;
  int64_t count = -1;
  float* rows;  // [batch, count, column_count]
  bool* mask;   // [batch, count]
};

// As in tasks/features.py.
enum RoadRowColumn {
  kX, kY, kCos, kSin, kLength, kIsLane, kIsEdge, kIsArea, kLimit, kHasLimit, kCurvature, kRoadRowColumns
};

// `found` is scratch of `count` and 32 more.
EACH_TARGET(void observe_road(const RoadRows& arguments, int64_t first, int64_t last, int32_t* found);)

}  // namespace drivax

#ifdef TARGET

#include "route.h"
#include "view.h"

namespace drivax::TARGET {

enum RoadColumn { kPieceX, kPieceY, kPieceCos, kPieceSin, kPieceLength, kPieceLayer, kPieceLimit, kPieceColumns };
enum RoadLayer { kLane, kEdge, kArea };

// The layers that are observed; NaN, which equals nothing, in place of others.
struct Layers {
  float lane, edge, area;
};

INLINE Layers layers_of(const RoadRows& a) {
  const float none = __builtin_nanf("");
  Layers layers = {none, none, none};
  for (int64_t i = 0; i < a.layer_count; ++i) {
    if (a.layers[i] == kLane) layers.lane = kLane;
    if (a.layers[i] == kEdge) layers.edge = kEdge;
    if (a.layers[i] == kArea) layers.area = kArea;
  }
  return layers;
}

// Returns a bit for each of a vector of pieces that is in the box.
INLINE uint32_t observed(const RoadRows& a, const View& view, const Layers& layers, Floats x, Floats y, Floats layer) {
  const Floats dx = x - view.x, dy = y - view.y, ahead_m = ahead(view, dx, dy), left_m = left(view, dx, dy);
  const Ints is_inside = (ahead_m < a.ahead_m) & (ahead_m > -a.behind_m) & (absolute(left_m) < a.side_m);
  return bits(is_inside & ((layer == layers.lane) | (layer == layers.edge) | (layer == layers.area)));
}

// Writes the numbers of the first pieces in the box, and returns how many there are, at most `count`.
//
// Memory takes most of the time: asks for the pieces found, which are scattered, and for the next scenario's positions.
INLINE int64_t find_pieces(const RoadRows& a, int64_t scenario, int64_t next, const View& view, const Layers& layers,
                           int32_t* found) {
  const float *x = a.at + scenario * 3 * a.pieces, *y = x + a.pieces, *layer = y + a.pieces;
  const float* pieces = a.road + scenario * a.pieces * kPieceColumns;
  const float* next_at = a.at + next * 3 * a.pieces;
  int64_t size = 0, piece = 0;
  const auto append = [&](uint32_t lanes) __attribute__((always_inline)) {
    for (; lanes; lanes &= lanes - 1) {
      const int32_t number = (int32_t)piece + __builtin_ctz(lanes);
      __builtin_prefetch(pieces + number * kPieceColumns);
      __builtin_prefetch(pieces + number * kPieceColumns + kPieceColumns - 1);
      found[size++] = number;
    }
  };
  for (; piece + LANES <= a.pieces && size < a.count; piece += LANES) {
    for (int i = 0; i < 3; ++i) __builtin_prefetch(next_at + i * a.pieces + piece);
    append(observed(a, view, layers, load(x + piece), load(y + piece), load(layer + piece)));
  }
  const int64_t rest = a.pieces - piece;
  if (rest && size < a.count)
    append(observed(a, view, layers, load_first(x + piece, rest), load_first(y + piece, rest),
                    load_first(layer + piece, rest)) & ((1u << rest) - 1));
  return size < a.count ? size : a.count;
}

// Factors to the units of columns.
struct RoadUnits {
  float per_position, per_piece, per_speed;
};

// Writes all columns but the curvature.
INLINE void write_columns(const RoadUnits& units, const View& view, const float* piece, float* values) {
  const float dx = piece[kPieceX] - view.x, dy = piece[kPieceY] - view.y, limit = piece[kPieceLimit];
  values[kX] = ahead(view, dx, dy) * units.per_position;
  values[kY] = left(view, dx, dy) * units.per_position;
  values[kCos] = ahead(view, piece[kPieceCos], piece[kPieceSin]);
  values[kSin] = left(view, piece[kPieceCos], piece[kPieceSin]);
  values[kLength] = piece[kPieceLength] * units.per_piece;
  values[kIsLane] = piece[kPieceLayer] == kLane;
  values[kIsEdge] = piece[kPieceLayer] == kEdge;
  values[kIsArea] = piece[kPieceLayer] == kArea;
  values[kLimit] = limit > 0 ? limit * units.per_speed : 0;
  values[kHasLimit] = limit > 0;
}

INLINE float scale_curvature(const RoadRows& a, float curvature) {
  return clamp(curvature / a.curvature_pm, -a.max_curvature, a.max_curvature);
}

void observe_road(const RoadRows& a, int64_t first, int64_t last, int32_t* found) {
  const Layers layers = layers_of(a);
  const RoadUnits units = {1 / a.position_m, 1 / a.piece_m, 1 / a.speed_mps};
  bool has_curvature = false;
  for (int64_t i = 0; i < a.column_count; ++i) has_curvature |= a.columns[i] == kCurvature;
  for (int64_t sample = first; sample < last; ++sample) {
    const int64_t scenario = clamp_row(a.index[sample], a.scenarios);
    const int64_t next = clamp_row(a.index[sample + 1 < last ? sample + 1 : sample], a.scenarios);
    const View view = view_of(a.motion + 4 * sample, a.direction + 2 * sample);
    const int64_t size = find_pieces(a, scenario, next, view, layers, found);
    float* row = a.rows + sample * a.count * a.column_count;
    bool* mask = a.mask + sample * a.count;
    for (int64_t i = 0; i < size; ++i) {
      const int64_t piece = scenario * a.pieces + found[i];
      float values[kRoadRowColumns];
      write_columns(units, view, a.road + piece * kPieceColumns, values);
      if (has_curvature) values[kCurvature] = scale_curvature(a, a.curvature[piece]);
      for (int64_t column = 0; column < a.column_count; ++column) *row++ = values[a.columns[column]];
    }
    __builtin_memset(row, 0, sizeof(float) * (a.count - size) * a.column_count);
    __builtin_memset(mask, true, size);
    __builtin_memset(mask + size, false, a.count - size);
  }
}

}  // namespace drivax::TARGET

#else

namespace drivax {

static ffi::Error observe_road(ffi::ThreadPool pool, ffi::RemainingArgs arguments, ffi::RemainingRets results,
                               float ahead_m, float behind_m, float side_m, Numbers layers, Numbers columns,
                               float position_m, float piece_m, float speed_mps, float curvature_pm,
                               float max_curvature) {
  Arrays arrays(pool, arguments, results);
  RoadRows a;
  a.layers = layers.begin();
  a.layer_count = layers.size();
  a.columns = columns.begin();
  a.column_count = columns.size();
  arrays.common(a.at, {a.scenarios, 3, a.pieces});
  arrays.common(a.road, {a.scenarios, a.pieces, 7});
  arrays.common(a.curvature, {a.scenarios, a.pieces});
  arrays.batched(a.index, {});
  arrays.batched(a.motion, {4});
  arrays.batched(a.direction, {2});
  arrays.batched(a.rows, {a.count, a.column_count});
  arrays.batched(a.mask, {a.count});
  arrays.nonempty({a.scenarios});
  arrays.columns(columns, kRoadRowColumns);
  a.ahead_m = ahead_m;
  a.behind_m = behind_m;
  a.side_m = side_m;
  a.position_m = position_m;
  a.piece_m = piece_m;
  a.speed_mps = speed_mps;
  a.curvature_pm = curvature_pm;
  a.max_curvature = max_curvature;
  return arrays.run(32, [&](int64_t first, int64_t last) {
    thread_local std::vector<int32_t> found;
    if ((int64_t)found.size() < a.count + 32) found.resize(a.count + 32);
    CALL(observe_road, a, first, last, found.data());
  });
}

BIND(observe_road,
     .Attr<float>("ahead_m").Attr<float>("behind_m").Attr<float>("side_m").Attr<Numbers>("layers")
     .Attr<Numbers>("columns").Attr<float>("position_m").Attr<float>("piece_m").Attr<float>("speed_mps")
     .Attr<float>("curvature_pm").Attr<float>("max_curvature"))

}  // namespace drivax

#endif
