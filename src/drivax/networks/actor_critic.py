"""Policies, value functions and critics: an encoder and a head each."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float

from drivax.errors import UsageError
from drivax.networks.attention import EntityConfig
from drivax.networks.distributions import (
    Actions,
    Distribution,
    DistributionName,
    SquashedGaussian,
    distribution,
    initial_parameters,
    parameter_count,
)
from drivax.networks.encoders import (
    ACTIVATIONS,
    Activation,
    Encoder,
    EncoderConfig,
    Groups,
    GroupSpec,
    MlpConfig,
    check_widths,
    dense_layers,
)
from drivax.networks.transformers import LqConfig, LqhConfig, MtrConfig, WayformerConfig

#: Gains of orthogonal output weights. The small gain of policies makes the first actions follow ``first_scale``,
#: whatever the observation is.
_POLICY_GAIN, _VALUE_GAIN = 0.01, 1.0

#: Largest number of parameters of a network: 128 MiB. The largest preset has 0.7 million.
MOST_PARAMETERS = 1 << 25

#: Built-in encoders by ``kind``, or a configuration of your own.
EncoderSettings = (
    MlpConfig | LqConfig | LqhConfig | MtrConfig | WayformerConfig | EntityConfig | EncoderConfig
)


@dataclass(frozen=True)
class NetworkConfig:
    """Architecture of policy, value and critics.

    Attributes:
        encoder: The encoder; policy, value and each critic have their own, unless it is shared.
        head: Hidden layers between embedding and output.
        activation: Activation after each hidden layer of a head; outputs are linear.
        first_scale: Standard deviation of an untrained policy, one for all numbers of an action or one for each: before
            squashing (gaussian, each component of a mixture), of the action (beta), or of the Gaussian whose density
            weights the levels (grid).
        least_scale: Lower bound of the standard deviation, as a share of ``first_scale``, so that exploration does not
            vanish; ``gaussian`` only.
        distribution: Action distribution; ``grid`` is for ``discrete`` actions.
        shared_encoder: Whether policy and value of PPO share one encoder; no effect on other algorithms.
        critic_norm: Layer normalisation before each activation of the critics' heads. It bounds the values of unseen
            actions (Ball et al. 2023, arXiv 2302.02948).
    """

    encoder: EncoderSettings = field(default_factory=MlpConfig)
    head: tuple[int, ...] = (64,)
    activation: Activation = "tanh"
    first_scale: float | tuple[float, ...] = 0.3
    least_scale: float = 0.0
    distribution: DistributionName = "gaussian"
    shared_encoder: bool = False
    critic_norm: bool = False

    def __post_init__(self) -> None:
        if np.size(self.first_scale) == 0 or not np.min(self.first_scale) > 0.0:
            raise UsageError(f"first_scale is {self.first_scale}", cure="use one or more numbers above 0")
        if not 0.0 <= self.least_scale <= 1.0:
            raise UsageError(f"least_scale is {self.least_scale}", cure="use 0 to 1")
        check_widths("head", self.head)


def graph_of(network: Any) -> Any:
    """Return the structure of a network, which may be a result of ``nnx.eval_shape``.

    Raises:
        UsageError: It has too many parameters.
    """
    count = sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(nnx.state(network, nnx.Param)))
    if count > MOST_PARAMETERS:
        cure = f"use {MOST_PARAMETERS:,} or less: narrower layers, or a smaller observation"
        raise UsageError(f"a network has {count:,} parameters", cure=cure)
    return nnx.graphdef(network)


class _Head(nnx.Module):
    """Dense layers from an embedding of ``width`` to ``out`` linear outputs, whose weights start with ``gain``.

    ``norm`` adds layer normalisation before each activation.
    """

    def __init__(
        self, config: NetworkConfig, width: int, out: int, gain: float, rngs: nnx.Rngs, norm: bool = False
    ) -> None:
        self.activation = config.activation
        self.hidden = dense_layers(width, config.head, rngs)
        width = config.head[-1] if config.head else width
        self.out = nnx.Linear(width, out, kernel_init=nnx.initializers.orthogonal(gain), rngs=rngs)
        self.norms = nnx.List([nnx.LayerNorm(size, rngs=rngs) for size in config.head]) if norm else None

    def __call__(self, x: Array, extra: Array | None = None) -> Array:
        """Apply the head to ``x``, or to ``x`` and ``extra`` concatenated; ``extra`` may have further leading axes."""
        if extra is not None and extra.shape[:-1] == x.shape[:-1]:
            # Each ``x`` has one ``extra``, so no product can be shared: one product is faster than two.
            x, extra = jnp.concatenate([x, extra], axis=-1), None
        first, *others = [*self.hidden, self.out]
        x = first(x) if extra is None else _apply_concatenated(first, x, extra)
        for number, layer in enumerate(others):
            x = x if self.norms is None else self.norms[number](x)
            x = layer(ACTIVATIONS[self.activation](x))
        return x


def _apply_concatenated(layer: nnx.Linear, x: Array, extra: Array) -> Array:
    """Apply a layer to ``x`` and ``extra`` concatenated; the product with ``x`` is shared by all of ``extra``."""
    kernel, bias = layer.kernel[...], 0.0 if layer.bias is None else layer.bias[...]
    width = x.shape[-1]
    # Not by broadcasting: the sum over leading axes in its gradient takes XLA on CPUs far longer than a product.
    repeats = jnp.ones(extra.shape[: extra.ndim - x.ndim])
    return jnp.tensordot(repeats, x @ kernel[:width], 0) + extra @ kernel[width:] + bias


class Policy(nnx.Module):
    """Map observations to action distributions."""

    def __init__(
        self, config: NetworkConfig, spec: GroupSpec, rngs: nnx.Rngs, actions: Actions | None = None
    ) -> None:
        self.actions = actions or Actions()
        self.kind: DistributionName = config.distribution
        self.first_scale, self.least_scale = config.first_scale, config.least_scale
        self.encoder = config.encoder.build(spec, rngs)
        self.head = _Head(
            config, self.encoder.width, parameter_count(self.kind, self.actions), _POLICY_GAIN, rngs
        )

    def __call__(self, groups: Groups) -> Distribution:
        """Return the action distribution; before training it is centred near zero with ``first_scale``."""
        return self.from_embedding(self.encoder(groups))

    def from_embedding(self, embedding: Float[Array, "*batch width"]) -> Distribution:
        """Return the action distribution of an embedding."""
        initial = initial_parameters(self.kind, self.actions, self.first_scale)
        result = distribution(self.kind, self.head(embedding) + initial, self.actions)
        if not (self.least_scale and isinstance(result, SquashedGaussian)):
            return result
        min_scale = self.least_scale * np.asarray(self.first_scale, np.float32)
        return replace(result, scale=jnp.maximum(result.scale, min_scale))


class Value(nnx.Module):
    """Map observations to values."""

    def __init__(
        self, config: NetworkConfig, spec: GroupSpec, rngs: nnx.Rngs, encoder: Encoder | None = None
    ) -> None:
        self.encoder = encoder or config.encoder.build(spec, rngs)
        self.head = _Head(config, self.encoder.width, 1, _VALUE_GAIN, rngs)

    def __call__(self, groups: Groups) -> Float[Array, "*batch"]:
        """Return the expected discounted return of the policy from an observation or a batch."""
        return self.from_embedding(self.encoder(groups))

    def from_embedding(self, embedding: Float[Array, "*batch width"]) -> Float[Array, "*batch"]:
        """Return the value of an embedding."""
        return self.head(embedding)[..., 0]


class ActorCritic(nnx.Module):
    """A policy and a value function, with separate encoders or a shared one."""

    def __init__(
        self, config: NetworkConfig, spec: GroupSpec, rngs: nnx.Rngs, actions: Actions | None = None
    ) -> None:
        self.shared = config.shared_encoder
        self.policy = Policy(config, spec, rngs, actions)
        self.value = Value(config, spec, rngs, self.policy.encoder if self.shared else None)

    def policy_and_value(self, groups: Groups) -> tuple[Distribution, Float[Array, "*batch"]]:
        """Return action distribution and value; a shared encoder runs once."""
        if not self.shared:
            return self.policy(groups), self.value(groups)
        embedding = self.policy.encoder(groups)
        return self.policy.from_embedding(embedding), self.value.from_embedding(embedding)


class Critic(nnx.Module):
    """Map observation and action to the action value; the output is linear."""

    def __init__(
        self, config: NetworkConfig, spec: GroupSpec, rngs: nnx.Rngs, actions: Actions | None = None
    ) -> None:
        self.encoder = config.encoder.build(spec, rngs)
        width = self.encoder.width + (actions or Actions()).size
        self.head = _Head(config, width, 1, _VALUE_GAIN, rngs, config.critic_norm)

    def __call__(self, groups: Groups, action: Float[Array, "*actions D"]) -> Float[Array, "*actions"]:
        """Return the expected discounted return of an action in [-1, 1].

        Leading axes hold several actions per observation, which is encoded once.
        """
        return self.head(self.encoder(groups), action)[..., 0]


class TwinCritic(nnx.Module):
    """Two critics without shared parameters (clipped double Q-learning)."""

    def __init__(
        self, config: NetworkConfig, spec: GroupSpec, rngs: nnx.Rngs, actions: Actions | None = None
    ) -> None:
        self.critics = nnx.List([Critic(config, spec, rngs, actions) for _ in range(2)])

    def __call__(self, groups: Groups, action: Float[Array, "*actions D"]) -> Float[Array, "2 *actions"]:
        """Return both values; see :class:`Critic` for several actions."""
        return jnp.stack([critic(groups, action) for critic in self.critics])
