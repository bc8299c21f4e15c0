// Contacts of the driven agent with the others: their codes, fault and type of collision, and time to collision.
#include "kernel.h"

namespace drivax {

struct ContactRules {
  int32_t pedestrian, cyclist;     // kinds
  float level_m;                   // largest difference of heights
  float horizon_s;                 // of the time to collision
  float stopped_mps;               // speed below which an agent is stopped
  float rear_axle;                 // behind the centre, as a share of the length
  float behind_tan, parallel_cos;  // of the angles that separate types of collision
  float bumper_m;                  // length of the box that stands for the front
};

struct Contacts : ContactRules {
  const float* box;                // [batch, slots, 6]
  const float* velocity;           // [batch, slots, 2]
  const float* z;                  // [batch, slots]
  Mask valid;                      // [batch, slots]
  const int32_t* kind;             // [batch, slots]
  const float* previous_velocity;  // [batch, slots, 2], one step before
  Mask previous_valid;             // [batch, slots]
  const int32_t* slot;             // [batch]: the driven agent
  const float* speed;              // [batch]: its larger one of before and after the step
  Mask unlawful;                   // [batch]: whether a lateral hit is its fault
  const int8_t* before;            // [batch, slots]: codes one step before
  int64_t slots = -1;
  int8_t* codes;                   // [batch, slots]
  bool* at_fault;                  // [batch]: whether a contact that begins is its fault
  int8_t* type;                    // [batch]: of the nearest contact that begins
  float* time_s;                   // [batch]: time to collision
};

EACH_TARGET(void measure_contacts(const Contacts& arguments, int64_t first, int64_t last);)

}  // namespace drivax

#ifdef TARGET

#include "order.h"
#include "overlap.h"
#include "route.h"

namespace drivax::TARGET {

// As in drivax.simulator.contact.
enum Contact : int8_t { kAbsent, kApart, kHit, kIgnored, kAtFault, kParted, kGone, kReturned };
enum CollisionType : int8_t { kNone, kRearEnd, kRearEnded, kSideSwipe, kHeadOn, kVulnerable, kStoppedObject };

// What a slot holds at this step.
enum Now { kEmpty, kSeparate, kTouching, kTouchingAtFault, kStates };

constexpr int8_t next_contact(int before, int now) {
  const bool was_hit = before == kHit || before >= kAtFault;
  if (now == kEmpty) return was_hit ? kGone : kAbsent;
  if (now == kSeparate) return was_hit ? kParted : kApart;
  // A slot that overlaps as it appears is ignored. A contact after kParted is never a new fault.
  if (before == kAbsent) return kIgnored;
  if (before == kGone) return kReturned;
  if (before == kApart) return now == kTouchingAtFault ? kAtFault : kHit;
  return before == kParted ? (int)kHit : before;
}

// Codes by state and code before, which has three bits.
struct NextContacts {
  int8_t code[kStates][8] = {};
  constexpr NextContacts() {
    for (int now = 0; now < kStates; ++now)
      for (int before = 0; before < 8; ++before) code[now][before] = next_contact(before, now);
  }
};
static constexpr NextContacts kNext;

// Gathers the boxes of the given slots.
INLINE MovingBoxes gather_boxes(const float* box, const float* velocity, const int32_t* slots) {
  alignas(64) float columns[kBoxColumns + 2][LANES];
  for (int lane = 0; lane < LANES; ++lane) {
    const float* from = box + (int64_t)slots[lane] * kBoxColumns;
    for (int column = 0; column < kBoxColumns; ++column) columns[column][lane] = from[column];
    columns[kBoxColumns][lane] = velocity[2 * (int64_t)slots[lane]];
    columns[kBoxColumns + 1][lane] = velocity[2 * (int64_t)slots[lane] + 1];
  }
  return {load(columns[0]), load(columns[1]), load(columns[2]), load(columns[3]),
          load(columns[4]), load(columns[5]), load(columns[6]), load(columns[7])};
}

// One driven agent, and what is known so far.
struct Measurement {
  const Contacts& a;
  int64_t sample;
  MovingBoxes ego;
  Floats time;
  int64_t nearest;  // order of the contact that begins and is nearest, by its distance
  bool at_fault;
  int8_t type;
};

// Decides codes, fault and type of the boxes that overlap, and returns those that do not count for time to collision.
static Ints decide(Measurement& m, const MovingBoxes& other, const int32_t* slots, Ints overlapping, Floats ahead,
                   Floats left, Floats cos) {
  const Contacts& a = m.a;
  const int64_t start = m.sample * a.slots;
  const Floats front_m = m.ego.length / 2.0f;
  const MovingBoxes bumper = {m.ego.x + front_m * m.ego.cos, m.ego.y + front_m * m.ego.sin, m.ego.cos, m.ego.sin,
                              splat(a.bumper_m), m.ego.width, m.ego.vx, m.ego.vy};
  Ints front;
  time_to_overlap(bumper, other, a.horizon_s, &front);
  const Ints behind = absolute(left) < -a.behind_tan * (ahead + a.rear_axle * m.ego.length);
  const Ints opposite = cos < -a.parallel_cos, parallel = cos > a.parallel_cos;
  const Floats squared = comparable(ahead * ahead + left * left);
  const int bits = bits_for(a.slots);
  const auto speed_at = [](const float* velocity) {
    return __builtin_sqrtf(velocity[0] * velocity[0] + velocity[1] * velocity[1]);
  };
  Ints ignored = {};
  for (int lane = 0; lane < LANES; ++lane) {
    if (!overlapping[lane]) continue;
    const int64_t slot = start + slots[lane];
    const int before = a.before[slot] & 7;
    Now now = kTouching;
    if (before == kApart) {
      const float speed = speed_at(a.velocity + 2 * slot);
      const float previous = a.previous_valid[slot] ? speed_at(a.previous_velocity + 2 * slot) : 0;
      const bool is_stopped = speed < a.stopped_mps && previous < a.stopped_mps;
      const bool is_lateral_fault = !behind[lane] && (front[lane] || a.unlawful[m.sample]);
      if (!(a.speed[m.sample] < a.stopped_mps) && (is_stopped || is_lateral_fault)) now = kTouchingAtFault;
      m.at_fault |= now == kTouchingAtFault;
      const int64_t order = order_of(squared[lane], slots[lane], bits);
      if (order < m.nearest) {
        m.nearest = order;
        const bool is_vulnerable = a.kind[slot] == a.pedestrian || a.kind[slot] == a.cyclist;
        m.type = is_vulnerable                                       ? kVulnerable
                 : is_stopped && front[lane]                         ? kStoppedObject
                 : opposite[lane] && (front[lane] || !behind[lane]) ? kHeadOn
                 : front[lane] && parallel[lane]                     ? kRearEnd
                 : behind[lane]                                      ? kRearEnded
                                                                     : kSideSwipe;
      }
    }
    const int8_t code = kNext.code[now][before];
    a.codes[slot] = code;
    ignored[lane] = code == kHit || code == kIgnored || code == kReturned ? -1 : 0;
  }
  return ignored;
}

// Measures the agent against the first `count` of the given slots.
INLINE void measure(Measurement& m, int32_t* slots, int count) {
  const Contacts& a = m.a;
  for (int lane = count; lane < LANES; ++lane) slots[lane] = slots[0];
  const int64_t start = m.sample * a.slots;
  const MovingBoxes other = gather_boxes(a.box + start * kBoxColumns, a.velocity + start * 2, slots);
  Ints overlapping;
  const Floats time = time_to_overlap(m.ego, other, a.horizon_s, &overlapping);
  const Ints is_used = numbers() < count;
  overlapping &= is_used;
  const Floats dx = other.x - m.ego.x, dy = other.y - m.ego.y;
  const Floats cos = other.cos * m.ego.cos + other.sin * m.ego.sin;
  const Floats sin = other.sin * m.ego.cos - other.cos * m.ego.sin;
  const Floats ahead = dx * m.ego.cos + dy * m.ego.sin, left = dy * m.ego.cos - dx * m.ego.sin;
  Ints counts = is_used;
  if (any(overlapping)) counts &= ~decide(m, other, slots, overlapping, ahead, left, cos);
  // Agents entirely behind the rear axle are followers.
  const Floats reach = absolute(cos) * other.length / 2.0f + absolute(sin) * other.width / 2.0f;
  counts &= ahead + reach > -a.rear_axle * m.ego.length;
  m.time = smaller(m.time, select(counts, time, splat(a.horizon_s)));
}

void measure_contacts(const Contacts& a, int64_t first, int64_t last) {
  for (int64_t sample = first; sample < last; ++sample) {
    const int64_t start = sample * a.slots;
    const Mask valid = a.valid + start;
    const int8_t* before = a.before + start;
    const float* z = a.z + start;
    // An agent outside all slots is measured as the last one, but no slot is its own.
    const int32_t own = a.slot[sample];
    const int64_t slot = clamp_row(own, a.slots);
    const int64_t row = start + slot;
    Measurement m = {a, sample, splat_box(a.box + row * kBoxColumns, a.velocity + row * 2), splat(a.horizon_s),
                     INT64_MAX, false, kNone};
    const float height = z[slot];
    int32_t pending[LANES];
    int count = 0;
    for (int32_t i = 0; i < a.slots; ++i) {
      a.codes[start + i] = kNext.code[valid[i] ? kSeparate : kEmpty][before[i] & 7];
      pending[count] = i;
      count += valid[i] & (i != own) & (__builtin_fabsf(z[i] - height) <= a.level_m);
      if (count == LANES) {
        measure(m, pending, count);
        count = 0;
      }
    }
    if (count) measure(m, pending, count);
    a.at_fault[sample] = m.at_fault;
    a.type[sample] = m.type;
    a.time_s[sample] = smallest(m.time);
  }
}

}  // namespace drivax::TARGET

#else

XLA_FFI_REGISTER_STRUCT_ATTR_DECODING(
    drivax::ContactRules, StructMember<int32_t>("pedestrian"), StructMember<int32_t>("cyclist"),
    StructMember<float>("level_m"), StructMember<float>("horizon_s"), StructMember<float>("stopped_mps"),
    StructMember<float>("rear_axle"), StructMember<float>("behind_tan"), StructMember<float>("parallel_cos"),
    StructMember<float>("bumper_m"));

namespace drivax {

static ffi::Error measure_contacts(ffi::ThreadPool pool, ffi::RemainingArgs arguments, ffi::RemainingRets results,
                                   ContactRules rules) {
  Arrays arrays(pool, arguments, results);
  Contacts a = {rules};
  arrays.batched(a.box, {a.slots, 6});
  arrays.batched(a.velocity, {a.slots, 2});
  arrays.batched(a.z, {a.slots});
  arrays.batched(a.valid, {a.slots});
  arrays.batched(a.kind, {a.slots});
  arrays.batched(a.previous_velocity, {a.slots, 2});
  arrays.batched(a.previous_valid, {a.slots});
  arrays.batched(a.slot, {});
  arrays.batched(a.speed, {});
  arrays.batched(a.unlawful, {});
  arrays.batched(a.before, {a.slots});
  arrays.batched(a.codes, {a.slots});
  arrays.batched(a.at_fault, {});
  arrays.batched(a.type, {});
  arrays.batched(a.time_s, {});
  arrays.nonempty({a.slots});
  return arrays.run(64, [&](int64_t first, int64_t last) { CALL(measure_contacts, a, first, last); });
}

BIND(measure_contacts, .Attrs<ContactRules>())

}  // namespace drivax

#endif
