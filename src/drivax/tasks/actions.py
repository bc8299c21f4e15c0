"""Action spaces: from a policy's action in [-1, 1]^2 to acceleration and curvature, and back. Zero maps to zero."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

#: Wheelbase as a share of the length, for steering angles (semantics, ``published``).
_WHEELBASE = 0.6


@dataclass(frozen=True)
class ActionSpace:
    """Bounds of an action space.

    Attributes:
        kind: ``physical``: acceleration and curvature; ``published``: acceleration and steering angle.
        braking_mps2, acceleration_mps2: What -1 and +1 mean for the first action.
        steering: What 1 means for the second action: curvature in 1/m, or angle in rad.
    """

    kind: Literal["physical", "published"] = "physical"
    braking_mps2: float = 6.0
    acceleration_mps2: float = 6.0
    steering: float = 0.3

    def command(self, action: Float[Array, " 2"], length_m: Any) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Acceleration (m/s2) and curvature (1/m) of an action; actions beyond [-1, 1] are clipped."""
        action = jnp.clip(action, -1.0, 1.0)
        scale = jnp.where(action[0] < 0, self.braking_mps2, self.acceleration_mps2)
        steering = action[1] * self.steering
        if self.kind == "published":
            steering = jnp.tan(steering) / (_WHEELBASE * jnp.maximum(length_m, 1.0))
        return action[0] * scale, steering

    def action(
        self, acceleration: Float[Array, ""], curvature: Float[Array, ""], length_m: Any
    ) -> Float[Array, " 2"]:
        """The action that commands this; not clipped, so that what lies outside [-1, 1] can be seen."""
        scale = jnp.where(acceleration < 0, self.braking_mps2, self.acceleration_mps2)
        steering = curvature
        if self.kind == "published":
            steering = jnp.arctan(curvature * _WHEELBASE * jnp.maximum(length_m, 1.0))
        return jnp.stack([acceleration / scale, steering / self.steering])


PHYSICAL = ActionSpace()
PUBLISHED = ActionSpace(kind="published", braking_mps2=4.0, acceleration_mps2=2.0, steering=0.3)
