"""Logged scenarios, and score functions over whole scenario sets."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from drivax.geometry.vectors import norm
from drivax.planners.simple import logged_motion
from drivax.scenario.bank.columns import AgentColumn
from drivax.scenario.bank.queries import project_on_route
from drivax.scenario.bank.scenario_bank import ScenarioBank, Sizes
from drivax.scenario.record import record
from drivax.scenario.store import ScenarioSet
from drivax.simulator.contact import overlaps
from drivax.simulator.traffic.log import alone, frame_of
from drivax.simulator.types import HISTORY, AgentContext, Frame

#: Scenarios per batch.
BATCH = 64
#: Called with (scenarios done, scenarios).
Progress = Callable[[int, int], None]
Numbers = np.ndarray[Any, Any]


@record
class LoggedScenario:
    """Log of one scenario; an unobserved ego has its last observed motion, or at the start its first.

    Attributes:
        context, frame: Context of ego, and all agents, at every step.
        motion, velocity: x, y (m), heading (rad) and speed (m/s) of ego, and its logged velocity (m/s).
        valid: Whether ego is observed.
        ignored: Agents that overlap ego when they appear, until they separate; metrics ignore them, too.
        along_m, ground_m: Arc length of ego along the logged route, and height of the ground under ego.
    """

    context: AgentContext
    motion: Float[Array, "T 4"]
    velocity: Float[Array, "T 2"]
    valid: Bool[Array, " T"]
    frame: Frame
    ignored: Bool[Array, "T S"]
    along_m: Float[Array, " T"]
    ground_m: Float[Array, " T"]

    @property
    def index(self) -> Int[Array, ""]:
        """Index of the scenario in the bank."""
        return self.context.index[0]


def read_log(bank: ScenarioBank, index: Int[Array, ""]) -> LoggedScenario:
    """Return the log of one scenario."""
    ego = bank.agents[index, :, 0]
    valid, steps = ego[:, AgentColumn.VALID] > 0, jnp.arange(bank.steps)
    last_valid = jnp.maximum(jax.lax.cummax(jnp.where(valid, steps, -1)), jnp.argmax(valid))
    contexts = jax.vmap(lambda step: _context(bank, index, step))(last_valid)
    motion = jax.vmap(lambda context: logged_motion(bank, context, 0))(contexts)
    contexts = jax.vmap(partial(_context, bank, index))(steps, motion)

    def frame_at(context: AgentContext) -> Frame:
        return frame_of(bank, index, context.step, bank.agents[index, context.step], alone(context), 0)

    frame = jax.vmap(frame_at)(contexts)
    overlapping = jax.vmap(lambda agents: overlaps(agents, jnp.int32(0)))(frame)
    return LoggedScenario(
        context=contexts,
        motion=motion,
        velocity=ego[last_valid, AgentColumn.VELOCITY],
        valid=valid,
        frame=frame,
        ignored=_ignored_agents(overlapping, frame.valid),
        along_m=_along_route(bank, index, motion[:, :2]),
        ground_m=frame.z[:, 0] - bank.height_m(index, 0) / 2,
    )


def _context(bank: ScenarioBank, index: Any, step: Any, motion: Any = None) -> AgentContext:
    """Return the context of ego at a step, with ``motion`` (zeros by default) at all steps of its history."""
    history = jnp.zeros((HISTORY, 4)) if motion is None else jnp.broadcast_to(motion, (HISTORY, 4))
    z, zero = bank.agents[index, step, 0, AgentColumn.Z], jnp.zeros(())
    row = bank.row_of(index, 0) if bank.most_egos > 1 else None
    return AgentContext(index, step, jnp.int32(0), history, jnp.zeros(2), zero, z, (), row)


def _ignored_agents(overlapping: Bool[Array, "T S"], valid: Bool[Array, "T S"]) -> Bool[Array, "T S"]:
    """Return the mask of agents that have overlapped ego at every step since they appeared."""

    def step(carry: tuple[Array, Array], inputs: tuple[Array, Array]) -> tuple[tuple[Array, Array], Array]:
        (ignored, was_valid), (is_overlapping, is_valid) = carry, inputs
        ignored = is_overlapping & (ignored | ~was_valid)
        return (ignored, is_valid), ignored

    no_agents = jnp.zeros(overlapping.shape[1], bool)
    return jax.lax.scan(step, (no_agents, no_agents), (overlapping, valid))[1]


def _along_route(bank: ScenarioBank, index: Int[Array, ""], xy: Float[Array, "T 2"]) -> Float[Array, " T"]:
    """Return ego's arc length along the logged route at every step, m; it never decreases."""

    def step(along_m: Array, inputs: tuple[Array, Array]) -> tuple[Array, Array]:
        # Search only as far as the car can have moved, as the simulator does.
        point, distance_m = inputs
        projection = project_on_route(bank, index, point, along_m, 1.5 * distance_m + 2.0, logged=True)
        along_m = jnp.maximum(along_m, projection.along_m)
        return along_m, along_m

    distance_m = jnp.concatenate([jnp.zeros(1), norm(xy[1:] - xy[:-1])])
    return jax.lax.scan(step, jnp.zeros(()), (xy, distance_m))[1]


@partial(jax.jit, static_argnums=0)
def score_bank(score: Any, bank: ScenarioBank) -> dict[str, Array]:
    """Apply a hashable ``(bank, log) -> {name: [T, ...]}`` to every log of a bank: ``{name: [N, T, ...]}``."""
    return jax.vmap(lambda index: score(bank, read_log(bank, index)))(jnp.arange(len(bank)))


def score_steps(data: ScenarioSet, score: Any, progress: Progress | None = None) -> dict[str, Numbers]:
    """Return ``{name: [N, T, ...]}``, the step scores of every log of a set, computed in batches.

    ``score`` is a hashable function ``(bank, log) -> {name: [T, ...]}``.

    Raises:
        DataError: A scenario has no future.
    """
    return map_batches(data, lambda bank: score_bank(score, bank), progress)


def map_batches(
    data: ScenarioSet, function: Callable[[ScenarioBank], dict[str, Any]], progress: Progress | None = None
) -> dict[str, Numbers]:
    """Apply a function to banks of one shape, up to ``BATCH`` scenarios each; return results by name, ``[N, ...]``."""
    sizes, batches = Sizes.used(data), list[dict[str, Any]]()
    for first in range(0, len(data), BATCH):
        scenarios = data[first : first + BATCH]
        count = len(scenarios)
        if len(data) > BATCH:
            scenarios += [scenarios[-1]] * (BATCH - count)
        result = function(ScenarioBank.from_scenarios(scenarios, trim=sizes))
        # Stack the next bank while this one is computed; at most one result is pending.
        jax.block_until_ready(batches[-1:])
        batches.append({name: values[:count] for name, values in result.items()})
        if progress is not None:
            progress(first + count, len(data))
    return {name: np.concatenate([np.asarray(batch[name]) for batch in batches]) for name in batches[0]}


def valid_steps(data: ScenarioSet) -> Bool[Numbers, "N T"]:
    """Return the mask of steps at which ego is observed."""
    return np.stack([np.asarray(scenario.record["agent_valid"][:, 0], bool) for scenario in data])
