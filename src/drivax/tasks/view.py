"""The frame and the units of observations."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float

from drivax.geometry.vectors import rotate
from drivax.scenario.record import record
from drivax.simulator.types import Frame, Scene

#: What positions, speeds, sizes and the lengths of pieces of road are divided by.
POSITION_M, SPEED_MPS, SIZE_M, PIECE_M = 50.0, 15.0, 5.0, 10.0
#: Everyone's frame so many steps ago, 0 to 15; the number is a plain one, known when the program is compiled.
Frames = Callable[[int], Frame]


@record
class View:
    """The ego frame: x ahead, y to the left."""

    xy: Float[Array, " 2"]
    cos: Float[Array, ""]
    sin: Float[Array, ""]

    @classmethod
    def of(cls, scene: Scene) -> View:
        """The frame of the driven agent now."""
        now = scene.history[-1]
        return cls(now[:2], jnp.cos(now[2]), jnp.sin(now[2]))

    def point(self, xy: Float[Array, "... 2"]) -> Float[Array, "... 2"]:
        """A place of the world, m."""
        return rotate(xy - self.xy, self.cos, -self.sin)

    def vector(self, xy: Float[Array, "... 2"]) -> Float[Array, "... 2"]:
        """A direction or velocity of the world."""
        return rotate(xy, self.cos, -self.sin)
