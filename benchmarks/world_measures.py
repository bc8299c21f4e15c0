"""What is measured on stored scenarios of the built-in world without driving them: arrays in, numbers out."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.signal import savgol_filter
from scipy.stats import beta

from drivax.geometry.boxes import overlap, time_to_overlap
from drivax.scenario.recording import Recording
from drivax.scenario.schema import DT_S, AgentKind, Scenario

Array = np.ndarray[Any, Any]

#: Limits of comfort (nuPlan): low and high.
LIMITS = {
    "longitudinal acceleration": (-4.05, 2.40),
    "lateral acceleration": (-4.89, 4.89),
    "longitudinal jerk": (-4.13, 4.13),
    "jerk magnitude": (-8.37, 8.37),
    "yaw rate": (-0.95, 0.95),
    "yaw acceleration": (-1.93, 1.93),
}
#: Time to collision that makes an event one, s, and how far it is looked for.
NEAR_S, HORIZON_S = 1.0, 5.0


def smoothed(values: Any, window: int, order: int, derivative: int = 0) -> Array:
    """Savitzky-Golay filter or derivative of a quantity over time."""
    return np.asarray(savgol_filter(values, window, order, deriv=derivative, delta=DT_S))


def comfort(recording: Recording) -> dict[str, tuple[float, float]]:
    """Smallest and largest value of each quantity over ego's log, with nuPlan's Savitzky-Golay windows."""
    ego = recording.ego
    speed = np.hypot(*recording.tracks.velocity[ego].T)
    return extremes(speed, recording.tracks.heading[ego])


def extremes(speed: Array, heading: Array) -> dict[str, tuple[float, float]]:
    """:func:`comfort` of speeds (m/s) and headings at 10 Hz."""
    heading = np.unwrap(heading)
    rate = smoothed(heading, 15, 2, 1)
    along = smoothed(np.gradient(speed, DT_S), 8, 2)
    aside = smoothed(speed * rate, 8, 2)
    jerk_along, jerk_aside = smoothed(along, 15, 2, 1), smoothed(aside, 15, 2, 1)
    yaw = smoothed(heading, 15, 3, 2)
    values = (along, aside, jerk_along, np.hypot(jerk_along, jerk_aside), rate, yaw)
    return {name: (float(v.min()), float(v.max())) for name, v in zip(LIMITS, values, strict=True)}


def broken_limits(scenario: Scenario) -> list[str]:
    """Names of the limits of comfort that ego's log breaks."""
    velocity = scenario.agent_velocity[:, 0].astype(np.float64)
    found = extremes(np.hypot(*velocity.T), scenario.agent_heading[:, 0].astype(np.float64))
    return [name for name, (low, high) in LIMITS.items() if found[name][0] < low or found[name][1] > high]


def everybody(scenario: Scenario) -> tuple[Array, Array, Array, Array, Array]:
    """Boxes ``[step, user, 6]``, velocities, validity, kinds and ids of moving and parked users, ego first."""
    moving = np.flatnonzero(scenario.agent_valid.any(axis=0))
    parked = np.flatnonzero(scenario.parked_valid.any(axis=0))
    steps = scenario.agent_valid.shape[0]

    def both(moves: Array, stands: Array) -> Array:
        stands = np.broadcast_to(stands, (steps, *stands.shape))
        return np.concatenate((moves, stands), axis=1).astype(np.float64)

    heading = both(scenario.agent_heading[:, moving], scenario.parked_heading[parked])
    xy = both(scenario.agent_xy[:, moving], scenario.parked_xy[parked])
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
    velocity = both(scenario.agent_velocity[:, moving], np.zeros((len(parked), 2)))
    valid = np.concatenate((scenario.agent_valid[:, moving], scenario.parked_valid[:, parked]), axis=1)
    kind = np.concatenate((scenario.agent_kind[moving], scenario.parked_kind[parked]))
    number = np.concatenate((scenario.agent_id[moving], scenario.parked_id[parked]))
    return box, velocity, valid, kind, number


def overlapping_pairs(scenario: Scenario) -> int:
    """Pairs of vehicles, ego left out, whose boxes overlap at some step."""
    box, _, valid, kind, _ = everybody(scenario)
    vehicles = np.flatnonzero((kind == AgentKind.VEHICLE) & (np.arange(len(kind)) > 0))
    first, second = np.triu_indices(len(vehicles), 1)
    first, second = vehicles[first], vehicles[second]
    both = valid[:, first] & valid[:, second]
    return int((overlap(box[:, first], box[:, second]) & both).any(axis=0).sum())


def constant_speed_ttc_s(scenario: Scenario) -> float:
    """Smallest time to collision with the labelled actors of an ego that keeps its speed from the event on.

    It starts at the event's first step, with the speed that it has then, and goes on along the way that the log
    takes, and the log's route beyond its end. Time to collision is that of boxes at constant velocity; 0 where they
    overlap.
    """
    start, actors = int(scenario.event_start[0]), scenario.event_actor[0]
    box, velocity, valid, _, number = everybody(scenario)
    rows = np.flatnonzero(np.isin(number, actors[actors >= 0]))
    way = _way(scenario, start)
    speed = float(np.hypot(*scenario.agent_velocity[start, 0]))
    steps = np.arange(start, len(box))
    along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(way, axis=0).T))))
    at = np.minimum((steps - start) * DT_S * speed, along[-1] - 1e-3)
    xy = np.stack([np.interp(at, along, way[:, k]) for k in range(2)], axis=-1)
    ahead = np.stack([np.interp(at + 0.5, along, way[:, k]) for k in range(2)], axis=-1) - xy
    turned = np.arctan2(ahead[:, 1], ahead[:, 0])
    heading = np.where(np.hypot(*ahead.T) > 0.1, turned, scenario.agent_heading[start, 0])
    direction = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    size = np.broadcast_to(box[start, 0, 4:6], (len(steps), 2))
    ego = np.concatenate([xy, direction, size], axis=-1)[:, None]
    time = time_to_overlap(
        ego, (speed * direction)[:, None], box[steps][:, rows], velocity[steps][:, rows], HORIZON_S
    )
    return float(np.where(valid[steps][:, rows], time, HORIZON_S).min(initial=HORIZON_S))


def _way(scenario: Scenario, start: int) -> Array:
    """Points of the log from a step on, at least 5 cm apart, and of the log's route beyond its end."""
    log = scenario.agent_xy[start:, 0].astype(np.float64)
    moved = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(log, axis=0).T))))
    log = log[np.unique((moved / 0.05).astype(np.int64), return_index=True)[1]]
    count = int(scenario.route_points[1])
    route = scenario.route_xy[1, :count].astype(np.float64)
    nearest = int(np.hypot(*(route - log[-1]).T).argmin())
    return np.concatenate((log, route[nearest + 2 :]))


def binomial(successes: int, trials: int) -> tuple[float, float]:
    """Clopper and Pearson's 95 % interval of a share."""
    if not trials:
        return 0.0, 1.0
    low = 0.0 if successes == 0 else float(beta.ppf(0.025, successes, trials - successes + 1))
    high = 1.0 if successes == trials else float(beta.ppf(0.975, successes + 1, trials - successes))
    return low, high


def share(successes: int, trials: int) -> dict[str, float | int]:
    """A share with its interval, for tables and JSON."""
    low, high = binomial(successes, trials)
    return {"share": successes / trials if trials else math.nan, "low": low, "high": high, "n": trials}
