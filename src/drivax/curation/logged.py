"""Logs of egos, and score functions over whole scenario sets."""

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
from drivax.scenario.bank.queries import project_on_path
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.bank.sizes import Sizes
from drivax.scenario.record import record
from drivax.scenario.store import ScenarioSet
from drivax.simulator.contact import overlaps
from drivax.simulator.traffic.log import alone, frame_of
from drivax.simulator.types import HISTORY, AgentContext, Frame

#: Scenarios per batch.
BATCH = 64
#: The search for ego on its path reaches this multiple of the movement in a step, and this much farther (m).
_SEARCH_FACTOR, _SEARCH_MARGIN_M = 1.5, 2.0
#: Called with (scenarios done, scenarios).
Progress = Callable[[int, int], None]
Numbers = np.ndarray[Any, Any]


@record
class LoggedScenario:
    """Log of one ego of a scenario; while ego is unobserved, it has its last observed motion, at the start its first.

    Attributes:
        context, frame: Context of ego, and all agents, at every step.
        motion, velocity: x, y (m), heading (rad) and speed (m/s) of ego, and its logged velocity (m/s).
        valid: Whether ego is observed.
        ignored: Agents that overlap ego when they appear, until they separate; metrics ignore them, too.
        path, path_points: Points 1 m apart of ego's path (``RouteColumn``), and their number. The path is the logged
            one of the recorded ego, and the route of a further ego, for whose logged path no such points are stored.
        along_m, ground_m: Arc length of ego along its path, and height of the ground under ego.
    """

    context: AgentContext
    motion: Float[Array, "T 4"]
    velocity: Float[Array, "T 2"]
    valid: Bool[Array, " T"]
    frame: Frame
    ignored: Bool[Array, "T S"]
    path: Float[Array, "R 7"]
    path_points: Int[Array, ""]
    along_m: Float[Array, " T"]
    ground_m: Float[Array, " T"]

    @property
    def index(self) -> Int[Array, ""]:
        """Index of the scenario in the bank."""
        return self.context.index[0]

    @property
    def row(self) -> Int[Array, ""]:
        """Row of ego in the bank."""
        return self.context.row[0]

    @property
    def slot(self) -> Int[Array, ""]:
        """Slot of ego among the agents."""
        return self.context.slot[0]


def read_log(bank: ScenarioBank, row: Int[Array, ""]) -> LoggedScenario:
    """Return the log of the ego at a row of the bank; if the row has no ego, no step is valid."""
    index, slot, steps = bank.scenario_of(row), jnp.maximum(bank.ego_slot(row), 0), jnp.arange(bank.steps)
    ego = bank.agents[index, :, slot]
    valid = (ego[:, AgentColumn.VALID] > 0) & (steps <= bank.last_step[row]) & (bank.ego_slot(row) >= 0)
    last_valid = jnp.maximum(jax.lax.cummax(jnp.where(valid, steps, -1)), jnp.argmax(valid))
    contexts = jax.vmap(lambda step: _context(bank, row, step))(last_valid)
    motion = jax.vmap(lambda context: logged_motion(bank, context, 0))(contexts)
    contexts = jax.vmap(partial(_context, bank, row))(steps, motion)

    def frame_at(context: AgentContext) -> Frame:
        return frame_of(bank, index, context.step, bank.agents[index, context.step], alone(context), 0)

    frame = jax.vmap(frame_at)(contexts)
    overlapping = jax.vmap(lambda agents: overlaps(agents, slot))(frame)
    path, path_points = bank.log_routes[index], bank.log_route_points[index]
    along_m = _along_path(path, path_points, motion[:, :2])
    if bank.most_egos > 1:
        further = bank.routes[row], bank.route_points[row], bank.log_progress[row]
        is_recorded = bank.ego_number(row) == 0
        path, path_points, along_m = (
            jnp.where(is_recorded, own, other)
            for own, other in zip((path, path_points, along_m), further, strict=True)
        )
    return LoggedScenario(
        context=contexts,
        motion=motion,
        velocity=ego[last_valid, AgentColumn.VELOCITY],
        valid=valid,
        frame=frame,
        ignored=_ignored_agents(overlapping, frame.valid),
        path=path,
        path_points=path_points,
        along_m=along_m,
        ground_m=frame.z[:, slot] - bank.height_m(index, slot) / 2,
    )


def _context(bank: ScenarioBank, row: Any, step: Any, motion: Any = None) -> AgentContext:
    """Return the context of ego at a step, with ``motion`` (zeros by default) at all steps of its history."""
    history = jnp.zeros((HISTORY, 4)) if motion is None else jnp.broadcast_to(motion, (HISTORY, 4))
    index, slot = bank.scenario_of(row), jnp.maximum(bank.ego_slot(row), 0)
    z, zero = bank.agents[index, step, slot, AgentColumn.Z], jnp.zeros(())
    route = row if bank.most_egos > 1 else None
    return AgentContext(index, step, slot, history, jnp.zeros(2), zero, z, (), route)


def _ignored_agents(overlapping: Bool[Array, "T S"], valid: Bool[Array, "T S"]) -> Bool[Array, "T S"]:
    """Return the mask of agents that have overlapped ego at every step since they appeared."""

    def step(carry: tuple[Array, Array], inputs: tuple[Array, Array]) -> tuple[tuple[Array, Array], Array]:
        (ignored, was_valid), (is_overlapping, is_valid) = carry, inputs
        ignored = is_overlapping & (ignored | ~was_valid)
        return (ignored, is_valid), ignored

    no_agents = jnp.zeros(overlapping.shape[1], bool)
    return jax.lax.scan(step, (no_agents, no_agents), (overlapping, valid))[1]


def _along_path(
    path: Float[Array, "R 7"], points: Int[Array, ""], xy: Float[Array, "T 2"]
) -> Float[Array, " T"]:
    """Return the recorded ego's arc length along its logged path at every step, m; it never decreases."""

    def step(along_m: Array, inputs: tuple[Array, Array]) -> tuple[Array, Array]:
        # Search only as far as the car can have moved, as the simulator does.
        point, distance_m = inputs
        ahead_m = _SEARCH_FACTOR * distance_m + _SEARCH_MARGIN_M
        projection = project_on_path(path[None], points[None], jnp.int32(0), point, along_m, ahead_m)
        along_m = jnp.maximum(along_m, projection.along_m)
        return along_m, along_m

    distance_m = jnp.concatenate([jnp.zeros(1), norm(xy[1:] - xy[:-1])])
    return jax.lax.scan(step, jnp.zeros(()), (xy, distance_m))[1]


@partial(jax.jit, static_argnums=(0, 2))
def score_bank(score: Any, bank: ScenarioBank, egos: int = 1) -> dict[str, Array]:
    """Apply a hashable ``(bank, log) -> {name: [T, ...]}`` to the logs of a bank: ``{name: [M, T, ...]}``.

    These are the logs of the first ``egos`` egos of each scenario (1, or all of the bank), in the order of the bank.
    """
    rows = jnp.arange(len(bank) * egos) * (bank.most_egos // egos)
    return jax.lax.map(lambda row: score(bank, read_log(bank, row)), rows, batch_size=len(bank))


def score_steps(
    data: ScenarioSet, score: Any, progress: Progress | None = None, egos: int = 1
) -> dict[str, Numbers]:
    """Return ``{name: [M, T, ...]}``, the step scores of the logs of a set, computed in batches.

    ``score`` and ``egos`` are as for :func:`score_bank`.

    Raises:
        DataError: A scenario has no future.
    """
    return map_batches(data, lambda bank, _: score_bank(score, bank, egos), progress)


def map_batches(
    data: ScenarioSet, function: Callable[[ScenarioBank, Numbers], dict[str, Any]],
    progress: Progress | None = None,
) -> dict[str, Numbers]:  # fmt: skip
    """Apply a function to banks of one shape, up to ``BATCH`` scenarios each; return results by name, ``[M, ...]``.

    The function also takes the rows of the scenarios in the set. It returns equally many values for each scenario, in
    the order of the scenarios.
    """
    sizes, batches = Sizes.used(data), list[dict[str, Any]]()
    for first in range(0, len(data), BATCH):
        scenarios = data[first : first + BATCH]
        count, rows = len(scenarios), np.arange(first, first + len(scenarios))
        if len(data) > BATCH:
            scenarios += [scenarios[-1]] * (BATCH - count)
            rows = np.pad(rows, (0, BATCH - count), mode="edge")
        result = function(ScenarioBank.from_scenarios(scenarios, trim=sizes), rows)
        # Stack the next bank while this one is computed; at most one result is pending.
        jax.block_until_ready(batches[-1:])
        batches.append(
            {name: values[: len(values) * count // len(scenarios)] for name, values in result.items()}
        )
        if progress is not None:
            progress(first + count, len(data))
    return {name: np.concatenate([np.asarray(batch[name]) for batch in batches]) for name in batches[0]}


def valid_steps(data: ScenarioSet, egos: int = 1) -> Bool[Numbers, "M T"]:
    """Return the mask of steps at which ego is observed, for the recorded ego or all ``egos`` of each scenario."""
    masks = []
    for scenario in data:
        observed = scenario.record["agent_valid"].astype(bool)
        masks.append(observed[:, 0])
        if egos > 1:
            for slot, last in zip(scenario.record["ego_slot"], scenario.record["ego_last_step"], strict=True):
                masks.append(observed[:, slot] & (slot >= 0) & (np.arange(len(observed)) <= last))
    return np.stack(masks)
