"""Who drives ahead of whom: the nearest vehicle on the lanes that a path leads over."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64, Int64

from drivax.synthetic.roads.network import RoadNetwork
from drivax.synthetic.traffic.drivers import Drivers
from drivax.synthetic.traffic.path_arrays import PathTables
from drivax.synthetic.traffic.paths import SLOTS

#: What a cyclist at a lane's side needs of half its width: half a bicycle, its place, and 1.5 m to a car.
_PASS_CYCLIST_M = 0.35 + 0.55 + 1.5


class Leaders:
    """Finds the leader of every vehicle.

    Args:
        network: The roads.
        drivers: Who drives.
    """

    def __init__(self, network: RoadNetwork, drivers: Drivers) -> None:
        self._half_m, width_m = drivers.size_m[:, 0] / 2, drivers.size_m[:, 1]
        self._rows = np.arange(len(width_m))
        self._cyclist, self._any_cyclist = drivers.cyclist, bool(drivers.cyclist.any())
        # Half the widest car that passes a cyclist at the side of a lane.
        spare_m = np.array([lane.width_m for lane in network.lanes]) / 2 - _PASS_CYCLIST_M
        self._passes = spare_m >= width_m[:, None] / 2
        self._found = np.full(len(width_m), np.inf), np.zeros(len(width_m), int)

    def ahead(
        self, tables: PathTables, at_m: Float64[np.ndarray, " v"], active: Bool[np.ndarray, " v"]
    ) -> tuple[Float64[np.ndarray, " v"], Int64[np.ndarray, " v"]]:
        """Gap to the nearest vehicle ahead on the own lanes (infinite: none), and that vehicle.

        Args:
            tables: Everyone's paths.
            at_m: Where they are on them.
            active: Which of them are there.
        """
        own = at_m[:, None]
        lane, along = tables.on(at_m, self._rows)
        lane[~active] = -1
        # position[i, k]: where the k-th occupied (vehicle, lane) is on the path of vehicle i.
        used = (lane.ravel() >= 0).nonzero()[0]
        if not len(used):
            return self._found
        who, taken = used // SLOTS, lane.ravel().take(used)
        # nan where the lane is not on the path, or does not matter now: comparisons with it are false.
        begin = np.where((tables.since <= own) & (own <= tables.until), tables.begin, np.nan)
        position = tables.scale.take(taken, axis=1)
        position *= along.ravel().take(used)
        position = begin.take(taken, axis=1) + position
        seen = position > own
        seen &= who != self._rows[:, None]
        if self._any_cyclist:
            # Cyclists are overtaken within the lane where it is wide enough.
            seen &= ~(self._cyclist[who] & self._passes.take(taken, axis=1))
        position -= self._half_m[who]
        gap = np.where(seen, position, np.inf) - own - self._half_m[:, None]
        nearest = gap.argmin(axis=1)
        self._found = gap[self._rows, nearest], who[nearest]
        return self._found
