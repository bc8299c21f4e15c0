"""Red-light violations (semantics, ``red_light``): stop lines, right turns after a stop, lights off the route."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.scenario.bank.columns import LightRow
from drivax.scenario.bank.queries import light_crossing
from drivax.scenario.bank.scenario_bank import NEVER_M, ScenarioBank
from drivax.scenario.schema import LightState
from drivax.simulator.types import MOTION_SPEED, AgentContext, LightMemory

#: A stop before a right turn on red: slower than this, this near, within this many steps.
_PAUSE_MPS, _PAUSE_M, PAUSE_STEPS = 0.5, 3.0, 30
#: Steps of the history in which a stop before the episode is looked for.
_REMEMBERED = 16
#: Off the route, which of the lights it crossed an agent obeyed is evaluated by its heading this many steps later.
JUDGED_AFTER = 20


def _fronts(context: AgentContext, length_m: Float[Array, ""]) -> Float[Array, "history 2"]:
    """Return the front bumper at every step of the context's history."""
    past = context.history
    ahead = jnp.stack([jnp.cos(past[:, 2]), jnp.sin(past[:, 2])], axis=-1)
    return past[:, :2] + ahead * length_m / 2


def remember_lights(bank: ScenarioBank, context: AgentContext) -> LightMemory:
    """Return the stop-line memory that the recent motion of a context implies."""
    length = bank.length_m(context.index, context.slot)
    ground = context.z - bank.height_m(context.index, context.slot) / 2
    pause = jnp.full(bank.light_line.shape[2], PAUSE_STEPS + 1, jnp.int32)
    fronts = _fronts(context, length)
    for age in range(_REMEMBERED - 1, -1, -1):
        front = fronts[-1 - age]
        _, before_m = light_crossing(bank, context.index, front, front, ground)
        stands = context.history[-1 - age, MOTION_SPEED] < _PAUSE_MPS
        pause = jnp.where(stands & (before_m >= 0.0) & (before_m < _PAUSE_M), age, pause)
    return LightMemory(pause.astype(jnp.int8), jnp.zeros_like(pause, jnp.int8))


def nothing_crossed(memory: LightMemory) -> LightMemory:
    """Return the memory at the start of an episode, which is not charged with lines crossed before."""
    return LightMemory(memory.pause, jnp.zeros_like(memory.crossed))


def check_lights(
    bank: ScenarioBank, context: AgentContext, me: Float[Array, " 6"], ground: Float[Array, ""],
    on_route: Bool[Array, ""], memory: LightMemory,
) -> tuple[Bool[Array, ""], LightMemory]:  # fmt: skip
    """Return whether a red-light violation was established at this step, and the new memory.

    On the route only its own lights count, at once. Off it, of the lines crossed together the one counts whose lane
    ends closest to the heading that the agent has two seconds later, or at the end of the log.
    """
    front_before, front = _fronts(context, me[4])[-2:]
    crossed, before_m = light_crossing(bank, context.index, front_before, front, ground)
    last = bank.last_step[context.index]
    now = bank.light_state[context.index, jnp.clip(context.step, 0, last)]
    then = bank.light_state[context.index, jnp.clip(context.step - 1, 0, last)]
    red = is_red(now) & is_red(then)
    # A stop shortly before the line, then a right turn, is lawful unless the light is a red arrow.
    arrow = (now == LightState.ARROW_STOP) | (then == LightState.ARROW_STOP)
    line = bank.light_line[context.index]
    red &= ~((line[LightRow.RIGHT] > 0) & (memory.pause < PAUSE_STEPS) & ~arrow)
    ran = (crossed & red & (line[LightRow.ARC] < NEVER_M)).any() & on_route

    begins = crossed & ~on_route
    age = jnp.where(begins, jnp.where(red, 1, -1), memory.crossed + jnp.sign(memory.crossed))
    # What is still open when the log ends is evaluated then.
    due = (jnp.abs(age) > JUDGED_AFTER) | ((age != 0) & (context.step >= last))
    fit = jnp.where(due, line[LightRow.EXIT_COS] * me[2] + line[LightRow.EXIT_SIN] * me[3], -2.0)
    ran |= ((age > 0) & due & (fit >= fit.max() - 1e-6)).any()
    age = jnp.where(due, 0, age)
    stands = (context.history[-1, MOTION_SPEED] < _PAUSE_MPS) & (before_m >= 0.0) & (before_m < _PAUSE_M)
    pause = jnp.where(stands, 0, jnp.minimum(memory.pause.astype(jnp.int32) + 1, PAUSE_STEPS + 1))
    return ran, LightMemory(pause.astype(jnp.int8), age.astype(jnp.int8))


def is_red(state: Int[Array, "*L"]) -> Bool[Array, "*L"]:
    """Mask of the red lights, arrows included."""
    return (state == LightState.ARROW_STOP) | (state == LightState.STOP)


def is_yellow(state: Int[Array, "*L"]) -> Bool[Array, "*L"]:
    """Mask of the yellow lights, arrows included."""
    return (state == LightState.CAUTION) | (state == LightState.ARROW_CAUTION)
