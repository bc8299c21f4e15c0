"""Frame and units of observations."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float

from drivax.geometry.vectors import rotate
from drivax.scenario.record import record
from drivax.simulator.types import AgentContext, Frame

#: Units of positions, speeds, sizes and lengths of road pieces.
POSITION_M, SPEED_MPS, SIZE_M, PIECE_M = 50.0, 15.0, 5.0, 10.0
#: Frame of all agents 0 to 15 steps ago; the number is static.
Frames = Callable[[int], Frame]


@record
class View:
    """The ego frame: x ahead, y left."""

    xy: Float[Array, " 2"]
    cos: Float[Array, ""]
    sin: Float[Array, ""]

    @classmethod
    def of(cls, context: AgentContext) -> View:
        """Return the frame of the driven agent now."""
        now = context.history[-1]
        return cls(now[:2], jnp.cos(now[2]), jnp.sin(now[2]))

    def point(self, xy: Float[Array, "... 2"]) -> Float[Array, "... 2"]:
        """Transform a position, m."""
        return rotate(xy - self.xy, self.cos, -self.sin)

    def vector(self, xy: Float[Array, "... 2"]) -> Float[Array, "... 2"]:
        """Transform a direction or velocity."""
        return rotate(xy, self.cos, -self.sin)
