"""Policies, values and critics: an encoder and a head each."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from drivax.networks.distributions import (
    Actions,
    Distribution,
    DistributionName,
    distribution,
    first_parameters,
    parameters_of,
)
from drivax.networks.encoders import (
    Encoder,
    EncoderConfig,
    Groups,
    GroupSpec,
    MlpConfig,
    dense_layers,
)
from drivax.networks.entity import EntityConfig
from drivax.networks.pooling import ACTIVATIONS, Activation
from drivax.networks.transformers import LqConfig, LqhConfig, MtrConfig, WayformerConfig

#: What ``encoder:`` can be; ``kind:`` in YAML is ``mlp``, ``lq``, ``lqh``, ``mtr``, ``wayformer``, ``entity``, or the
#: dotted name of one's own.
EncoderSettings = (
    MlpConfig | LqConfig | LqhConfig | MtrConfig | WayformerConfig | EntityConfig | EncoderConfig
)


@dataclass(frozen=True)
class NetworkConfig:
    """Networks of an agent.

    Attributes:
        encoder: The encoder; policy, value and every critic have one each, but for ``shared_encoder``.
        head: Hidden layers between embedding and output.
        activation: After every hidden layer of a head; outputs are linear.
        first_scale: Standard deviation of an untrained policy: before squashing (gaussian), of the action (beta), or
            of the Gaussian whose density gives the levels their probabilities (grid).
        distribution: Of actions: a squashed Gaussian, a mixture of three, a Beta, or a grid of levels, for ``discrete``
            actions.
        shared_encoder: Whether policy and value look through one encoder. Critics never share.
    """

    encoder: EncoderSettings = field(default_factory=MlpConfig)
    head: tuple[int, ...] = (64,)
    activation: Activation = "tanh"
    first_scale: float = 0.3
    distribution: DistributionName = "gaussian"
    shared_encoder: bool = False

    def __post_init__(self) -> None:
        if self.first_scale <= 0.0:
            raise ValueError(f"first_scale is {self.first_scale:g}; use more than 0")


class _Head(nnx.Module):
    def __init__(self, config: NetworkConfig, width: int, out: int, scale: float, rngs: nnx.Rngs) -> None:
        self.activation = config.activation
        self.hidden = dense_layers(width, config.head, rngs)
        width = config.head[-1] if config.head else width
        self.out = nnx.Linear(width, out, kernel_init=nnx.initializers.orthogonal(scale), rngs=rngs)

    def __call__(self, x: Array, beside: Array | None = None) -> Array:
        """Of ``x``, or of ``x`` and what stands beside it, which may have leading axes that ``x`` lacks."""
        if beside is not None and beside.shape[:-1] == x.shape[:-1]:
            # Nothing is shared: one product is quicker than two.
            x, beside = jnp.concatenate([x, beside], axis=-1), None
        layers = [*self.hidden, self.out]
        for number, layer in enumerate(layers):
            x = layer(x) if number or beside is None else _side_by_side(layer, x, beside)
            if number < len(self.hidden):
                x = ACTIVATIONS[self.activation](x)
        return x


def _side_by_side(layer: nnx.Linear, x: Array, beside: Array) -> Array:
    """The layer of both, concatenated: what it makes of ``x`` is computed once for everything beside it."""
    kernel, bias = layer.kernel[...], 0.0 if layer.bias is None else layer.bias[...]
    width = x.shape[-1]
    return x @ kernel[:width] + beside @ kernel[width:] + bias


class Policy(nnx.Module):
    """Observation -> distribution over actions."""

    def __init__(
        self, config: NetworkConfig, spec: GroupSpec, rngs: nnx.Rngs, actions: Actions | None = None
    ) -> None:
        self.actions = actions or Actions()
        self.kind: DistributionName = config.distribution
        self.first_scale = config.first_scale
        self.encoder = config.encoder.build(spec, rngs)
        self.head = _Head(config, self.encoder.width, parameters_of(self.kind, self.actions), 0.01, rngs)

    def __call__(self, groups: Groups) -> Distribution:
        """The action distribution; around zero with the first standard deviation before training."""
        return self.of(self.encoder(groups))

    def of(self, embedding: Float[Array, "*batch width"]) -> Distribution:
        """The distribution for what the encoder makes of an observation."""
        first = first_parameters(self.kind, self.actions, self.first_scale)
        return distribution(self.kind, self.head(embedding) + first, self.actions)


class Value(nnx.Module):
    """Observation -> value."""

    def __init__(
        self, config: NetworkConfig, spec: GroupSpec, rngs: nnx.Rngs, encoder: Encoder | None = None
    ) -> None:
        self.encoder = encoder or config.encoder.build(spec, rngs)
        self.head = _Head(config, self.encoder.width, 1, 1.0, rngs)

    def __call__(self, groups: Groups) -> Float[Array, "*batch"]:
        """Expected discounted return."""
        return self.of(self.encoder(groups))

    def of(self, embedding: Float[Array, "*batch width"]) -> Float[Array, "*batch"]:
        """The value for what the encoder makes of an observation."""
        return self.head(embedding)[..., 0]


class ActorCritic(nnx.Module):
    """A policy and a value, with an encoder each or one for both."""

    def __init__(
        self, config: NetworkConfig, spec: GroupSpec, rngs: nnx.Rngs, actions: Actions | None = None
    ) -> None:
        self.shared = config.shared_encoder
        self.policy = Policy(config, spec, rngs, actions)
        self.value = Value(config, spec, rngs, self.policy.encoder if self.shared else None)

    def both(self, groups: Groups) -> tuple[Distribution, Float[Array, "*batch"]]:
        """Action distribution and value; a shared encoder encodes once."""
        if not self.shared:
            return self.policy(groups), self.value(groups)
        embedding = self.policy.encoder(groups)
        return self.policy.of(embedding), self.value.of(embedding)


class Critic(nnx.Module):
    """Observation and action -> value of taking it, any real number: the output is linear."""

    def __init__(
        self, config: NetworkConfig, spec: GroupSpec, rngs: nnx.Rngs, actions: Actions | None = None
    ) -> None:
        self.encoder = config.encoder.build(spec, rngs)
        width = self.encoder.width + (actions or Actions()).size
        self.head = _Head(config, width, 1, 1.0, rngs)

    def __call__(self, groups: Groups, action: Float[Array, "*actions D"]) -> Float[Array, "*actions"]:
        """Expected discounted return of an action in [-1, 1].

        Several actions of an observation stand in leading axes; it is encoded once.
        """
        return self.head(self.encoder(groups), action)[..., 0]


class TwinCritic(nnx.Module):
    """Two critics that share nothing, so that the smaller of their values is a cautious one."""

    def __init__(
        self, config: NetworkConfig, spec: GroupSpec, rngs: nnx.Rngs, actions: Actions | None = None
    ) -> None:
        self.critics = nnx.List([Critic(config, spec, rngs, actions) for _ in range(2)])

    def __call__(self, groups: Groups, action: Float[Array, "*actions D"]) -> Float[Array, "2 *actions"]:
        """Both values; see :class:`Critic` for several actions."""
        return jnp.stack([critic(groups, action) for critic in self.critics])
