"""Sizes of a bank's arrays: a whole capacity, or as much of it as some scenarios use."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from drivax.errors import DrivaxError
from drivax.scenario.schema import Capacity, Scenario

#: Sizes are multiples of this, so that banks of similar scenarios share programs.
_MULTIPLE = 8


@dataclass(frozen=True)
class Sizes:
    """How much of each axis is kept; banks of the same sizes run the same compiled programs.

    Attributes:
        agents: Moving agents.
        slots: Slots of a frame: moving and parked agents.
        lights: Stop lines.
        edges, lanes: Segments of road edges and of car lanes.
        edge_run, lane_run: Longest run of a row of three grid cells.
        graphs: Lanes of the graph.
        road: Pieces of road to observe.
        long_ego: Whether some ego reaches further than the grid's guarantee from its centre.
    """

    agents: int
    slots: int
    lights: int
    edges: int
    lanes: int
    edge_run: int
    lane_run: int
    graphs: int
    road: int
    long_ego: bool

    @classmethod
    def whole(cls, capacity: Capacity) -> Sizes:
        """All of a capacity."""
        return cls(
            agents=capacity.agents,
            slots=capacity.agents + capacity.parked,
            lights=capacity.lights,
            edges=capacity.segments,
            lanes=capacity.segments,
            edge_run=capacity.edge_run,
            lane_run=capacity.lane_run,
            graphs=capacity.lanes,
            road=capacity.road_rows,
            long_ego=False,
        )

    @classmethod
    def used(cls, scenarios: Iterable[Scenario]) -> Sizes:
        """As much as scenarios of one capacity use.

        Raises:
            DrivaxError: There are none.
        """
        found = [_needed(scenario) for scenario in scenarios]
        if not found:
            raise DrivaxError("a bank needs at least one scenario", cure="check the set and its filters")
        return cls(*(max(getattr(one, field.name) for one in found) for field in fields(cls)))


def last_used(mask: Any) -> np.ndarray[Any, Any]:
    """One more than the last column that each row of ``mask [N, columns]`` uses."""
    return np.where(mask.any(1), mask.shape[1] - np.argmax(mask[:, ::-1], axis=1), 0)


def _needed(scenario: Scenario) -> Sizes:
    capacity, record = scenario.capacity, scenario.record
    masks = {
        "agents": record["agent_valid"].any(0), "parked": record["parked_valid"].any(0),
        "lights": (record["light_state"] >= 0).any(0), "graphs": record["lane_length"] > 0,
    }  # fmt: skip
    ends = {name: int(last_used(np.asarray(mask)[None])[0]) for name, mask in masks.items()}
    agents = max(1, _rounded(ends["agents"], capacity.agents))
    slots = _rounded(ends["agents"] + ends["parked"], capacity.agents + capacity.parked)
    _, edges, segments = (int(number) for number in record["segment_blocks"][:3])
    half_m = float(np.hypot(*record["agent_size"][0, :2])) / 2
    return Sizes(
        agents=agents,
        slots=max(slots, agents),
        lights=max(1, _rounded(ends["lights"], capacity.lights)),
        edges=edges,
        lanes=segments - edges,
        edge_run=_longest_run(record["grid_edge"], capacity.grid),
        lane_run=_longest_run(record["grid_lane"], capacity.grid),
        graphs=max(1, _rounded(ends["graphs"], capacity.lanes)),
        road=max(1, int(record["road_rows"])),
        # Edges count up to 3 m from a corner, and the 3 x 3 block is exact within a cell less half a segment.
        long_ego=half_m + 3.0 > capacity.cell_m - 2.0,
    )


def _rounded(count: int, most: int) -> int:
    return min(most, -(-count // _MULTIPLE) * _MULTIPLE)


def _longest_run(start: np.ndarray[Any, Any], grid: int) -> int:
    """Longest run over three neighbouring cells of a grid row, at least 8, rounded up to 8."""
    begin = start[:-1].reshape(grid, grid).astype(np.int64)
    end = start[1:].reshape(grid, grid).astype(np.int64)
    longest = max(int((end[:, 2:] - begin[:, :-2]).max()), 1)
    return -(-longest // _MULTIPLE) * _MULTIPLE
