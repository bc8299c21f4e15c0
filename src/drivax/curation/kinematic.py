"""Criticality from motion alone: how soon, and how hard, a recorded driver had to act.

At every step of the log, while the expert is replayed in the graph:

- urgency is the inverse of the time to collision (Hayward, 1972; the inverse so that no conflict is 0), scaled from
  0 at the horizon of 5 s to 1 at ``urgent_s``;
- braking is the deceleration that avoids reaching the nearest agent on the driver's own way if it keeps its speed,
  ``(v - v_leader)^2 / (2 gap)`` (Cooper and Ferguson, Traffic Studies at T-Junctions, 1976), as a share of what the car
  can do (the brake threat number of Braennstroem, Sjoeberg and Coelingh, A Situation and Threat Assessment Algorithm
  for a Rear-End Collision Avoidance System, 2008);
- criticality is their mean: a conflict counts fully where it is near in time and in the way.

Time to collision sees crossing traffic but takes headings as fixed, so that it finds oncoming traffic in bends.
Required braking follows the way through bends but sees only who is on it. The mean keeps either error below a half.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from drivax.errors import UsageError
from drivax.planners.simple import logged_motion
from drivax.scenario.bank import ScenarioBank
from drivax.scenario.queries import LEVEL_M, project_on_route
from drivax.scenario.store import ScenarioSet
from drivax.simulator.contact import TTC_HORIZON_S, Contact
from drivax.simulator.simulator import Simulator
from drivax.simulator.traffic import alone
from drivax.simulator.types import Facts, Frame, SimState
from drivax.tasks.task import Task

#: Scenarios that are scored side by side; more than these are stacked untrimmed, so that one program serves all.
BATCH = 64
_LOG_ROUTE = 1
#: Middles of the two windows of the map query that cover about 75 m of the way ahead, m.
_WINDOWS_M = (6.0, 45.0)


@dataclass(frozen=True)
class KinematicConfig:
    """Scales of the two terms.

    Attributes:
        urgent_s: Time to collision at and below which urgency is 1; the bound of the metric ``ttc_ok``.
        full_braking_mps2: Required deceleration at and above which braking is 1; the physical action space's limit.
    """

    urgent_s: float = 0.95
    full_braking_mps2: float = 6.0

    def __post_init__(self) -> None:
        if not 0.0 < self.urgent_s < TTC_HORIZON_S:
            raise UsageError(
                f"urgent_s is {self.urgent_s}", cure=f"use more than 0 and less than {TTC_HORIZON_S}"
            )
        if not 0.0 < self.full_braking_mps2 < float("inf"):
            raise UsageError(f"full_braking_mps2 is {self.full_braking_mps2}", cure="use a positive number")


def urgency(facts: Facts, config: KinematicConfig) -> Float[Array, ""]:
    """Inverse time to collision between 0 (none within 5 s, or standing) and 1 (``urgent_s`` or less)."""
    least, most = 1.0 / TTC_HORIZON_S, 1.0 / config.urgent_s
    inverse = 1.0 / jnp.maximum(facts.ttc_s, 1e-3)
    return jnp.where(facts.ttc_defined, jnp.clip((inverse - least) / (most - least), 0.0, 1.0), 0.0)


def required_braking(
    bank: ScenarioBank, state: SimState, frame: Frame, along_m: Float[Array, ""]
) -> Float[Array, ""]:
    """Deceleration (m/s2) that avoids reaching the nearest agent on the log's own way at its present speed.

    An agent is on the way where its box reaches into the strip as wide as ego along the log's route, on ego's level,
    up to about 75 m ahead. Whom the simulator leaves out of the time to collision is left out here too. 0 where nobody
    is, or the nearest one is not approached.

    Args:
        bank: The scenarios.
        state: The driven agent.
        frame: Everyone now.
        along_m: Arc length of the driven agent along the log's route.
    """
    scene, slot = state.scene, state.scene.slot
    me, xy = frame.box[slot], frame.box[:, :2]

    def window(offset_m: float) -> Any:
        near = along_m + offset_m
        return jax.vmap(lambda point: project_on_route(bank, scene.index, point, near, route=_LOG_ROUTE))(xy)

    # Beyond the end of a window a hit is its last point, so each agent counts where it is nearest.
    first, second = map(window, _WINDOWS_M)
    nearer = first.distance_m <= second.distance_m
    hits = jax.tree.map(lambda a, b: jnp.where(nearer.reshape(-1, *(1,) * (a.ndim - 1)), a, b), first, second)
    cos = jnp.sum(frame.box[:, 2:4] * hits.heading, axis=-1)
    sin = jnp.sqrt(jnp.maximum(1.0 - cos * cos, 0.0))
    length, width = frame.box[:, 4] / 2, frame.box[:, 5] / 2
    left_out = (state.contacts == Contact.IGNORED) | (state.contacts == Contact.HIT)
    counts = frame.valid & (jnp.arange(len(xy)) != slot) & ~left_out
    counts &= jnp.abs(frame.z - frame.z[slot]) <= LEVEL_M
    on_way = hits.distance_m < jnp.abs(sin) * length + jnp.abs(cos) * width + me[5] / 2
    gap = hits.along_m - along_m - (jnp.abs(cos) * length + sin * width) - me[4] / 2
    gap = jnp.where(counts & on_way & (hits.along_m > along_m), gap, jnp.inf)
    nearest = jnp.argmin(gap)
    speed = jnp.sum(frame.velocity[nearest] * hits.heading[nearest])
    closing = jnp.maximum(state.facts.speed_mps - speed, 0.0)
    return closing * closing / (2.0 * jnp.maximum(gap[nearest], 0.1))


@partial(jax.jit, static_argnums=0)
def kinematic_steps(config: KinematicConfig, bank: ScenarioBank) -> Float[Array, "N T"]:
    """Criticality in [0, 1] of every step of every log of a bank; 0 where ego is not valid."""
    return jax.vmap(partial(_one_log, config, bank))(jnp.arange(len(bank)))


def _one_log(config: KinematicConfig, bank: ScenarioBank, index: Array) -> Float[Array, " T"]:
    simulator = Simulator(Task(ends=()))
    still = jnp.zeros(2)

    def score(state: SimState, along_m: Array) -> tuple[Array, Array]:
        frame = simulator.frame(bank, state.scene, alone(state.scene), 0)
        # No further than the car can have come, as the simulator follows its own route.
        reach_m = 1.5 * state.facts.moved_m + 2.0
        here = state.scene.history[-1, :2]
        hit = project_on_route(bank, index, here, along_m, reach_m, route=_LOG_ROUTE)
        along_m = jnp.maximum(along_m, hit.along_m)
        braking = required_braking(bank, state, frame, along_m) / config.full_braking_mps2
        value = (urgency(state.facts, config) + jnp.clip(braking, 0.0, 1.0)) / 2
        there = bank.agents[index, state.scene.step, state.scene.slot, 7] > 0
        return along_m, jnp.where(there, value, 0.0)

    def step(carry: tuple[SimState, Array], _: None) -> tuple[tuple[SimState, Array], Array]:
        state, along_m = carry
        state = simulator.replay(bank, state, logged_motion(bank, state.scene, 1), still)[0]
        along_m, value = score(state, along_m)
        return (state, along_m), value

    state = simulator.reset(bank, index, 0)
    along_m, first = score(state, jnp.zeros(()))
    _, rest = jax.lax.scan(step, (state, along_m), None, length=bank.steps - 1)
    return jnp.concatenate([first[None], rest])


def score_kinematic(
    data: ScenarioSet, config: KinematicConfig, progress: Callable[[int, int], None] | None = None
) -> Float[np.ndarray[Any, Any], "N T"]:
    """Criticality of every step of every log of a set.

    Args:
        data: The scenarios.
        config: Scales.
        progress: Called with (done, total) after every batch.

    Raises:
        DataError: A scenario has no future.
    """
    parts = []
    for first in range(0, len(data), BATCH):
        scenarios = data[first : first + BATCH]
        count = len(scenarios)
        if len(data) > BATCH:
            scenarios += [scenarios[-1]] * (BATCH - count)
        bank = ScenarioBank.from_scenarios(scenarios, trim=len(data) <= BATCH)
        parts.append(np.asarray(kinematic_steps(config, bank))[:count])
        if progress is not None:
            progress(first + count, len(data))
    return np.concatenate(parts)
