"""Statistics of stored scenarios of the built-in world, without simulation."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.stats import beta

from drivax.geometry.boxes import overlap, time_to_overlap
from drivax.scenario.schema import DT_S, AgentKind, Scenario
from drivax.synthetic.expert.violations import broken_limits
from drivax.synthetic.sensing import NoiseConfig, largest_shift_m

Array = np.ndarray[Any, Any]

#: Time to collision of a near miss, and horizon of its computation, s.
NEAR_S, HORIZON_S = 1.0, 5.0


def violated_limits(scenario: Scenario) -> tuple[str, ...]:
    """Return the names of the comfort limits that ego's log violates."""
    speed = np.hypot(*scenario.agent_velocity[:, 0].astype(np.float64).T)
    return broken_limits(scenario.agent_heading[:, 0].astype(np.float64), speed)


def all_agents(scenario: Scenario) -> tuple[Array, Array, Array, Array, Array]:
    """Return boxes ``[step, agent, 6]``, velocities, validity, kinds and ids of all agents, ego first."""
    moving = np.flatnonzero(scenario.agent_valid.any(axis=0))
    parked = np.flatnonzero(scenario.parked_valid.any(axis=0))
    steps = scenario.agent_valid.shape[0]

    def concatenate(moving_values: Array, parked_values: Array) -> Array:
        parked_values = np.broadcast_to(parked_values, (steps, *parked_values.shape))
        return np.concatenate((moving_values, parked_values), axis=1).astype(np.float64)

    heading = concatenate(scenario.agent_heading[:, moving], scenario.parked_heading[parked])
    xy = concatenate(scenario.agent_xy[:, moving], scenario.parked_xy[parked])
    size = np.concatenate((scenario.agent_size[moving], scenario.parked_size[parked]))[:, :2]
    box = np.concatenate(
        [
            xy,
            np.cos(heading)[..., None],
            np.sin(heading)[..., None],
            np.broadcast_to(size, (steps, *size.shape)),
        ],
        axis=-1,
    )
    velocity = concatenate(scenario.agent_velocity[:, moving], np.zeros((len(parked), 2)))
    valid = np.concatenate((scenario.agent_valid[:, moving], scenario.parked_valid[:, parked]), axis=1)
    kind = np.concatenate((scenario.agent_kind[moving], scenario.parked_kind[parked]))
    ids = np.concatenate((scenario.agent_id[moving], scenario.parked_id[parked]))
    return box, velocity, valid, kind, ids


def count_overlapping_pairs(scenario: Scenario) -> int:
    """Count the pairs of vehicles other than ego whose boxes overlap at some step."""
    box, _, valid, kind, _ = all_agents(scenario)
    vehicles = np.flatnonzero((kind == AgentKind.VEHICLE) & (np.arange(len(kind)) > 0))
    first, second = np.triu_indices(len(vehicles), 1)
    first, second = vehicles[first], vehicles[second]
    pair_valid = valid[:, first] & valid[:, second]
    return int((overlap(box[:, first], box[:, second]) & pair_valid).any(axis=0).sum())


def constant_speed_ttc_s(scenario: Scenario) -> float:
    """Return the smallest time to collision with the event's actors if ego keeps its speed from the event on.

    From the event's first step on, ego keeps its speed and its lateral offset from the route (the logged path may
    already avoid the actor). Boxes move at constant velocity; the time of overlapping boxes is 0.
    """
    start, actors = int(scenario.event_start[0]), scenario.event_actor[0]
    box, velocity, valid, _, ids = all_agents(scenario)
    rows = np.flatnonzero(np.isin(ids, actors[actors >= 0]))
    path = _path_ahead(scenario, start)
    speed = float(np.hypot(*scenario.agent_velocity[start, 0]))
    steps = np.arange(start, len(box))
    arc_m = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))))
    travelled_m = np.minimum((steps - start) * DT_S * speed, arc_m[-1] - 1e-3)
    xy = np.stack([np.interp(travelled_m, arc_m, path[:, k]) for k in range(2)], axis=-1)
    ahead = np.stack([np.interp(travelled_m + 0.5, arc_m, path[:, k]) for k in range(2)], axis=-1) - xy
    path_heading = np.arctan2(ahead[:, 1], ahead[:, 0])
    heading = np.where(np.hypot(*ahead.T) > 0.1, path_heading, scenario.agent_heading[start, 0])
    direction = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    size = np.broadcast_to(box[start, 0, 4:6], (len(steps), 2))
    ego = np.concatenate([xy, direction, size], axis=-1)[:, None]
    time = time_to_overlap(
        ego, (speed * direction)[:, None], box[steps][:, rows], velocity[steps][:, rows], HORIZON_S
    )
    return float(np.where(valid[steps][:, rows], time, HORIZON_S).min(initial=HORIZON_S))


def _path_ahead(scenario: Scenario, start: int) -> Array:
    """Return points of the route ahead of ego, at ego's lateral offset."""
    count = int(scenario.route_points[0])
    route = scenario.route_xy[0, :count].astype(np.float64)
    heading = scenario.route_heading[0, :count].astype(np.float64)
    normal = np.stack([-np.sin(heading), np.cos(heading)], axis=-1)
    ego = scenario.agent_xy[start, 0].astype(np.float64)
    nearest = int(np.hypot(*(route - ego).T).argmin())
    lateral = float((ego - route[nearest]) @ normal[nearest])
    return np.concatenate((ego[None], (route + lateral * normal)[nearest + 1 :]))


def binomial(successes: int, trials: int, level: float = 0.95) -> tuple[float, float]:
    """Return the Clopper-Pearson interval of a share."""
    if not trials:
        return 0.0, 1.0
    tail = (1.0 - level) / 2
    low = 0.0 if successes == 0 else float(beta.ppf(tail, successes, trials - successes + 1))
    high = 1.0 if successes == trials else float(beta.ppf(1.0 - tail, successes + 1, trials - successes))
    return low, high


def share(successes: int, trials: int) -> dict[str, Any]:
    """Return a share with its 95 % interval, for tables and JSON."""
    low, high = binomial(successes, trials)
    return {"share": successes / trials if trials else math.nan, "low": low, "high": high, "n": trials}


def compare_share(configured: float, successes: int, trials: int, comparisons: int) -> dict[str, Any]:
    """Compare a share with its configured probability.

    ``outside`` is True if the configured value is outside Bonferroni's interval, of level 1 - 0.05 / comparisons;
    ``outside_95`` if it is outside the 95 % interval, as in one of twenty comparisons by chance.
    """
    result = share(successes, trials)
    low, high = binomial(successes, trials, 1.0 - 0.05 / comparisons)
    return {
        **result,
        "configured": configured,
        "outside_95": not result["low"] <= configured <= result["high"],
        "outside": not low <= configured <= high,
    }


def largest_noise_m(scenario: Scenario, config: NoiseConfig) -> float:
    """Return the largest displacement of an agent's corner by perception noise in a scenario."""
    sizes = scenario.agent_size[1:][scenario.agent_valid[:, 1:].any(axis=0), :2]
    return max((largest_shift_m(config, float(length), float(width)) for length, width in sizes), default=0.0)
