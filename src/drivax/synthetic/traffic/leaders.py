"""The leader of every vehicle: the nearest vehicle ahead on the lanes of its path."""

from __future__ import annotations

import numpy as np

from drivax.synthetic.traffic.path_arrays import (
    PathTables,
    PerVehicle,
    VehicleMask,
    VehicleRows,
    Worlds,
    group_indices,
)
from drivax.synthetic.traffic.paths import SLOTS
from drivax.synthetic.traffic.roles import Drivers

#: Right part of a lane that a cyclist takes, m: half a bicycle, its distance from the kerb, 1.5 m to a passing car.
_CYCLIST_PASSING_M = 0.35 + 0.55 + 1.5


class LeaderSearch:
    """Search for the leader of every vehicle."""

    def __init__(self, worlds: Worlds, drivers: Drivers) -> None:
        self._worlds = worlds
        self._half_m, self._half_width_m = drivers.size_m[:, :2].T / 2
        self._cyclist, self._any_cyclist = drivers.cyclist, bool(drivers.cyclist.any())
        # Half the width of the widest car in the middle of each lane that may pass a cyclist (below 4.8 m: none may).
        widths = [lane.width_m for network in worlds.networks for lane in network.lanes]
        self._passing_half_m = np.array(widths) / 2 - _CYCLIST_PASSING_M
        self._nearest = np.full(len(worlds.world), np.inf), np.zeros(len(worlds.world), int)

    def find(
        self, tables: PathTables, at_m: PerVehicle, active: VehicleMask
    ) -> tuple[PerVehicle, VehicleRows]:
        """Return the gap to the nearest vehicle ahead on the lanes of the path (infinite: none), and its row.

        A world without a vehicle on a lane keeps its last result.
        """
        world = self._worlds.world
        lane, along = tables.lanes_at(at_m)
        lane[~active] = -1
        # Occupied (vehicle, lane) of each world, padded with -1, and their positions on the path of each vehicle.
        slots = (lane.ravel() >= 0).nonzero()[0]
        if not len(slots):
            return self._nearest
        vehicle, lane = slots // SLOTS, lane.ravel().take(slots)
        entry = group_indices(world[vehicle], len(self._worlds))
        lanes = np.where(entry < 0, self._worlds.first_lane[:-1, None], lane[entry])
        index = lanes.take(world, axis=0)
        index += tables.column[:, None]
        # nan where the lane is not on the path, or not relevant at this position.
        begin = tables.present_begin(at_m).take(index)
        pair = (begin == begin).ravel().nonzero()[0]
        row = pair // entry.shape[1]
        slot = entry.ravel().take(pair - (row - world[row]) * entry.shape[1])
        ahead, own_m = vehicle[slot], at_m[row]
        position = tables.scale.take(index.ravel()[pair]) * along.ravel().take(slots)[slot]
        position += begin.ravel()[pair]
        is_ahead = (position > own_m) & (ahead != row) & (slot >= 0)
        if self._any_cyclist:
            # Cyclists are overtaken within lanes that are wide enough.
            is_ahead &= ~self._cyclist[ahead] | (self._passing_half_m[lane[slot]] < self._half_width_m[row])
        k = is_ahead.nonzero()[0]
        row, ahead = row[k], ahead[k]
        gap_m = position[k] - self._half_m[ahead] - own_m[k] - self._half_m[row]
        gap, leader = np.full(len(world), np.inf), vehicle[entry[:, 0]][world]
        np.minimum.at(gap, row, gap_m)
        # Enter the first of several nearest vehicles last.
        nearest = (gap_m == gap[row]).nonzero()[0][::-1]
        leader[row[nearest]] = ahead[nearest]
        is_empty = (entry[:, 0] < 0)[world]
        if is_empty.any():
            gap[is_empty], leader[is_empty] = (last[is_empty] for last in self._nearest)
        self._nearest = gap, leader
        return self._nearest
