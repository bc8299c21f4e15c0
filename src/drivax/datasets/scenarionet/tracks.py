"""The tracks of a ScenarioNet file, whatever shapes and types its converter gave the states."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from drivax.datasets import parsing
from drivax.datasets.scenarionet.values import SKIP, Names, count_rows, floats, mapping
from drivax.errors import DataError
from drivax.geometry.vectors import wrap
from drivax.scenario.recording import Tracks
from drivax.scenario.schema import AgentKind

Array = np.ndarray[Any, Any]

MOST_STATES = 1_000_000
_KINDS = {
    "VEHICLE": AgentKind.VEHICLE,
    "PEDESTRIAN": AgentKind.PEDESTRIAN,
    "CYCLIST": AgentKind.CYCLIST,
    "TRAFFIC_CONE": AgentKind.STATIC,
    "TRAFFIC_BARRIER": AgentKind.STATIC,
    "TRAFFIC_OBJECT": AgentKind.STATIC,
}
#: State, columns that it may have, whether every track must have it.
_STATES = (
    ("position", (2, 3), True),
    ("heading", (1,), True),
    ("velocity", (2, 3), False),
    ("length", (1,), False),
    ("width", (1,), False),
    ("height", (1,), False),
    ("valid", (1,), False),
)
#: Largest numbers that a recorded state can hold: metres of a map frame, radians, m/s, metres of a box.
_LIMITS = {"position": 1e7, "heading": 1e4, "velocity": 1e3, "length": 1e3, "width": 1e3, "height": 1e3}
#: A last step of more than this is motion.
_MOVED_M = 0.05


def read_tracks(table: Mapping[str, Any], names: Names, ego: int) -> Tracks:
    """Reads ``tracks``. Invalid states become zeros; a velocity that the file lacks is zero.

    Args:
        table: Tracks by name, in order.
        names: Their numbers.
        ego: Row of the ego.
    """
    bodies = [
        (f"track {name[:40]!r}", mapping({"": body}, "", f"tracks[{name[:40]!r}]"))
        for name, body in table.items()
    ]
    states = [mapping(body, "state", what) for what, body in bodies]
    steps = count_rows(states[ego].get("position"))
    if steps == 0 or steps * len(states) > MOST_STATES:
        raise DataError(f"{len(states)} tracks of {steps} steps", cure=SKIP)
    stacked = {name: np.zeros((len(states), steps, columns[-1])) for name, columns, _ in _STATES}
    for row, ((what, _), state) in enumerate(zip(bodies, states, strict=True)):
        for name, columns, needed in _STATES:
            values = _series(state, name, columns, steps, what)
            if values is not None:
                stacked[name][row, :, : values.shape[1]] = values
            elif needed:
                raise DataError(f"{what} has no {name}", cure=SKIP)
            elif name == "valid":
                stacked[name][row] = 1.0
    valid = stacked["valid"][..., 0] > 0.5
    for name, limit in _LIMITS.items():
        stacked[name][~valid] = 0.0
        parsing.check_within(limit, stacked[name])
    size = np.concatenate([stacked[name] for name in ("length", "width", "height")], axis=-1)
    return Tracks(
        xy=stacked["position"][..., :2].copy(),
        z=stacked["position"][..., 2].copy(),
        heading=np.where(valid, wrap(stacked["heading"][..., 0]), 0.0),
        velocity=stacked["velocity"][..., :2].copy(),
        size=_long_ego(size, ego),
        valid=valid,
        kind=np.array([_kind(body) for _, body in bodies], np.int8),
        track_id=np.array([names.get(name) for name in table], np.int64),
    )


def _series(
    state: Mapping[Any, Any], name: str, columns: tuple[int, ...], steps: int, what: str
) -> Array | None:
    """One state of one track as ``[time, column]``; None where it is missing."""
    given = state.get(name)
    if given is None:
        return None
    if count_rows(given) != steps:
        raise DataError(f"{what} has {count_rows(given)} values of {name}, {steps} steps", cure=SKIP)
    values = floats(given, f"{what}: {name}")
    values = values[:, None] if values.ndim == 1 else values
    if values.ndim != 2 or values.shape[1] not in columns:
        raise DataError(f"{what} has a {name} of shape {values.shape}", cure=SKIP)
    return values


def _kind(body: Mapping[Any, Any]) -> AgentKind:
    kind = body.get("type")
    return _KINDS.get(kind, AgentKind.OTHER) if isinstance(kind, str) else AgentKind.OTHER


def _long_ego(size: Array, ego: int) -> Array:
    """Sizes with the ego's length and width in their places: nuScenes files have a car 1.73 m long and 4.08 m wide."""
    own = size[ego].max(axis=0)
    if own[0] < own[1]:
        size[ego] = size[ego][:, [1, 0, 2]]
    return size


def velocity_is_missing(tracks: Tracks) -> bool:
    """Whether velocities are differences that were zeroed where tracks end, or are not there at all.

    In nuScenes files the velocity is zero at the last valid step, and before every gap, of everything that moves.
    """
    rows = np.arange(len(tracks.valid))
    last = tracks.valid.shape[1] - 1 - np.argmax(tracks.valid[:, ::-1], axis=1)
    before = np.maximum(last - 1, 0)
    moved = np.hypot(*(tracks.xy[rows, last] - tracks.xy[rows, before]).T) > _MOVED_M
    moved &= tracks.valid[rows, last] & tracks.valid[rows, before] & (last > before)
    still = ~tracks.velocity[rows, last].any(axis=1)
    return bool((moved & still).sum() * 2 > moved.sum())
