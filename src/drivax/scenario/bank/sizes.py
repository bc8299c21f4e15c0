"""Sizes of the arrays of a scenario bank. This module needs no JAX."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass
from functools import reduce
from itertools import islice
from typing import Any

import numpy as np
from jaxtyping import Int, Shaped

from drivax.errors import DrivaxError
from drivax.scenario.schema import Capacity, Scenario, stack_field

#: Most sizes are multiples of this, so that banks of similar scenarios share programs.
_MULTIPLE = 8
#: Scenarios that are stacked at a time: their columns fit in the cache of a core.
BATCH = 32


@dataclass(frozen=True)
class Sizes:
    """Sizes of the arrays of a bank; banks of the same sizes run the same compiled programs.

    Attributes:
        agents, slots: Moving agents; slots of a frame for moving and parked agents.
        lights: Traffic lights.
        edges, lanes, road: Segments of road edges and of car lanes, and pieces of road to observe.
        edge_run, lane_run: Longest run of a row of three grid cells.
        graphs: Lanes of the graph.
        long_ego: Whether some ego is too long for a single grid query.
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
        """Return the sizes that hold all scenarios of a capacity."""
        sizes = {name: getattr(capacity, name) for name in ("agents", "lights", "edge_run", "lane_run")}
        sizes |= {"edges": capacity.segments, "lanes": capacity.segments, "graphs": capacity.lanes}
        slots = capacity.agents + capacity.parked
        return cls(**sizes, slots=slots, road=capacity.road_rows, long_ego=False)

    @classmethod
    def read(cls, values: Mapping[str, Any], capacity: Capacity) -> Sizes:
        """Return the sizes that a manifest names.

        Raises:
            ValueError: Names or types differ, or a size is negative or above that of the capacity.
        """
        most = asdict(cls.whole(capacity)) | {"long_ego": True}
        if {name: type(value) for name, value in values.items()} != {
            n: type(value) for n, value in most.items()
        }:
            raise ValueError(f"sizes are {', '.join(values)} instead of {', '.join(most)}")
        if wrong := [name for name, value in values.items() if not 0 <= value <= most[name]]:
            raise ValueError(f"size {wrong[0]} is {values[wrong[0]]} of {most[wrong[0]]}")
        return cls(**values)

    def join(self, other: Sizes) -> Sizes:
        """Return the sizes that hold the scenarios of both."""
        return Sizes(*map(max, astuple(self), astuple(other)))

    @classmethod
    def used(cls, scenarios: Iterable[Scenario]) -> Sizes:
        """Return the sizes that one or more scenarios of one capacity use; a scenario set knows its own."""
        known = getattr(scenarios, "sizes", None)
        if isinstance(known, cls):
            return known
        remaining, batches = iter(scenarios), list[Sizes]()
        while batch := list(islice(remaining, BATCH)):
            batches.append(_batch_sizes(batch[0].capacity, [scenario.record for scenario in batch]))
        if not batches:
            raise DrivaxError("a bank needs at least one scenario", cure="check the set and its filters")
        return reduce(Sizes.join, batches)

    @classmethod
    def of_record(cls, capacity: Capacity, record: Shaped[np.ndarray, ""]) -> Sizes:
        """Return the sizes that a record uses."""
        return _batch_sizes(capacity, [record])


def _batch_sizes(capacity: Capacity, records: Sequence[Shaped[np.ndarray, ""]]) -> Sizes:
    """Return the sizes that a batch of records of one capacity uses."""
    agents, parked, lights, lanes = (
        last_used(mask)
        for mask in (
            stack_field(records, "agent_valid").any(1),
            stack_field(records, "parked_valid").any(1),
            (stack_field(records, "light_state") >= 0).any(1),
            stack_field(records, "lane_length") > 0,
        )
    )
    moving = max(1, _round_up(int(agents.max()), capacity.agents))
    slots = _round_up(int((agents + parked).max()), capacity.agents + capacity.parked)
    _, edge_end, lane_end, _ = stack_field(records, "segment_blocks").T
    egos = np.zeros((len(records), 1), int)
    if capacity.egos > 1:
        egos = np.hstack([egos, np.maximum(stack_field(records, "ego_slot"), 0)])
    ego_size_m = np.take_along_axis(stack_field(records, "agent_size"), egos[..., None], axis=1)
    half_diagonal_m = np.hypot(*ego_size_m.T[:2]).astype(np.float64) / 2
    return Sizes(
        agents=moving,
        slots=max(slots, moving),
        lights=max(1, _round_up(int(lights.max()), capacity.lights)),
        edges=int(edge_end.max()),
        lanes=int((lane_end - edge_end).max()),
        edge_run=_round_up(_longest_run(stack_field(records, "grid_edge"), capacity.grid), capacity.edge_run),
        lane_run=_round_up(_longest_run(stack_field(records, "grid_lane"), capacity.grid), capacity.lane_run),
        graphs=max(1, _round_up(int(lanes.max()), capacity.lanes)),
        road=max(1, int(stack_field(records, "road_rows").max())),
        # Edges count up to 3 m from a corner; the 3 x 3 block is exact within a cell less half a segment.
        long_ego=bool((half_diagonal_m + 3.0 > capacity.cell_m - 2.0).any()),
    )


def _round_up(count: int, most: int) -> int:
    """Round up to a multiple of 8, but not above ``most``."""
    # Floor division of the negative number rounds up.
    return min(most, -(-count // _MULTIPLE) * _MULTIPLE)


def _longest_run(start: Int[np.ndarray, "n cells1"], grid: int) -> int:
    """Longest run over three neighbouring cells of a grid row, at least 1."""
    begin, end = (part.reshape(-1, grid, grid) for part in (start[:, :-1], start[:, 1:]))
    return int((end[..., 2:] - begin[..., :-2]).max(initial=1))


def last_used(mask: Any) -> Int[np.ndarray, " n"]:
    """Return the number of columns of ``mask [n, column]`` up to the last true one, per row."""
    return np.where(mask.any(1), mask.shape[1] - np.argmax(mask[:, ::-1], axis=1), 0)
