"""Red-light violations (semantics, ``red_light``): stop lines, right turns after a stop, lights off the route."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.geometry.boxes import COS, LENGTH, SIN
from drivax.scenario.bank.columns import NEVER_M, LightRow
from drivax.scenario.bank.queries import light_crossing
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.schema import LightState
from drivax.simulator.types import MOTION_SPEED, AgentContext, LightMemory

#: A stop before a right turn on red: slower than this, this near, within this many steps.
_PAUSE_MPS, _PAUSE_M, PAUSE_STEPS = 0.5, 3.0, 30
#: Steps of the history in which a stop before the episode is looked for.
_LOOK_BACK_STEPS = 16
#: Off the route, the heading of an agent this many steps after it crossed lines decides whose light counted.
_DECISION_STEPS = 20


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
    for age in range(_LOOK_BACK_STEPS - 1, -1, -1):
        front = fronts[-1 - age]
        # Only the distance before each line is needed, not the crossing between two steps.
        _, before_m = light_crossing(bank, context.index, front, front, ground)
        stands = context.history[-1 - age, MOTION_SPEED] < _PAUSE_MPS
        pause = jnp.where(stands & (before_m >= 0.0) & (before_m < _PAUSE_M), age, pause)
    return LightMemory(pause.astype(jnp.int8), jnp.zeros_like(pause, jnp.int8))


def forget_crossings(memory: LightMemory) -> LightMemory:
    """Return the memory without lines that were crossed before the episode: they do not count in it."""
    return LightMemory(memory.pause, jnp.zeros_like(memory.crossed))


def check_lights(
    bank: ScenarioBank, context: AgentContext, me: Float[Array, " 6"], ground: Float[Array, ""],
    on_route: Bool[Array, ""], memory: LightMemory,
) -> tuple[Bool[Array, ""], LightMemory]:  # fmt: skip
    """Return whether a red-light violation was established at this step, and the new memory.

    On the route only its own lights count, at once. Off it, of the lines crossed together the one counts whose lane
    ends closest to the heading that the agent has two seconds later, or at the end of the log.
    """
    front_before, front = _fronts(context, me[LENGTH])[-2:]
    crossed, before_m = light_crossing(bank, context.index, front_before, front, ground)
    last = bank.last_step[context.row]
    state = bank.light_state[context.index, jnp.clip(context.step, 0, last)]
    state_before = bank.light_state[context.index, jnp.clip(context.step - 1, 0, last)]
    red = is_red(state) & is_red(state_before)
    # A stop shortly before the line, then a right turn, is lawful unless the light is a red arrow.
    arrow = (state == LightState.ARROW_STOP) | (state_before == LightState.ARROW_STOP)
    line = bank.light_line[context.index]
    red &= ~((line[LightRow.RIGHT] > 0) & (memory.pause < PAUSE_STEPS) & ~arrow)
    arc = line[LightRow.ARC + bank.ego_number(context.row)]
    violation = (crossed & red & (arc < NEVER_M)).any() & on_route

    # Steps since a line was crossed off the route: positive if at red, else negative.
    begins = crossed & ~on_route
    age = jnp.where(begins, jnp.where(red, 1, -1), memory.crossed + jnp.sign(memory.crossed))
    # Crossings that are undecided when the log ends are decided then.
    due = (jnp.abs(age) > _DECISION_STEPS) | ((age != 0) & (context.step >= last))
    # Cosine of the angle to the end of the line's lane; -2 is below any cosine.
    fit = jnp.where(due, line[LightRow.EXIT_COS] * me[COS] + line[LightRow.EXIT_SIN] * me[SIN], -2.0)
    violation |= ((age > 0) & due & (fit >= fit.max() - 1e-6)).any()
    age = jnp.where(due, 0, age)
    stands = (context.history[-1, MOTION_SPEED] < _PAUSE_MPS) & (before_m >= 0.0) & (before_m < _PAUSE_M)
    pause = jnp.where(stands, 0, jnp.minimum(memory.pause.astype(jnp.int32) + 1, PAUSE_STEPS + 1))
    return violation, LightMemory(pause.astype(jnp.int8), age.astype(jnp.int8))


def is_red(state: Int[Array, "*L"]) -> Bool[Array, "*L"]:
    """Mask of the red lights, arrows included."""
    return (state == LightState.ARROW_STOP) | (state == LightState.STOP)


def is_yellow(state: Int[Array, "*L"]) -> Bool[Array, "*L"]:
    """Mask of the yellow lights, arrows included."""
    return (state == LightState.CAUTION) | (state == LightState.ARROW_CAUTION)
