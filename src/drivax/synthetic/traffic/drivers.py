"""Vehicles and their drivers."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, Int8

from drivax.scenario.schema import AgentKind
from drivax.simulator.idm import IdmParameters


@dataclass(frozen=True)
class Drivers:
    """Vehicles (and cyclists) and who drives them, one entry per vehicle.

    Attributes:
        kind: ``AgentKind``: VEHICLE or CYCLIST.
        size_m: Length, width and height.
        speed_factor: Preferred speed as a multiple of the limit.
        top_speed_mps: Speed that is not exceeded whatever the limit.
        lateral_mps2: Lateral acceleration accepted in bends.
        slowing_mps2: Deceleration with which slower stretches are approached.
        yellow_mps2: Deceleration that a driver accepts to stop at yellow.
        jerk_mps3: Rate at which acceleration is changed in ordinary driving.
        headway_s, acceleration_mps2, braking_mps2: The driver's IDM.
        politeness: Weight of others' accelerations when a lane change is weighed (MOBIL).
        reaction_s: Delay between a decision and its execution.
        critical_gap_s: Shortest time to the arrival of others at which a driver who must give way goes.
    """

    kind: Int8[np.ndarray, " vehicle"]
    size_m: Float64[np.ndarray, "vehicle 3"]
    speed_factor: Float64[np.ndarray, " vehicle"]
    top_speed_mps: Float64[np.ndarray, " vehicle"]
    lateral_mps2: Float64[np.ndarray, " vehicle"]
    slowing_mps2: Float64[np.ndarray, " vehicle"]
    yellow_mps2: Float64[np.ndarray, " vehicle"]
    jerk_mps3: Float64[np.ndarray, " vehicle"]
    headway_s: Float64[np.ndarray, " vehicle"]
    acceleration_mps2: Float64[np.ndarray, " vehicle"]
    braking_mps2: Float64[np.ndarray, " vehicle"]
    politeness: Float64[np.ndarray, " vehicle"]
    reaction_s: Float64[np.ndarray, " vehicle"]
    critical_gap_s: Float64[np.ndarray, " vehicle"]

    @property
    def idm(self) -> IdmParameters:
        """The drivers' parameters of the common law."""
        return IdmParameters(
            headway_s=self.headway_s,
            acceleration_mps2=self.acceleration_mps2,
            comfortable_braking_mps2=self.braking_mps2,
        )

    @property
    def cyclist(self) -> Bool[np.ndarray, " vehicle"]:
        """Mask of cyclists."""
        return self.kind == AgentKind.CYCLIST

    def chosen(self, rows: np.ndarray) -> Drivers:
        """The drivers of some rows (indices or a mask), in that order."""
        return Drivers(**{name: value[rows] for name, value in vars(self).items()})

    def with_headway(self, row: int, headway_s: float) -> Drivers:
        """Return the drivers with one time gap changed."""
        changed = self.headway_s.copy()
        changed[row] = headway_s
        return replace(self, headway_s=changed)
