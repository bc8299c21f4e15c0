"""One episode packed for the player: whole numbers of centimetres in base64, a few tens of kilobytes.

The page decodes what :func:`pack_episode` writes; the layout is described there and tested against the arrays.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from drivax.metrics.catalogue import EVENTS
from drivax.report.charts.motion import COMMANDED, COMMANDS, SIGNALS, Signal, signals
from drivax.report.pictures.palette import agent_colour, light_colour
from drivax.report.pictures.roads import LAYERS, Box, light_rows, road_lines, route, stop_signs
from drivax.scenario.schema import Scenario

Array = np.ndarray[Any, Any]
#: Map and agents further than this from every ego path are left out, metres.
MARGIN_M = 90.0
#: Stands for "not there" in a packed pose.
ABSENT = -32768
_RADIAN = 10_000
_LIGHTS = ("unknown", "red", "amber", "green")


@dataclass(frozen=True)
class Drive:
    """What one planner did in a scenario.

    Attributes:
        planner: Its name.
        ego: Position [m], heading [rad], speed [m/s] at every step, local frame; NaN where the car is gone.
        start: Step at which the planner took over.
        events: Step of the first event by name, -1 where there was none.
        outcome: How it ended, in words.
        action: The first two numbers of its actions, NaN where there are none; None where nobody acted (the log).
        others: Place [m] and heading [rad] of every agent where traffic reacted, NaN where it is not there; None where
            they are as recorded.
    """

    planner: str
    ego: Float[Array, "step 4"]
    start: int
    events: dict[str, int]
    outcome: str
    action: Float[Array, "step 2"] | None = None
    others: Float[Array, "step agent 3"] | None = None


def as_driven(scenario: Scenario, drive: Drive) -> Scenario:
    """The scenario with all but ego where they were in this drive, from where its planner took over."""
    if drive.others is None:
        return scenario
    pose = drive.others[drive.start :]
    steps, known = slice(drive.start, drive.start + len(pose)), slice(1, pose.shape[1])
    there = np.asarray(np.isfinite(pose[:, known]).all(axis=-1))
    found = np.where(there[..., None], pose[:, known], 0.0)
    record = scenario.record.copy()
    record["agent_valid"][steps, 1:] = False
    record["agent_valid"][steps, known] = there
    record["agent_xy"][steps, known], record["agent_heading"][steps, known] = found[..., :2], found[..., 2]
    return replace(scenario, record=record)


@dataclass(frozen=True)
class Scale:
    """Metres -> int16: ``round((metres - centre) / unit)``; the unit is 1 cm unless the drive is too long for it."""

    centre: tuple[float, float]
    unit_m: float

    @classmethod
    def of(cls, box: Box) -> Scale:
        """The scale that holds a box and 10 m around it."""
        low, high = np.array(box[:2]), np.array(box[2:])
        centre = (low + high) / 2
        reach = float((high - low).max()) / 2 + 10.0
        return cls((round(float(centre[0]), 2), round(float(centre[1]), 2)), max(0.01, reach / 32_000))

    def points(self, xy: Array) -> Array:
        """Points ``[..., 2]`` as int16."""
        return np.round((np.asarray(xy, np.float64) - self.centre) / self.unit_m).astype(np.int16)

    def lengths(self, metres: Array) -> Array:
        """Lengths as int16."""
        return np.round(np.asarray(metres, np.float64) / self.unit_m).astype(np.int16)

    def poses(self, xy: Array, heading: Array, valid: Bool[Array, "..."]) -> Array:
        """Poses ``[..., 3]`` as int16: position and heading in 1e-4 rad; ABSENT where not valid."""
        packed = np.full((*valid.shape, 3), ABSENT, np.int16)
        packed[valid, :2] = self.points(xy[valid])
        angle = (np.asarray(heading[valid], np.float64) + np.pi) % (2 * np.pi) - np.pi
        packed[valid, 2] = np.round(angle * _RADIAN).astype(np.int16)
        return packed


def pack_episode(scenario: Scenario, drives: Sequence[Drive], title: str) -> dict[str, Any]:
    """One scenario and what each planner did in it, as JSON values.

    Arrays are little-endian int16 in base64, in C order. ``map`` holds per layer the number of points of each line
    and the points of all lines; ``agents.pose`` is ``[agent, step, 3]``; ``parked.seen`` the first and last step at
    which a parked agent was seen; ``lights.state`` ``[step, light]`` indexes (unknown, red, amber, green) and is -1
    where nobody observed the light; ``drives[].pose`` is ``[step, 3]``, ``speed`` is in cm/s, and ``signals`` are those
    of ``motion.SIGNALS`` and ``motion.COMMANDS`` in order, in units of their steps, ABSENT where there are none.
    Others are shown as they were in the last of the drives.
    """
    scenario = as_driven(scenario, drives[-1])
    box = surroundings(scenario, drives)
    scale = Scale.of(box)
    steps = int(scenario.steps)
    return {
        "title": title,
        "id": scenario.id,
        "steps": steps,
        "dt": round(float(scenario.dt_s), 4) or 0.1,
        "unit": scale.unit_m,
        "centre": scale.centre,
        "map": {name: _lines(scale, lines) for name, lines in road_lines(scenario, box).items()},
        "layers": LAYERS,
        "stops": _text(scale.points(_inside(stop_signs(scenario), box))),
        "route": _text(scale.points(_inside(route(scenario), box))),
        "goal": _text(scale.points(_inside(np.asarray(scenario.goal_xy)[None], box))),
        "agents": _agents(scenario, scale, box, steps),
        "parked": _parked(scenario, scale, box, steps),
        "lights": _light_states(scenario, scale, box, steps),
        "log": _text(_logged_ego(scenario, scale, steps)),
        "size": [round(float(length), 2) for length in scenario.agent_size[0, :2]],
        "drives": [_drive(drive, scale, steps) for drive in drives],
    }


def _text(array: Array) -> str:
    kind = "<i2" if array.dtype == np.int16 else "i1"
    return base64.b64encode(np.ascontiguousarray(array, dtype=kind).tobytes()).decode("ascii")


def surroundings(scenario: Scenario, drives: Sequence[Drive]) -> Box:
    """What is near any ego path, in metres: their bounding box and a margin."""
    paths = [scenario.agent_xy[:, 0][scenario.agent_valid[:, 0]]]
    paths += [drive.ego[np.isfinite(drive.ego).all(axis=1), :2] for drive in drives]
    points = np.concatenate(paths).astype(np.float64)
    low, high = points.min(axis=0) - MARGIN_M, points.max(axis=0) + MARGIN_M
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def _within(xy: Array, box: Box) -> Bool[Array, "..."]:
    return np.all((xy >= box[:2]) & (xy <= box[2:]), axis=-1)


def _inside(xy: Array, box: Box) -> Array:
    return xy[_within(xy, box)]


def _lines(scale: Scale, lines: Sequence[Array]) -> dict[str, str]:
    counts = np.array([len(line) for line in lines], np.int16)
    points = scale.points(np.concatenate(lines)) if lines else np.zeros((0, 2), np.int16)
    return {"counts": _text(counts), "points": _text(points)}


def _agents(scenario: Scenario, scale: Scale, box: Box, steps: int) -> dict[str, Any]:
    """Everyone that moves but the ego, as long as near enough."""
    xy = scenario.agent_xy[:steps, 1:]
    near = scenario.agent_valid[:steps, 1:] & _within(xy, box)
    keep = near.any(axis=0)
    poses = scale.poses(xy[:, keep], scenario.agent_heading[:steps, 1:][:, keep], near[:, keep])
    return {
        "kind": [agent_colour(int(kind)) for kind in scenario.agent_kind[1:][keep]],
        "size": _text(scale.lengths(scenario.agent_size[1:][keep][:, :2])),
        "pose": _text(poses.swapaxes(0, 1)),
    }


def _parked(scenario: Scenario, scale: Scale, box: Box, steps: int) -> dict[str, Any]:
    seen = scenario.parked_valid[:steps]
    keep = seen.any(axis=0) & _within(scenario.parked_xy, box)
    seen = seen[:, keep]
    last = steps - 1 - seen[::-1].argmax(axis=0) if seen.size else np.zeros(0)
    poses = scale.poses(
        scenario.parked_xy[keep], scenario.parked_heading[keep], np.ones(int(keep.sum()), bool)
    )
    kinds = [agent_colour(int(kind)) for kind in scenario.parked_kind[keep]]
    return {
        "kind": ["parked" if kind == "vehicle" else kind for kind in kinds],
        "size": _text(scale.lengths(scenario.parked_size[keep][:, :2])),
        "pose": _text(poses),
        "seen": _text(
            np.stack((seen.argmax(axis=0) if seen.size else np.zeros(0), last), -1).astype(np.int16)
        ),
    }


def _light_states(scenario: Scenario, scale: Scale, box: Box, steps: int) -> dict[str, str]:
    rows = light_rows(scenario)
    lines = scenario.light_line[rows].reshape(-1, 2, 2)
    rows, lines = rows[_within(lines[:, 0], box)], lines[_within(lines[:, 0], box)]
    states = scenario.light_state[:steps, rows]
    codes = np.full(states.shape, -1, np.int8)
    for state in np.unique(states[states >= 0]):
        codes[states == state] = _LIGHTS.index(light_colour(int(state)))
    return {"line": _text(scale.points(lines)), "state": _text(codes)}


def _logged_ego(scenario: Scenario, scale: Scale, steps: int) -> Array:
    return scale.poses(
        scenario.agent_xy[:steps, 0], scenario.agent_heading[:steps, 0], scenario.agent_valid[:steps, 0]
    )


def _drive(drive: Drive, scale: Scale, steps: int) -> dict[str, Any]:
    ego = np.asarray(drive.ego, np.float64)[:steps]
    valid = np.asarray(np.isfinite(ego).all(axis=1))
    speed = np.clip(np.round(np.where(valid, ego[:, 3], 0.0) * 100), -32_000, 32_000)
    return {
        "planner": drive.planner,
        "pose": _text(scale.poses(ego[:, :2], ego[:, 2], valid)),
        "speed": _text(speed.astype(np.int16)),
        "signals": _signals(ego, drive.action),
        "start": drive.start,
        "events": {
            name: drive.events[name] for name in (*EVENTS, "crashed") if drive.events.get(name, -1) >= 0
        },
        "outcome": drive.outcome,
    }


def _signals(ego: Float[Array, "step 4"], action: Float[Array, "step 2"] | None) -> list[str]:
    found = signals(ego)
    asked = np.full((len(ego), COMMANDED), np.nan) if action is None else action[: len(ego)]
    packed = [_signal(one, found[one.name]) for one in SIGNALS]
    return packed + [_signal(one, values) for one, values in zip(COMMANDS, asked.T, strict=True)]


def _signal(one: Signal, values: Float[Array, " step"]) -> str:
    whole = np.clip(np.round(values / one.step), -32_000, 32_000)
    return _text(np.where(np.isnan(whole), ABSENT, whole).astype(np.int16))
