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
  int64_t scenarios, pieces, batch;
  float ahead_m, behind_m, side_m;
  const int32_t* layers;  // [layer_count]: those that are observed
  int64_t layer_count;
  float position_m, piece_m, speed_mps, curvature_pm, max_curvature;  // units, and the largest curvature in its unit
  const int32_t* columns;  // [column_count]: RoadRowColumn
  int64_t column_count;
  int64_t count;
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

// Writes the numbers of the first pieces in the box, and returns how many there are, at most `count`.
INLINE int64_t find_pieces(const RoadRows& a, const float* at, const View& view, int32_t* found) {
  const float *x = at, *y = at + a.pieces, *layer = at + 2 * a.pieces;
  int64_t size = 0;
  for (int64_t piece = 0; piece < a.pieces && size < a.count; piece += LANES) {
    const int64_t rest = a.pieces - piece;
    const Floats dx = load_first(x + piece, rest) - view.x, dy = load_first(y + piece, rest) - view.y;
    const Floats ahead_m = ahead(view, dx, dy), left_m = left(view, dx, dy);
    const Floats layers = load_first(layer + piece, rest);
    Ints is_observed = {};
    for (int64_t i = 0; i < a.layer_count; ++i) is_observed |= layers == (float)a.layers[i];
    is_observed &= (ahead_m < a.ahead_m) & (ahead_m > -a.behind_m) & (absolute(left_m) < a.side_m);
    if (rest < LANES) is_observed &= numbers() < (int32_t)rest;
    for (uint32_t lanes = bits(is_observed); lanes; lanes &= lanes - 1)
      found[size++] = (int32_t)piece + __builtin_ctz(lanes);
  }
  return size < a.count ? size : a.count;
}

INLINE void write_columns(const RoadRows& a, const View& view, const float* piece, float curvature, float* values) {
  const float dx = piece[kPieceX] - view.x, dy = piece[kPieceY] - view.y, limit = piece[kPieceLimit];
  values[kX] = ahead(view, dx, dy) / a.position_m;
  values[kY] = left(view, dx, dy) / a.position_m;
  values[kCos] = ahead(view, piece[kPieceCos], piece[kPieceSin]);
  values[kSin] = left(view, piece[kPieceCos], piece[kPieceSin]);
  values[kLength] = piece[kPieceLength] / a.piece_m;
  values[kIsLane] = piece[kPieceLayer] == kLane;
  values[kIsEdge] = piece[kPieceLayer] == kEdge;
  values[kIsArea] = piece[kPieceLayer] == kArea;
  values[kLimit] = limit > 0 ? limit / a.speed_mps : 0;
  values[kHasLimit] = limit > 0;
  const float scaled = curvature / a.curvature_pm;
  values[kCurvature] = scaled < -a.max_curvature ? -a.max_curvature : scaled < a.max_curvature ? scaled : a.max_curvature;
}

void observe_road(const RoadRows& a, int64_t first, int64_t last, int32_t* found) {
  for (int64_t sample = first; sample < last; ++sample) {
    const int64_t scenario = clamp_row(a.index[sample], a.scenarios);
    const View view = view_of(a.motion + 4 * sample, a.direction + 2 * sample);
    const int64_t size = find_pieces(a, a.at + scenario * 3 * a.pieces, view, found);
    float* row = a.rows + sample * a.count * a.column_count;
    bool* mask = a.mask + sample * a.count;
    for (int64_t i = 0; i < size; ++i) {
      const int64_t piece = scenario * a.pieces + found[i];
      float values[kRoadRowColumns];
      write_columns(a, view, a.road + piece * kPieceColumns, a.curvature[piece], values);
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

static ffi::Error observe_road(ffi::ThreadPool pool, Float at, Float road, Float curvature, Int index, Float motion,
                               Float direction, float ahead_m, float behind_m, float side_m, Numbers layers,
                               Numbers columns, float position_m, float piece_m, float speed_mps, float curvature_pm,
                               float max_curvature, Result<Float> rows, Result<Bool> mask) {
  RoadRows a;
  a.at = at.typed_data();
  a.road = road.typed_data();
  a.curvature = curvature.typed_data();
  a.index = index.typed_data();
  a.motion = motion.typed_data();
  a.direction = direction.typed_data();
  a.scenarios = axis_from_last(curvature, 2);
  a.pieces = axis_from_last(curvature, 1);
  a.batch = index.element_count();
  a.ahead_m = ahead_m;
  a.behind_m = behind_m;
  a.side_m = side_m;
  a.layers = layers.begin();
  a.layer_count = layers.size();
  a.position_m = position_m;
  a.piece_m = piece_m;
  a.speed_mps = speed_mps;
  a.curvature_pm = curvature_pm;
  a.max_curvature = max_curvature;
  a.columns = columns.begin();
  a.column_count = columns.size();
  a.count = axis_from_last(*mask, 1);
  a.rows = rows->typed_data();
  a.mask = mask->typed_data();
  divide(pool, a.batch, 32, [&](int64_t first, int64_t last) {
    thread_local std::vector<int32_t> found;
    if ((int64_t)found.size() < a.count + 32) found.resize(a.count + 32);
    CALL(observe_road, a, first, last, found.data());
  });
  return ffi::Error::Success();
}

BIND(observe_road, observe_road,
     .Ctx<ffi::ThreadPool>().Arg<Float>().Arg<Float>().Arg<Float>().Arg<Int>().Arg<Float>().Arg<Float>()
     .Attr<float>("ahead_m").Attr<float>("behind_m").Attr<float>("side_m").Attr<Numbers>("layers")
     .Attr<Numbers>("columns").Attr<float>("position_m").Attr<float>("piece_m").Attr<float>("speed_mps")
     .Attr<float>("curvature_pm").Attr<float>("max_curvature")
     .Ret<Float>().Ret<Bool>())

}  // namespace drivax

#endif
