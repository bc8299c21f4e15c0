"""Action distributions. Samples are kept before squashing, so that a saturated action has a finite log-probability."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from drivax.scenario.record import record

_MIN_SCALE, _MAX_SCALE = 1e-3, 2.0


@record
class SquashedGaussian:
    """``tanh`` of a diagonal Gaussian.

    Attributes:
        loc: Mean before squashing.
        scale: Standard deviation before squashing.
    """

    loc: Float[Array, "*batch action"]
    scale: Float[Array, "*batch action"]

    @classmethod
    def from_parameters(cls, parameters: Float[Array, "*batch two_actions"]) -> SquashedGaussian:
        """From a head's output: means, then what softplus turns into standard deviations in [1e-3, 2]."""
        loc, raw = jnp.split(parameters, 2, axis=-1)
        return cls(loc, jnp.clip(jax.nn.softplus(raw), _MIN_SCALE, _MAX_SCALE))

    def sample(self, key: Array) -> Float[Array, "*batch action"]:
        """A sample before squashing."""
        return self.loc + self.scale * jax.random.normal(key, self.loc.shape)

    def log_prob(self, unsquashed: Float[Array, "*batch action"]) -> Float[Array, "*batch"]:
        """Log-density of ``tanh(unsquashed)``, with the exact Jacobian ``2 (ln 2 - x - softplus(-2 x))``."""
        z = (unsquashed - self.loc) / self.scale
        gaussian = -0.5 * z * z - jnp.log(self.scale) - 0.5 * math.log(2 * math.pi)
        jacobian = 2.0 * (math.log(2.0) - unsquashed - jax.nn.softplus(-2.0 * unsquashed))
        return jnp.sum(gaussian - jacobian, axis=-1)

    def mode(self) -> Float[Array, "*batch action"]:
        """The squashed mean; what policies act by in evaluation."""
        return jnp.tanh(self.loc)
