"""Arrays of a bank that belong to routes: those of all egos, their goals and logs, and the stop lines along them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from drivax.geometry.vectors import wrap
from drivax.scenario.bank.columns import NEVER_M
from drivax.scenario.schema import Flag, stack_field

_Record = Shaped[np.ndarray, ""]
_Arrays = dict[str, np.ndarray[Any, Any]]


def interleave(*columns: np.ndarray[Any, Any]) -> Float[np.ndarray, "*n column"]:
    """Interleave columns in float32; arrays with one dimension more than the last hold several columns."""
    rank = columns[-1].ndim
    flat: list[np.ndarray[Any, Any]] = []
    for values in columns:
        flat += [values] if values.ndim == rank else [values[..., i] for i in range(values.shape[-1])]
    result = np.empty((*columns[-1].shape, len(flat)), np.float32)
    for i, values in enumerate(flat):
        result[..., i] = values
    return result


def stack_routes(records: Sequence[_Record]) -> _Arrays:
    """Return routes, goals and logs of all egos ``[n, K, ...]``, and the logged paths of the recorded ones."""
    names = ("xy", "z", "heading", "limit", "lane", "points")
    *route, points = (_per_ego(records, f"route_{name}", 0) for name in names)
    *log, log_points = (stack_field(records, f"route_{name}", 1) for name in names)
    return {
        "routes": _route_columns(*route),
        "route_points": points.astype(np.int32),
        "log_routes": _route_columns(*log),
        "log_route_points": log_points.astype(np.int32),
        "goal": _per_ego(records, "goal_xy"),
        "log_progress": _per_ego(records, "log_progress"),
        **_stack_egos(records),
    }


def _route_columns(xy: Any, z: Any, heading: Any, limit: Any, lane: Any) -> Float[np.ndarray, "*n column"]:
    return interleave(xy, z, np.cos(heading), np.sin(heading), limit, lane)


def _stack_egos(records: Sequence[_Record]) -> _Arrays:
    steps, flags = (stack_field(records, name)[:, None].astype(np.int32) for name in ("steps", "flags"))
    slot, last, on_lanes = np.zeros_like(steps), steps - 1, (flags & int(Flag.ROUTE)) > 0
    if most_egos(records) > 1:
        further = [stack_field(records, f"ego_{name}") for name in ("slot", "last_step", "on_lanes")]
        pairs = zip((slot, last, on_lanes), further, strict=True)
        slot, last, on_lanes = (np.concatenate(pair, axis=1) for pair in pairs)
    xy, valid = (
        np.stack([log[f"agent_{name}"][:, egos] for log, egos in zip(records, slot, strict=True)])
        for name in ("xy", "valid")
    )
    valid &= (slot[:, None] >= 0) & (np.arange(valid.shape[1])[:, None] <= last[:, None])
    ahead = np.moveaxis(_log_ahead(xy, valid), 2, 1)
    return {"egos": slot, "last_step": last, "on_lanes": on_lanes, "log_ahead": ahead}


def _log_ahead(
    xy: Float[np.ndarray, "n time ego 2"], valid: Bool[np.ndarray, "n time ego"]
) -> Float[np.ndarray, "n time ego"]:
    """Return the distance that each logged ego drives from every step on, m; gaps of the log add nothing."""
    step_m = np.hypot(*np.moveaxis(np.diff(xy, axis=1), -1, 0)) * (valid[:, 1:] & valid[:, :-1])
    ahead = np.cumsum(step_m[:, ::-1], axis=1)[:, ::-1]
    return np.concatenate([ahead, np.zeros_like(ahead[:, :1])], axis=1)


def stack_lights(records: Sequence[_Record], count: int) -> _Arrays:
    """Return the first ``count`` stop lines and their states."""
    lights = slice(0, count)
    line = stack_field(records, "light_line", lights).astype(np.float64)
    z, heading, exit_rad, lane = (
        stack_field(records, f"light_{name}", lights) for name in ("z", "heading", "exit_heading", "lane")
    )
    middle, along = (line[..., :2] + line[..., 2:]) / 2, line[..., 2:] - line[..., :2]
    half = np.hypot(*np.moveaxis(along, -1, 0)) / 2
    right = wrap(exit_rad.astype(np.float64) - heading) < -np.pi / 4
    x, y = np.moveaxis(middle, -1, 0)
    arcs = [_stop_arcs(records, ego, lane, middle) for ego in range(most_egos(records))]
    rows = [x, y, np.cos(heading), np.sin(heading), half, z, np.cos(exit_rad), np.sin(exit_rad), right, *arcs]
    return {
        "light_line": np.stack(rows, axis=1, dtype=np.float32),
        "light_state": stack_field(records, "light_state", slice(None), lights),
    }


def _stop_arcs(
    records: Sequence[_Record], ego: int, lane: Int[np.ndarray, "n light"],
    middle: Float[np.ndarray, "n light 2"],
) -> Float[np.ndarray, "n light"]:  # fmt: skip
    """Return arc lengths (m) along an ego's route of the stop lines on its lanes; ``NEVER_M`` for all others."""
    arcs = np.full(lane.shape, NEVER_M)
    count, route_lane = (of_ego(records, f"route_{name}", ego, 0) for name in ("points", "lane"))
    on_route = np.zeros((len(records), 2 + max(int(lane.max()), int(route_lane.max()))), bool)
    on_route[np.arange(len(records))[:, None], route_lane] = True
    on_route[:, -1] = False  # the entry of -1, no lane
    on_route &= count[:, None] > 0
    scenario, light = stops = np.nonzero(on_route[np.arange(len(records))[:, None], lane])
    if len(light):
        xy, heading = (
            of_ego(records, f"route_{name}", ego, 0).astype(np.float64) for name in ("xy", "heading")
        )
        dx, dy = np.moveaxis(middle[stops][:, None] - xy[scenario], -1, 0)
        squared_m = np.where(np.arange(xy.shape[1]) < count[scenario, None], dx * dx + dy * dy, np.inf)
        point = np.argmin(squared_m, axis=1)
        nearest, course = (np.arange(len(point)), point), heading[scenario, point]
        # Route points are 1 m apart: the index of the nearest is its arc length.
        arcs[stops] = point + dx[nearest] * np.cos(course) + dy[nearest] * np.sin(course)
    return arcs


def most_egos(records: Sequence[_Record]) -> int:
    """Return the number of egos K that each record has room for."""
    return 1 + len(records[0]["ego_slot"]) if "ego_slot" in (records[0].dtype.names or ()) else 1


def of_ego(records: Sequence[_Record], name: str, ego: int, *part: int) -> np.ndarray[Any, Any]:
    """Stack a field of the k-th ego of all records.

    The field is ``name`` (or ``part`` of it) for the recorded ego, k = 0, and ``ego_name`` for further egos.
    """
    return stack_field(records, f"ego_{name}", ego - 1) if ego else stack_field(records, name, *part)


def _per_ego(records: Sequence[_Record], name: str, *part: int) -> np.ndarray[Any, Any]:
    """Stack :func:`of_ego` over all egos: ``[n, K, ...]``."""
    return np.stack([of_ego(records, name, ego, *part) for ego in range(most_egos(records))], axis=1)
