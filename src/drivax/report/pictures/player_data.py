"""Data of one episode for the player: integer centimetres in base64, a few tens of kilobytes."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from drivax.report.charts import COMMANDS, SIGNALS, Signal, signals
from drivax.report.pictures.drawing import (
    EVENT_WORDS,
    LAYERS,
    AgentBoxes,
    Box,
    Drawing,
    Rollout,
    replace_traffic,
    surroundings,
)
from drivax.scenario.schema import Scenario

Array = np.ndarray[Any, Any]
#: Marks an absent pose or value.
ABSENT = -32768
#: Packed units per radian, and largest packed value, close to that of int16.
_PER_RADIAN, _MAX_VALUE = 10_000, 32_000


@dataclass(frozen=True)
class Scale:
    """Metres -> int16: ``round((metres - centre) / unit)``; the unit is 1 cm, or more for very long episodes."""

    centre: tuple[float, float]
    unit_m: float

    @classmethod
    def of(cls, box: Box) -> Scale:
        """Return the scale that holds a box and 10 m around it."""
        low, high = np.array(box[:2]), np.array(box[2:])
        centre = (low + high) / 2
        reach_m = float((high - low).max()) / 2 + 10.0
        return cls((round(float(centre[0]), 2), round(float(centre[1]), 2)), max(0.01, reach_m / _MAX_VALUE))

    def points(self, xy: Array) -> Array:
        """Return points ``[..., 2]`` as int16."""
        return np.round((np.asarray(xy, np.float64) - self.centre) / self.unit_m).astype(np.int16)

    def lengths(self, metres: Array) -> Array:
        """Return lengths as int16."""
        return np.round(np.asarray(metres, np.float64) / self.unit_m).astype(np.int16)

    def poses(self, xy: Array, heading: Array, valid: Bool[Array, "..."]) -> Array:
        """Return poses ``[..., 3]`` as int16: position, and heading in 1e-4 rad; ABSENT where not valid."""
        result = np.full((*valid.shape, 3), ABSENT, np.int16)
        result[valid, :2] = self.points(xy[valid])
        angle = (np.asarray(heading[valid], np.float64) + np.pi) % (2 * np.pi) - np.pi
        result[valid, 2] = np.round(angle * _PER_RADIAN).astype(np.int16)
        return result


def pack_episode(scenario: Scenario, rollouts: Sequence[Rollout], title: str) -> dict[str, Any]:
    """Return one scenario and its rollouts as JSON values.

    Arrays are little-endian int16 (``lights.state``: int8) in base64, in C order. Other agents move as in the last
    rollout.

    - ``map``: by layer, the number of points of each line and the points of all lines.
    - ``agents.pose``: ``[agent, step, 3]``.
    - ``parked.seen``: the first and last step at which a parked agent was seen.
    - ``lights.state``: ``[step, light]``, indices of ``LIGHTS``, -1 where unobserved.
    - ``rollouts[].pose``: ``[step, 3]``; ``speed`` is in cm/s, 0 where ego is absent.
    - ``rollouts[].signals``: ``charts.SIGNALS`` and ``charts.COMMANDS`` in units of their steps, ABSENT where missing.
    """
    scenario = replace_traffic(scenario, rollouts[-1])
    box = surroundings(scenario, rollouts)
    scale, drawing = Scale.of(box), Drawing.of(scenario, box)
    return {
        "title": title,
        "id": scenario.id,
        "steps": int(scenario.steps),
        "dt": round(float(scenario.dt_s), 4),
        "unit": scale.unit_m,
        "centre": scale.centre,
        "map": {name: _lines(scale, drawing.layers[name]) for name in LAYERS},
        "layers": LAYERS,
        "stops": _encode(scale.points(drawing.stops)),
        "route": _encode(scale.points(drawing.route)),
        "goal": _encode(scale.points(drawing.goal)),
        "agents": _boxes(scale, drawing.agents, _poses(scale, drawing.agents).swapaxes(0, 1)),
        "parked": _parked_entries(scale, drawing.parked),
        "lights": {"line": _encode(scale.points(drawing.light_line)), "state": _encode(drawing.light_state)},
        "log": _encode(_poses(scale, drawing.log)[:, 0]),
        "size": [round(float(length), 2) for length in drawing.log.size[0]],
        "rollouts": [_rollout(rollout, scale, int(scenario.steps)) for rollout in rollouts],
    }


def _encode(array: Array) -> str:
    """Return int16, or smaller integers as int8, in base64."""
    dtype = "<i2" if array.dtype == np.int16 else "i1"
    return base64.b64encode(np.ascontiguousarray(array, dtype=dtype).tobytes()).decode("ascii")


def _lines(scale: Scale, lines: Sequence[Array]) -> dict[str, str]:
    counts = np.array([len(line) for line in lines], np.int16)
    points = scale.points(np.concatenate(lines)) if lines else np.zeros((0, 2), np.int16)
    return {"counts": _encode(counts), "points": _encode(points)}


def _poses(scale: Scale, boxes: AgentBoxes) -> Array:
    return scale.poses(boxes.xy, boxes.heading, boxes.valid)


def _boxes(scale: Scale, boxes: AgentBoxes, poses: Array) -> dict[str, Any]:
    return {
        "kind": list(boxes.colour), "size": _encode(scale.lengths(boxes.size)), "pose": _encode(poses)
    }  # fmt: skip


def _parked_entries(scale: Scale, parked: AgentBoxes) -> dict[str, Any]:
    """Return parked agents with one pose each, and the first and last step at which they are present."""
    valid = parked.valid
    poses = scale.poses(parked.xy[0], parked.heading[0], np.ones(len(parked.size), bool))
    first, last = valid.argmax(axis=0), len(valid) - 1 - valid[::-1].argmax(axis=0)
    return _boxes(scale, parked, poses) | {"seen": _encode(np.stack((first, last), -1).astype(np.int16))}


def _rollout(rollout: Rollout, scale: Scale, steps: int) -> dict[str, Any]:
    ego = np.asarray(rollout.ego, np.float64)[:steps]
    valid = np.asarray(np.isfinite(ego).all(axis=1))
    speed = np.clip(np.round(np.where(valid, ego[:, 3], 0.0) * 100), -_MAX_VALUE, _MAX_VALUE)
    return {
        "planner": rollout.planner,
        "pose": _encode(scale.poses(ego[:, :2], ego[:, 2], valid)),
        "speed": _encode(speed.astype(np.int16)),
        "signals": _signals(ego, rollout.action),
        "start": rollout.start,
        "events": {name: rollout.events[name] for name in EVENT_WORDS if rollout.events.get(name, -1) >= 0},
        "outcome": rollout.outcome,
    }


def _signals(ego: Float[Array, "step 4"], action: Float[Array, "step 2"] | None) -> list[str]:
    values = signals(ego)
    commands = np.full((len(ego), len(COMMANDS)), np.nan) if action is None else action[: len(ego)]
    encoded_signals = [_signal(signal, values[signal.name]) for signal in SIGNALS]
    return encoded_signals + [
        _signal(signal, column) for signal, column in zip(COMMANDS, commands.T, strict=True)
    ]


def _signal(signal: Signal, values: Float[Array, " step"]) -> str:
    rounded = np.clip(np.round(values / signal.step), -_MAX_VALUE, _MAX_VALUE)
    return _encode(np.where(np.isnan(rounded), ABSENT, rounded).astype(np.int16))
