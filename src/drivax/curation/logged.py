"""A log as its ego drove it, step by step: what every score of recorded driving looks at."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.geometry.vectors import norm
from drivax.planners.simple import logged_motion
from drivax.scenario.bank.columns import AgentColumn
from drivax.scenario.bank.queries import project_on_route
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record
from drivax.simulator.contact import overlaps
from drivax.simulator.traffic.log import alone, frame_of
from drivax.simulator.types import HISTORY, AgentContext, Frame

#: Row of ``bank.routes`` that holds the log's own way.
LOG_ROUTE = 1


@record
class Logged:
    """One log. Where ego is not there, its last motion stands for it.

    Attributes:
        context: What the simulator would know of ego at every step.
        motion: x, y (m), heading (rad), speed (m/s) of ego.
        velocity: As recorded, m/s.
        valid: Whether ego is there.
        frame: Everyone at every step.
        left_out: Who overlapped ego when it appeared, until it parts: it counts for nothing, as in metrics.
        along_m: Arc length of ego along the log's route.
        ground_m: Height of the ground under ego.
    """

    context: AgentContext
    motion: Float[Array, "T 4"]
    velocity: Float[Array, "T 2"]
    valid: Bool[Array, " T"]
    frame: Frame
    left_out: Bool[Array, "T S"]
    along_m: Float[Array, " T"]
    ground_m: Float[Array, " T"]

    @property
    def index(self) -> Int[Array, ""]:
        """Row of the bank."""
        return self.context.index[0]


def logged(bank: ScenarioBank, index: Int[Array, ""]) -> Logged:
    """The log of one scenario."""
    rows = bank.agents[index, :, 0]
    valid, steps = rows[:, AgentColumn.VALID] > 0, jnp.arange(bank.steps)
    known = jnp.maximum(jax.lax.cummax(jnp.where(valid, steps, -1)), jnp.argmax(valid))
    contexts = jax.vmap(lambda step: _scene(bank, index, step))(known)
    motion = jax.vmap(lambda context: logged_motion(bank, context, 0))(contexts)
    contexts = jax.vmap(lambda step, now: _scene(bank, index, step, now))(steps, motion)
    frame = jax.vmap(
        lambda context: frame_of(
            bank, index, context.step, bank.agents[index, context.step], alone(context), 0
        )
    )(contexts)
    touching = jax.vmap(lambda now: overlaps(now, jnp.int32(0)))(frame)
    return Logged(
        context=contexts,
        motion=motion,
        velocity=rows[known, AgentColumn.VELOCITY],
        valid=valid,
        frame=frame,
        left_out=_left_out(touching, frame.valid),
        along_m=_along_route(bank, index, motion[:, :2]),
        ground_m=frame.z[:, 0] - bank.height_m(index, 0) / 2,
    )


def _scene(bank: ScenarioBank, index: Any, step: Any, motion: Any = None) -> AgentContext:
    history = jnp.zeros((HISTORY, 4)) if motion is None else jnp.broadcast_to(motion, (HISTORY, 4))
    z, zero = bank.agents[index, step, 0, AgentColumn.Z], jnp.zeros(())
    return AgentContext(index, step, jnp.int32(0), history, jnp.zeros(2), zero, z, ())


def _left_out(touching: Bool[Array, "T S"], there: Bool[Array, "T S"]) -> Bool[Array, "T S"]:
    def step(carry: tuple[Array, Array], now: tuple[Array, Array]) -> tuple[tuple[Array, Array], Array]:
        (ignored, was_there), (touches, is_there) = carry, now
        ignored = touches & (ignored | ~was_there)
        return (ignored, is_there), ignored

    nobody = jnp.zeros(touching.shape[1], bool)
    return jax.lax.scan(step, (nobody, nobody), (touching, there))[1]


def _along_route(bank: ScenarioBank, index: Int[Array, ""], xy: Float[Array, "T 2"]) -> Float[Array, " T"]:
    def step(along: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        # No further than the car can have come, as the simulator follows its own route.
        point, moved = now
        hit = project_on_route(bank, index, point, along, 1.5 * moved + 2.0, route=LOG_ROUTE)
        along = jnp.maximum(along, hit.along_m)
        return along, along

    moved = jnp.concatenate([jnp.zeros(1), norm(xy[1:] - xy[:-1])])
    return jax.lax.scan(step, jnp.zeros(()), (xy, moved))[1]


@partial(jax.jit, static_argnums=0)
def of_logs(of: Any, bank: ScenarioBank) -> dict[str, Array]:
    """What a hashable ``(bank, log) -> {name: [T, ...]}`` says of every log of a bank: ``{name: [N, T, ...]}``."""
    return jax.vmap(lambda index: of(bank, logged(bank, index)))(jnp.arange(len(bank)))
