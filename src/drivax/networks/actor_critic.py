"""Policy and value networks for PPO."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from drivax.networks.distributions import SquashedGaussian
from drivax.networks.encoders import EncoderConfig, Groups, GroupSpec, MlpConfig


@dataclass(frozen=True)
class ActorCriticConfig:
    """Networks of a policy-gradient agent.

    Attributes:
        encoder: The encoder; policy and value have one each.
        head: Hidden layers between embedding and output.
        first_scale: Standard deviation of an untrained policy before squashing.
    """

    encoder: MlpConfig | EncoderConfig = field(default_factory=MlpConfig)
    head: tuple[int, ...] = (64,)
    first_scale: float = 0.3


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
    """Observation -> distribution over actions of so many numbers."""

    def __init__(self, config: ActorCriticConfig, spec: GroupSpec, rngs: nnx.Rngs, actions: int = 2) -> None:
        self.actions = actions
        self.encoder = config.encoder.build(spec, rngs)
        self.head = _Head(self.encoder.width, config.head, 2 * actions, 0.01, rngs)
        self.shift = math.log(math.expm1(config.first_scale))

    def __call__(self, groups: Groups) -> SquashedGaussian:
        """The action distribution; near zero mean and the first standard deviation before training."""
        raw = self.head(self.encoder(groups))
        return SquashedGaussian.from_parameters(raw.at[..., self.actions :].add(self.shift))


class Value(nnx.Module):
    """Observation -> value."""

    def __init__(self, config: ActorCriticConfig, spec: GroupSpec, rngs: nnx.Rngs) -> None:
        self.encoder = config.encoder.build(spec, rngs)
        self.head = _Head(self.encoder.width, config.head, 1, 1.0, rngs)

    def __call__(self, groups: Groups) -> Float[Array, "*batch"]:
        """Expected discounted return."""
        return self.head(self.encoder(groups))[..., 0]


class ActorCritic(nnx.Module):
    """A policy and a value with an encoder each."""

    def __init__(self, config: ActorCriticConfig, spec: GroupSpec, rngs: nnx.Rngs, actions: int = 2) -> None:
        self.policy = Policy(config, spec, rngs, actions)
        self.value = Value(config, spec, rngs)
