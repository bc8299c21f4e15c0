// Contacts of the driven agent with the other agents: contact codes, fault and type of a new collision, and time to
// collision. Native version of next_contacts, classify_contacts and time_to_collision in drivax.simulator.contact.
#include "kernel.h"

namespace drivax {

struct ContactRules {
  int32_t pedestrian, cyclist;  // values of AgentKind
  float level_m;                // largest height difference of agents that can collide
  float horizon_s;              // largest time to collision
  float stopped_mps;            // speed below which an agent is stopped
  float rear_axle;              // distance of the rear axle behind the box centre, as a fraction of the length
  // Tangent of half the angle of the sector behind the rear axle; cosine of the largest heading difference of parallel
  // agents.
  float behind_tan, parallel_cos;
  float bumper_m;               // length of the narrow box that represents the front bumper
};

struct Contacts : ContactRules {
  const float* box;                // [batch, slots, 6]: columns as in overlap.h
  const float* velocity;           // [batch, slots, 2]
  const float* z;                  // [batch, slots]: height of the box centre
  Mask valid;                      // [batch, slots]
  const int32_t* kind;             // [batch, slots]: AgentKind
  const float* previous_velocity;  // [batch, slots, 2]: velocity at the previous step
  Mask previous_valid;             // [batch, slots]: valid at the previous step
  const int32_t* slot;             // [batch]: slot of the driven agent
  const float* speed;              // [batch]: the larger of its speeds before and after the step
  Mask unlawful;                   // [batch]: it is in several lanes or off the road: at fault in lateral collisions
  const int8_t* before;            // [batch, slots]: contact codes of the previous step
  int64_t slots = -1;
  int8_t* codes;                   // [batch, slots]: contact codes of this step
  bool* at_fault;                  // [batch]: whether the driven agent is at fault in a new contact
  int8_t* type;                    // [batch]: CollisionType of the nearest new contact
  float* time_s;                   // [batch]: time to collision
};

EACH_TARGET(void measure_contacts(const Contacts& arguments, int64_t first, int64_t last);)

}  // namespace drivax

#ifdef TARGET

#include "order.h"
#include "overlap.h"
#include "route.h"

namespace drivax::TARGET {

// The enums of drivax.simulator.contact.
enum Contact : int8_t { kAbsent, kApart, kHit, kIgnored, kAtFault, kParted, kGone, kReturned };
enum CollisionType : int8_t { kNone, kRearEnd, kRearEnded, kSideSwipe, kHeadOn, kVulnerable, kStoppedObject };

// State of a slot at this step: no agent, no overlap with the driven agent, overlap, or a new overlap for which the
// driven agent is at fault.
enum Now { kEmpty, kSeparate, kTouching, kTouchingAtFault, kStates };

// Contact code of a slot, given its code at the previous step and its state at this one.
constexpr int8_t next_contact(int before, int now) {
  const bool was_hit = before == kHit || before >= kAtFault;
  if (now == kEmpty) return was_hit ? kGone : kAbsent;
  if (now == kSeparate) return was_hit ? kParted : kApart;
  // An agent that already overlaps when it appears is ignored until it separates. Renewed contact after kParted is a
  // hit, never a new fault.
  if (before == kAbsent) return kIgnored;
  if (before == kGone) return kReturned;
  if (before == kApart) return now == kTouchingAtFault ? kAtFault : kHit;
  return before == kParted ? (int)kHit : before;
}

// Table of next_contact. A previous code has three bits, so that any byte is a valid index once masked with 7.
struct NextContacts {
  int8_t code[kStates][8] = {};
  constexpr NextContacts() {
    for (int now = 0; now < kStates; ++now)
      for (int before = 0; before < 8; ++before) code[now][before] = next_contact(before, now);
  }
};
static constexpr NextContacts kNext;

// Transposes the boxes and velocities of LANES slots from rows into vectors.
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

// The driven agent of a sample, and its results accumulated over batches of other agents.
struct Measurement {
  const Contacts& a;
  int64_t sample;
  MovingBoxes ego;
  Floats time;      // smallest time to collision in each vector element
  int64_t nearest;  // sort key (order_of) of the nearest new contact: squared distance, then slot
  bool at_fault;
  int8_t type;
};

// Writes the contact codes of overlapping agents, and updates `at_fault` and the type of the nearest new contact.
// Returns the mask of agents whose overlap the time to collision ignores. `ahead`, `left` and `cos` are the other
// agents' positions and the cosines of their headings in the frame of the driven agent.
static Ints decide(Measurement& m, const MovingBoxes& other, const int32_t* slots, Ints overlapping, Floats ahead,
                   Floats left, Floats cos) {
  const Contacts& a = m.a;
  const int64_t start = m.sample * a.slots;
  const Floats front_m = m.ego.length / 2.0f;
  const MovingBoxes bumper = {m.ego.x + front_m * m.ego.cos, m.ego.y + front_m * m.ego.sin, m.ego.cos, m.ego.sin,
                              splat(a.bumper_m), m.ego.width, m.ego.vx, m.ego.vy};
  Ints front;
  time_to_overlap(bumper, other, a.horizon_s, &front);
  // Seen from the rear axle, the other agent's centre is in the sector straight behind.
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
    if (before == kApart) {  // a new contact
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

// Computes overlap and time to collision of the driven agent with the agents in the first `count` of LANES slots; the
// other vector elements repeat the first slot and are masked.
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
  // `reach` is the other box's half extent along the driven agent's heading. Agents entirely behind the rear axle are
  // following and do not count.
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
    // A slot out of range reads the box of the last slot; `own` then excludes no slot from the other agents.
    const int32_t own = a.slot[sample];
    const int64_t slot = clamp_row(own, a.slots);
    const int64_t row = start + slot;
    Measurement m = {a, sample, splat_box(a.box + row * kBoxColumns, a.velocity + row * 2), splat(a.horizon_s),
                     INT64_MAX, false, kNone};
    const float height = z[slot];
    // Collects the other agents on the driven agent's level in batches of LANES. Every slot first gets the code of an
    // agent that does not overlap; `decide` overwrites the codes of those that do.
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
