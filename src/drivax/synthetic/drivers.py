"""Vehicles and who drives them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from drivax.simulator.idm import IdmParameters


@dataclass(frozen=True)
class Drivers:
    """Vehicles and who drives them, one entry per vehicle.

    Attributes:
        size_m: Length, width and height.
        speed_factor: Wanted speed as a multiple of the limit.
        lateral_mps2: Lateral acceleration accepted in bends.
        slowing_mps2: Deceleration with which slower stretches are approached.
        yellow_mps2: Deceleration that a driver accepts to stop at yellow.
        jerk_mps3: Rate at which acceleration is changed in ordinary driving.
        headway_s, acceleration_mps2, braking_mps2: The driver's IDM.
    """

    size_m: Float64[np.ndarray, "vehicle 3"]
    speed_factor: Float64[np.ndarray, " vehicle"]
    lateral_mps2: Float64[np.ndarray, " vehicle"]
    slowing_mps2: Float64[np.ndarray, " vehicle"]
    yellow_mps2: Float64[np.ndarray, " vehicle"]
    jerk_mps3: Float64[np.ndarray, " vehicle"]
    headway_s: Float64[np.ndarray, " vehicle"]
    acceleration_mps2: Float64[np.ndarray, " vehicle"]
    braking_mps2: Float64[np.ndarray, " vehicle"]

    @property
    def idm(self) -> IdmParameters:
        """The drivers' parameters of the common law."""
        return IdmParameters(
            headway_s=self.headway_s,
            acceleration_mps2=self.acceleration_mps2,
            comfortable_braking_mps2=self.braking_mps2,
        )
