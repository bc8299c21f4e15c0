"""Red-light violations: stop lines, right turns after a stop, lights off the route."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.geometry.boxes import COS, LENGTH, SIN
from drivax.scenario.bank.columns import NEVER_M, LightRow
from drivax.scenario.bank.queries import light_crossing
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.schema import LightState
from drivax.simulator.types import MOTION_SPEED, AgentContext, LightMemory

#: A stop before a right turn on red: maximum speed, maximum distance to the line, and steps for which it is remembered.
_PAUSE_MPS, _PAUSE_M, PAUSE_STEPS = 0.5, 3.0, 30
#: Steps of the history, the present one included, that are searched for a stop before the episode.
_LOOK_BACK_STEPS = 16
#: Steps from crossing lines away from the route until the agent's heading decides which light counts.
_DECISION_STEPS = 20


def _fronts(context: AgentContext, length_m: Float[Array, ""]) -> Float[Array, "history 2"]:
    """Return the position of the front bumper at every step of the context's history."""
    history = context.history
    direction = jnp.stack([jnp.cos(history[:, 2]), jnp.sin(history[:, 2])], axis=-1)
    return history[:, :2] + direction * length_m / 2


def _pauses(speed: Float[Array, ""], distance_m: Float[Array, " L"]) -> Bool[Array, " L"]:
    """Return a mask of the stop lines before which an agent stands, from its speed and the distances to the lines."""
    return (speed < _PAUSE_MPS) & (distance_m >= 0.0) & (distance_m < _PAUSE_M)


def remember_lights(bank: ScenarioBank, context: AgentContext) -> LightMemory:
    """Reconstruct the stop-line memory of the step before a context from the agent's recent motion.

    :func:`check_lights` adds the present step.
    """
    length = bank.length_m(context.index, context.slot)
    ground = context.z - bank.height_m(context.index, context.slot) / 2
    pause = jnp.full(bank.light_line.shape[2], PAUSE_STEPS + 1, jnp.int32)
    fronts = _fronts(context, length)
    for age in range(_LOOK_BACK_STEPS - 2, -1, -1):
        front = fronts[-2 - age]
        # With equal positions nothing crosses; the result is the distance to each line.
        _, distance_m = light_crossing(bank, context.index, front, front, ground)
        pause = jnp.where(_pauses(context.history[-2 - age, MOTION_SPEED], distance_m), age, pause)
    return LightMemory(pause.astype(jnp.int8), jnp.zeros_like(pause, jnp.int8))


def forget_crossings(memory: LightMemory) -> LightMemory:
    """Return the memory without the lines crossed before the episode, which do not count in it."""
    return LightMemory(memory.pause, jnp.zeros_like(memory.crossed))


def check_lights(
    bank: ScenarioBank, context: AgentContext, ego: Float[Array, " 6"], ground: Float[Array, ""],
    on_route: Bool[Array, ""], memory: LightMemory,
) -> tuple[Bool[Array, ""], LightMemory]:  # fmt: skip
    """Return whether a red-light violation is established at this step, and the new memory.

    On the route only lights of the route count, immediately. Off the route a crossing is decided two seconds later, or
    at the end of the log; of lines due at once, only the one whose lane ends closest to the agent's heading counts.
    """
    front_before, front = _fronts(context, ego[LENGTH])[-2:]
    crossed, distance_m = light_crossing(bank, context.index, front_before, front, ground)
    last = bank.last_step[context.row]
    state = bank.light_state[context.index, jnp.clip(context.step, 0, last)]
    state_before = bank.light_state[context.index, jnp.clip(context.step - 1, 0, last)]
    at_red = is_red(state) & is_red(state_before)
    # A right turn after a stop shortly before the line is lawful unless the light is a red arrow.
    is_arrow = (state == LightState.ARROW_STOP) | (state_before == LightState.ARROW_STOP)
    line = bank.light_line[context.index]
    at_red &= ~((line[LightRow.RIGHT] > 0) & (memory.pause < PAUSE_STEPS) & ~is_arrow)
    arc = line[LightRow.ARC + bank.ego_number(context.row)]
    violation = (crossed & at_red & (arc < NEVER_M)).any() & on_route

    # As in :class:`LightMemory`: 1 at the step of the crossing, negative if that was lawful.
    age = jnp.where(crossed & ~on_route, jnp.where(at_red, 1, -1), memory.crossed + jnp.sign(memory.crossed))
    # Crossings that are undecided when the log ends are decided then.
    is_due = (jnp.abs(age) > _DECISION_STEPS) | ((age != 0) & (context.step >= last))
    # Cosine of the angle between the agent's heading and the line's lane at its end; -2 is below any cosine.
    cosine = jnp.where(is_due, line[LightRow.EXIT_COS] * ego[COS] + line[LightRow.EXIT_SIN] * ego[SIN], -2.0)
    violation |= ((age > 0) & is_due & (cosine >= cosine.max() - 1e-6)).any()
    age = jnp.where(is_due, 0, age)
    pauses = _pauses(context.history[-1, MOTION_SPEED], distance_m)
    pause = jnp.where(pauses, 0, jnp.minimum(memory.pause.astype(jnp.int32) + 1, PAUSE_STEPS + 1))
    return violation, LightMemory(pause.astype(jnp.int8), age.astype(jnp.int8))


def is_red(state: Int[Array, "*L"]) -> Bool[Array, "*L"]:
    """Mask of the red lights, arrows included."""
    return (state == LightState.ARROW_STOP) | (state == LightState.STOP)


def is_yellow(state: Int[Array, "*L"]) -> Bool[Array, "*L"]:
    """Mask of the yellow lights, arrows included."""
    return (state == LightState.CAUTION) | (state == LightState.ARROW_CAUTION)
