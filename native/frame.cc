// The present frame of a driven agent under log traffic: logged, parked and driven agents in their slots.
#include "kernel.h"

namespace drivax {

struct Frames {
  const float* agents;        // [scenarios, steps, moving, 8]
  const float* size;          // [scenarios, slots, 4]
  const float* parked;        // [scenarios, slots, 8]
  const uint32_t* when;       // [scenarios, words, slots]: steps at which parked agents are observed
  const int8_t* light_state;  // [scenarios, steps, lights]
  const int32_t* index;       // [batch]
  const int32_t* step;        // [batch]
  const int32_t* slot;        // [batch]: the driven agent
  const float* motion;        // [batch, 4]: its x, y, heading and speed
  const float* direction;     // [batch, 2]: cosine and sine of its heading
  int64_t scenarios = -1, steps = -1, moving = -1, slots = -1, words = -1, lights = -1;
  float* box;                 // [batch, slots, 6]
  float* velocity;            // [batch, slots, 2]
  float* z;                   // [batch, slots]: that of the log for the driven agent
  bool* valid;                // [batch, slots]
  int32_t* kind;              // [batch, slots]
  int8_t* lights_now;         // [batch, lights]
};

EACH_TARGET(void read_frames(const Frames& arguments, int64_t first, int64_t last);)

}  // namespace drivax

#ifdef TARGET

#include "overlap.h"
#include "route.h"

namespace drivax::TARGET {

// Columns of the bank's arrays: drivax.scenario.bank.columns.
enum AgentColumn { kAgentX, kAgentY, kAgentZ, kAgentCos, kAgentSin, kAgentVx, kAgentVy, kAgentValid, kAgentColumns };
enum SizeColumn { kSizeLength, kSizeWidth, kSizeHeight, kSizeKind, kSizeColumns };

constexpr int kWord = 32;

static void prefetch(const void* from, int64_t bytes) {
  for (int64_t at = 0; at < bytes; at += 64) __builtin_prefetch((const char*)from + at);
}

void read_frames(const Frames& a, int64_t first, int64_t last) {
  static constexpr float kNone[kAgentColumns] = {};
  for (int64_t sample = first; sample < last; ++sample) {
    const int64_t index = clamp_row(a.index[sample], a.scenarios), step = clamp_row(a.step[sample], a.steps);
    const float* logged = a.agents + (index * a.steps + step) * a.moving * kAgentColumns;
    const float* size = a.size + index * a.slots * kSizeColumns;
    const float* parked = a.parked + index * a.slots * kAgentColumns;
    const uint32_t* when = a.when + (index * a.words + step / kWord) * a.slots;
    if (sample + 1 < last) {
      const int64_t next = clamp_row(a.index[sample + 1], a.scenarios), time = clamp_row(a.step[sample + 1], a.steps);
      prefetch(a.agents + (next * a.steps + time) * a.moving * kAgentColumns, a.moving * kAgentColumns * 4);
      prefetch(a.size + next * a.slots * kSizeColumns, a.slots * kSizeColumns * 4);
    }
    // No agent is valid before the recording.
    const bool has_started = a.step[sample] >= 0;
    float* box = a.box + sample * a.slots * kBoxColumns;
    float* velocity = a.velocity + sample * a.slots * 2;
    float* z = a.z + sample * a.slots;
    bool* valid = a.valid + sample * a.slots;
    int32_t* kind = a.kind + sample * a.slots;
    for (int64_t slot = 0; slot < a.slots; ++slot) {
      const bool is_parked = (when[slot] >> (step % kWord) & 1) && has_started;
      const float* row = is_parked ? parked + slot * kAgentColumns
                         : slot < a.moving ? logged + slot * kAgentColumns
                                           : kNone;
      float* to = box + slot * kBoxColumns;
      to[kBoxX] = row[kAgentX];
      to[kBoxY] = row[kAgentY];
      to[kBoxCos] = row[kAgentCos];
      to[kBoxSin] = row[kAgentSin];
      to[kBoxLength] = size[slot * kSizeColumns + kSizeLength];
      to[kBoxWidth] = size[slot * kSizeColumns + kSizeWidth];
      velocity[2 * slot] = row[kAgentVx];
      velocity[2 * slot + 1] = row[kAgentVy];
      z[slot] = row[kAgentZ];
      valid[slot] = row[kAgentValid] > 0 && has_started;
      const float number = size[slot * kSizeColumns + kSizeKind];
      kind[slot] = absolute(number) < 1e9f ? (int32_t)number : 0;  // Others have no integer.
    }
    const int64_t own = a.slot[sample];
    if (own >= 0 && own < a.moving && !((when[own] >> (step % kWord) & 1) && has_started)) {
      const float* motion = a.motion + sample * 4;
      const float cos = a.direction[2 * sample], sin = a.direction[2 * sample + 1], speed = motion[3];
      float* to = box + own * kBoxColumns;
      to[kBoxX] = motion[0];
      to[kBoxY] = motion[1];
      to[kBoxCos] = cos;
      to[kBoxSin] = sin;
      velocity[2 * own] = speed * cos;
      velocity[2 * own + 1] = speed * sin;
      valid[own] = true;
    }
    const int8_t* states = a.light_state + (index * a.steps + step) * a.lights;
    for (int64_t i = 0; i < a.lights; ++i) a.lights_now[sample * a.lights + i] = has_started ? states[i] : -1;
  }
}

}  // namespace drivax::TARGET

#else

namespace drivax {

static ffi::Error read_frames(ffi::ThreadPool pool, ffi::RemainingArgs arguments, ffi::RemainingRets results) {
  Arrays arrays(pool, arguments, results);
  Frames a;
  arrays.common(a.agents, {a.scenarios, a.steps, a.moving, 8});
  arrays.common(a.size, {a.scenarios, a.slots, 4});
  arrays.common(a.parked, {a.scenarios, a.slots, 8});
  arrays.common(a.when, {a.scenarios, a.words, a.slots});
  arrays.common(a.light_state, {a.scenarios, a.steps, a.lights});
  arrays.batched(a.index, {});
  arrays.batched(a.step, {});
  arrays.batched(a.slot, {});
  arrays.batched(a.motion, {4});
  arrays.batched(a.direction, {2});
  arrays.batched(a.box, {a.slots, 6});
  arrays.batched(a.velocity, {a.slots, 2});
  arrays.batched(a.z, {a.slots});
  arrays.batched(a.valid, {a.slots});
  arrays.batched(a.kind, {a.slots});
  arrays.batched(a.lights_now, {a.lights});
  arrays.nonempty({a.scenarios, a.steps});
  arrays.require(a.moving <= a.slots && a.steps <= 32 * a.words, "moving agents or steps without a place");
  return arrays.run(32, [&](int64_t first, int64_t last) { CALL(read_frames, a, first, last); });
}

BIND(read_frames)

}  // namespace drivax

#endif
