"""The Intelligent Driver Model: the car-following law of traffic, planners and the built-in world.

Free of JAX, so that the built-in world can use it in worker processes; takes NumPy or JAX arrays.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class IdmParameters:
    """Parameters of the IDM (Treiber, Hennecke and Helbing 2000); fields may be scalars or arrays."""

    min_gap_m: Any = 2.0
    headway_s: Any = 1.5
    acceleration_mps2: Any = 1.5
    comfortable_braking_mps2: Any = 3.0
    exponent: Any = 4.0
    max_braking_mps2: Any = 6.0


def idm_acceleration(
    speed: Any, desired_speed: Any, gap: Any, leader_speed: Any, parameters: IdmParameters
) -> Any:
    """Return the acceleration of a driver who follows a leader, m/s2.

    ``a = a_max [1 - (v / v0)^d - (s* / s)^2]`` with ``s* = s0 + max(0, v T + v (v - v_l) / (2 sqrt(a_max b)))``
    (Treiber, Hennecke and Helbing, Phys. Rev. E 62, 2000), limited to ``[-max_braking, a_max]``.

    Args:
        speed: Speed of the follower, m/s, not negative.
        desired_speed: v0, m/s; below 0.1 m/s it counts as 0.1.
        gap: Bumper-to-bumper distance, m; below 0.1 m it counts as 0.1. Infinite for a free road.
        leader_speed: Speed of the leader along the follower's path, m/s.
        parameters: Parameters of the follower.
    """
    xp = speed.__array_namespace__()
    p = parameters
    root = 2.0 * (p.acceleration_mps2 * p.comfortable_braking_mps2) ** 0.5
    dynamic_gap = speed * p.headway_s + speed * (speed - leader_speed) / root
    desired_gap = p.min_gap_m + xp.maximum(dynamic_gap, 0.0)
    free_term = (speed / xp.maximum(desired_speed, 0.1)) ** p.exponent
    interaction_term = (desired_gap / xp.maximum(gap, 0.1)) ** 2
    acceleration = p.acceleration_mps2 * (1.0 - free_term - interaction_term)
    return xp.maximum(acceleration, -p.max_braking_mps2)
