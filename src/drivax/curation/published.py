"""The published kinematic heuristic, for comparison: five components of every step.

Backward differences at 10 Hz, the product of distance and closing speed, and distances to the points of the map.
``tests/curation/test_published.py`` shows the consequences: noise of 1 cm/s scores like violent driving, and distant
traffic like a conflict. :mod:`drivax.curation.kinematic` fixes both.

The published maps are points. Ours are segments, sampled every 0.5 m as in Waymo's maps. Only lanes for cars count.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from drivax.curation.kinematic import check_positive, crowding
from drivax.curation.logged import Logged
from drivax.geometry.vectors import norm, wrap
from drivax.scenario.bank.queries import vertex_distances
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.schema import DT_S
from drivax.simulator.types import Frame


@dataclass(frozen=True)
class PublishedConfig:
    """Scales of the components: the value at which each is 1.

    Attributes:
        jerk_mps3, yaw_rps2: Jerk, and yaw acceleration (rad/s2).
        interaction_m2ps: Product of distance and closing speed.
        edge_m: Distance of ego's centre to the nearest point of a road edge at which off_road is 0.
        lane_m: Distance to the nearest point of a lane centre.
        crowd: Number of agents, ego included.
        spacing_m: Distance between the points of the map.
    """

    jerk_mps3: float = 2.5
    yaw_rps2: float = 1.5
    interaction_m2ps: float = 1000.0
    edge_m: float = 0.75
    lane_m: float = 1.25
    crowd: int = 50
    spacing_m: float = 0.5

    def __post_init__(self) -> None:
        check_positive(dict(vars(self)))

    def __call__(self, bank: ScenarioBank, log: Logged) -> dict[str, Float[Array, " T"]]:
        """Return the components of every step of a log."""
        xy = log.motion[:, :2]
        edge_m, lane_m = jax.vmap(lambda point: vertex_distances(bank, log.index, point, self.spacing_m))(xy)
        return {
            "volatility": _volatility(self, log),
            "interaction": _interaction(self, log),
            "off_road": jnp.maximum(1.0 - edge_m / self.edge_m, 0.0),
            "lane_deviation": jnp.minimum(lane_m / self.lane_m, 1.0),
            "density": crowding(log, self.crowd),
        }


def _volatility(config: PublishedConfig, log: Logged) -> Float[Array, " T"]:
    """Return jerk and yaw acceleration from two backward differences, 0 at the start."""
    heading = log.motion[:, 2]
    acceleration = _backward(norm(log.velocity)) / DT_S
    yaw_rate = wrap(_backward(heading)) / DT_S
    jerk, yaw = _backward(acceleration) / DT_S, _backward(yaw_rate) / DT_S
    return jnp.minimum(jnp.maximum(jnp.abs(jerk) / config.jerk_mps3, jnp.abs(yaw) / config.yaw_rps2), 1.0)


def _backward(values: Float[Array, " T"]) -> Float[Array, " T"]:
    return jnp.concatenate([jnp.zeros(1), values[1:] - values[:-1]])


def _interaction(config: PublishedConfig, log: Logged) -> Float[Array, " T"]:
    """Return the largest product of distance and closing speed, ``max(0, -dp . dv)``, over all agents."""

    def largest(frame: Frame, velocity: Array) -> Array:
        offset, relative = frame.box[:, :2] - frame.box[0, :2], frame.velocity - velocity
        closing = -jnp.sum(offset * relative, axis=-1)
        counts = frame.valid & (jnp.arange(len(closing)) > 0)
        return jnp.max(jnp.where(counts, jnp.clip(closing / config.interaction_m2ps, 0.0, 1.0), 0.0))

    return jax.vmap(largest)(log.frame, log.velocity)
