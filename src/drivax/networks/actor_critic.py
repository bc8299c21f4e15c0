"""Policy and value networks for PPO."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from drivax.networks.distributions import SquashedGaussian
from drivax.networks.encoders import Groups, GroupSpec, MlpConfig, MlpEncoder

_ACTIONS = 2
#: Standard deviation of an untrained policy before squashing, through softplus.
_FIRST_SCALE = 0.5


@dataclass(frozen=True)
class ActorCriticConfig:
    """Networks of a policy-gradient agent.

    Attributes:
        encoder: The encoder; policy and value have one each.
        head: Hidden layers between embedding and output.
    """

    encoder: MlpConfig = field(default_factory=MlpConfig)
    head: tuple[int, ...] = (64,)


class _Head(nnx.Module):
    def __init__(self, width: int, hidden: tuple[int, ...], out: int, scale: float, rngs: nnx.Rngs) -> None:
        layers = []
        for size in hidden:
            layers.append(nnx.Linear(width, size, kernel_init=nnx.initializers.orthogonal(2**0.5), rngs=rngs))
            width = size
        self.hidden = nnx.List(layers)
        self.out = nnx.Linear(width, out, kernel_init=nnx.initializers.orthogonal(scale), rngs=rngs)

    def __call__(self, x: Array) -> Array:
        for layer in self.hidden:
            x = jnp.tanh(layer(x))
        return self.out(x)


class Policy(nnx.Module):
    """Observation -> distribution over actions."""

    def __init__(self, config: ActorCriticConfig, spec: GroupSpec, rngs: nnx.Rngs) -> None:
        self.encoder = MlpEncoder(config.encoder, spec, rngs)
        self.head = _Head(self.encoder.width, config.head, 2 * _ACTIONS, 0.01, rngs)

    def __call__(self, groups: Groups) -> SquashedGaussian:
        """The action distribution; near zero mean and standard deviation 0.5 before training."""
        raw = self.head(self.encoder(groups))
        shift = jnp.log(jnp.expm1(_FIRST_SCALE))
        return SquashedGaussian.from_parameters(raw.at[..., _ACTIONS:].add(shift))


class Value(nnx.Module):
    """Observation -> value."""

    def __init__(self, config: ActorCriticConfig, spec: GroupSpec, rngs: nnx.Rngs) -> None:
        self.encoder = MlpEncoder(config.encoder, spec, rngs)
        self.head = _Head(self.encoder.width, config.head, 1, 1.0, rngs)

    def __call__(self, groups: Groups) -> Float[Array, "*batch"]:
        """Expected discounted return."""
        return self.head(self.encoder(groups))[..., 0]


class ActorCritic(nnx.Module):
    """A policy and a value with an encoder each."""

    def __init__(self, config: ActorCriticConfig, spec: GroupSpec, rngs: nnx.Rngs) -> None:
        self.policy = Policy(config, spec, rngs)
        self.value = Value(config, spec, rngs)
