"""Action distributions.

A policy samples and stores *raw actions*, which map to actions in [-1, 1]. The raw action of a Gaussian or of a mixture
is the unsquashed sample, so that a saturated action keeps a finite log-probability; the Beta's lies in (0, 1); the
grid's is the index of a combination of levels. Densities are those of the action, so that entropies can be compared.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import betaln, digamma
from jaxtyping import Array, Float, Int

from drivax.errors import UsageError
from drivax.scenario.record import record, static

DistributionName = Literal["gaussian", "beta", "grid", "mixture"]
#: Distributions whose samples have a gradient in all parameters.
REPARAMETERISED: tuple[DistributionName, ...] = ("gaussian", "beta")

#: Bounds of the standard deviation of an unsquashed Gaussian.
_MIN_SCALE, _MAX_SCALE = 1e-3, 2.0
#: Actions are clipped to +-0.999 (a raw action of +-3.8) before arctanh, which has poles at the bounds.
_MAX_ACTION = 0.999
#: Distance that a Beta's raw action keeps from 0 and 1, where the log-density has poles.
_EDGE = 1e-6
#: Gaussians in a mixture.
_COMPONENTS = 3
#: Nodes of the Gauss-Hermite rule; the mean of tanh is within 1e-3 for every scale up to 2.
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(24)


@dataclass(frozen=True)
class Actions:
    """Size of an action and, for the grid, the levels in [-1, 1] of each of its components."""

    size: int = 2
    levels: tuple[tuple[float, ...], ...] | None = None

    def __post_init__(self) -> None:
        if self.levels is not None and len(self.levels) != self.size:
            problem = f"levels of {len(self.levels)} numbers for actions of {self.size}"
            raise UsageError(problem, cure="give levels for each number of an action")


@runtime_checkable
class Distribution(Protocol):
    """A distribution over actions, or a batch of them; a pytree."""

    def sample(self, key: Array) -> Float[Array, "*batch raw"]:
        """Sample a raw action, differentiable in all parameters if :data:`REPARAMETERISED`."""
        ...

    def log_prob(self, raw_action: Float[Array, "*batch raw"]) -> Float[Array, "*batch"]:
        """Return the log-density of a raw action's action (log-probability on the grid)."""
        ...

    def action(self, raw_action: Float[Array, "*batch raw"]) -> Float[Array, "*batch action"]:
        """Map raw actions to actions in [-1, 1]."""
        ...

    def raw_action(self, action: Float[Array, "*batch action"]) -> Float[Array, "*batch raw"]:
        """Return the raw action of an action after clipping, or on the grid that of its nearest levels."""
        ...

    def mode(self) -> Float[Array, "*batch action"]:
        """Return the action that policies take in evaluation."""
        ...

    def mean_action(self) -> Float[Array, "*batch action"]:
        """Return the mean of the actions."""
        ...

    def entropy_estimate(self, noise: Float[Array, "*batch action"]) -> Float[Array, "*batch"]:
        """Return the entropy of the action, in closed form or estimated from standard normal noise."""
        ...


class _SquashedActions:
    """Actions that are ``tanh`` of raw actions."""

    def action(self, raw_action: Float[Array, "*batch action"]) -> Float[Array, "*batch action"]:
        """Return the squashed raw action."""
        return jnp.tanh(raw_action)

    def raw_action(self, action: Float[Array, "*batch action"]) -> Float[Array, "*batch action"]:
        """Return ``arctanh`` of actions, clipped to +-0.999."""
        return jnp.arctanh(jnp.clip(action, -_MAX_ACTION, _MAX_ACTION))


@record
class SquashedGaussian(_SquashedActions):
    """``tanh`` of a diagonal Gaussian with mean ``loc`` and standard deviation ``scale``."""

    loc: Float[Array, "*batch action"]
    scale: Float[Array, "*batch action"]

    @classmethod
    def from_parameters(cls, parameters: Float[Array, "*batch two_actions"]) -> SquashedGaussian:
        """Split the output of a head into means, and standard deviations before softplus."""
        loc, raw = jnp.split(parameters, 2, axis=-1)
        return cls(loc, jnp.clip(jax.nn.softplus(raw), _MIN_SCALE, _MAX_SCALE))

    def sample(self, key: Array) -> Float[Array, "*batch action"]:
        """Sample ``loc + scale * noise``."""
        return self.sample_of(jax.random.normal(key, self.loc.shape))

    def sample_of(self, noise: Float[Array, "*batch action"]) -> Float[Array, "*batch action"]:
        """Return the sample that standard normal noise gives."""
        return self.loc + self.scale * noise

    def log_prob(self, raw_action: Float[Array, "*batch action"]) -> Float[Array, "*batch"]:
        """Return the log-density of ``tanh(x)``, with the exact Jacobian ``2 (ln 2 - x - softplus(-2 x))``."""
        z = (raw_action - self.loc) / self.scale
        gaussian = -0.5 * z * z - jnp.log(self.scale) - 0.5 * math.log(2 * math.pi)
        jacobian = 2.0 * (math.log(2.0) - raw_action - jax.nn.softplus(-2.0 * raw_action))
        return jnp.sum(gaussian - jacobian, axis=-1)

    def mode(self) -> Float[Array, "*batch action"]:
        """Return the squashed mean: the median of the action, but not always the peak of its density."""
        return jnp.tanh(self.loc)

    def mean_action(self) -> Float[Array, "*batch action"]:
        """Return the mean of ``tanh`` by Gauss-Hermite quadrature, within 1e-3."""
        nodes = jnp.tanh(self.loc[..., None] + self.scale[..., None] * jnp.asarray(_NODES, jnp.float32))
        return nodes @ jnp.asarray(_WEIGHTS / _WEIGHTS.sum(), jnp.float32)

    def entropy_estimate(self, noise: Float[Array, "*batch action"]) -> Float[Array, "*batch"]:
        """Return minus the log-density of one sample."""
        return -self.log_prob(self.sample_of(noise))


@record
class Beta:
    """``2 x - 1`` of independent ``x ~ Beta(alpha, beta)``; with both parameters above 1, the density has one peak."""

    alpha: Float[Array, "*batch action"]
    beta: Float[Array, "*batch action"]

    @classmethod
    def from_parameters(cls, parameters: Float[Array, "*batch two_actions"]) -> Beta:
        """Split the output of a head into halves; each parameter is ``1 + softplus``."""
        alpha, beta = jnp.split(1.0 + jax.nn.softplus(parameters), 2, axis=-1)
        return cls(alpha, beta)

    def sample(self, key: Array) -> Float[Array, "*batch action"]:
        """Sample in [1e-6, 1 - 1e-6], reparameterised implicitly (Figurnov et al. 2018, arXiv 1805.08498)."""
        return jnp.clip(jax.random.beta(key, self.alpha, self.beta), _EDGE, 1.0 - _EDGE)

    def log_prob(self, raw_action: Float[Array, "*batch action"]) -> Float[Array, "*batch"]:
        """Return the log-density of ``2 x - 1``: that of ``x`` minus ``ln 2`` per component."""
        x = jnp.clip(raw_action, _EDGE, 1.0 - _EDGE)
        density = (self.alpha - 1.0) * jnp.log(x) + (self.beta - 1.0) * jnp.log1p(-x)
        return jnp.sum(density - betaln(self.alpha, self.beta) - math.log(2.0), axis=-1)

    def action(self, raw_action: Float[Array, "*batch action"]) -> Float[Array, "*batch action"]:
        """Return ``2 x - 1``."""
        return 2.0 * raw_action - 1.0

    def raw_action(self, action: Float[Array, "*batch action"]) -> Float[Array, "*batch action"]:
        """Return ``(action + 1) / 2``, clipped to [1e-6, 1 - 1e-6]."""
        return jnp.clip((action + 1.0) / 2.0, _EDGE, 1.0 - _EDGE)

    def mode(self) -> Float[Array, "*batch action"]:
        """Return the peak of the density; its centre if both parameters are rounded to 1."""
        return (self.alpha - self.beta) / jnp.maximum(self.alpha + self.beta - 2.0, _EDGE)

    def mean_action(self) -> Float[Array, "*batch action"]:
        """Return ``(alpha - beta) / (alpha + beta)``."""
        return (self.alpha - self.beta) / (self.alpha + self.beta)

    def entropy_estimate(self, noise: Float[Array, "*batch action"]) -> Float[Array, "*batch"]:
        """Return the exact differential entropy of the action."""
        a, b = self.alpha, self.beta
        # E[ln(x^(a - 1) (1 - x)^(b - 1))]: the mean log-density without its normaliser.
        mean_log = (a - 1.0) * digamma(a) + (b - 1.0) * digamma(b) - (a + b - 2.0) * digamma(a + b)
        return jnp.sum(betaln(a, b) - mean_log + math.log(2.0), axis=-1)


@record
class Grid:
    """A categorical distribution over all combinations of the levels of an action's components, the last fastest."""

    logits: Float[Array, "*batch combination"]
    levels: tuple[tuple[float, ...], ...] = static()

    def sample(self, key: Array) -> Float[Array, "*batch 1"]:
        """Sample the index of a combination, as a float."""
        return jax.random.categorical(key, self.logits)[..., None].astype(jnp.float32)

    def log_prob(self, raw_action: Float[Array, "*batch 1"]) -> Float[Array, "*batch"]:
        """Return the log-probability of a combination."""
        log_probs = jax.nn.log_softmax(self.logits)
        return jnp.take_along_axis(log_probs, raw_action.astype(jnp.int32), axis=-1)[..., 0]

    def action(self, raw_action: Float[Array, "*batch 1"]) -> Float[Array, "*batch action"]:
        """Return the levels of a combination."""
        return self._actions()[raw_action[..., 0].astype(jnp.int32)]

    def raw_action(self, action: Float[Array, "*batch action"]) -> Float[Array, "*batch 1"]:
        """Return the index of the combination of the nearest levels."""
        index = jnp.zeros(action.shape[:-1], jnp.int32)
        for axis, levels in enumerate(self.levels):
            nearest = jnp.argmin(jnp.abs(action[..., axis, None] - jnp.asarray(levels)), axis=-1)
            index = index * len(levels) + nearest.astype(jnp.int32)
        return index[..., None].astype(jnp.float32)

    def mode(self) -> Float[Array, "*batch action"]:
        """Return the likeliest action."""
        return self._actions()[jnp.argmax(self.logits, axis=-1)]

    def mean_action(self) -> Float[Array, "*batch action"]:
        """Return the mean of the actions."""
        return jax.nn.softmax(self.logits) @ self._actions()

    def entropy_estimate(self, noise: Float[Array, "*batch action"]) -> Float[Array, "*batch"]:
        """Return the exact entropy."""
        log_probs = jax.nn.log_softmax(self.logits)
        return -jnp.sum(jnp.exp(log_probs) * log_probs, axis=-1)

    def _actions(self) -> Float[Array, "combination action"]:
        return jnp.asarray(combinations(self.levels))


@record
class SquashedMixture(_SquashedActions):
    """``tanh`` of a mixture of diagonal Gaussians (mixture density network; Bishop 1994), which can have several modes.

    Samples have no gradient in the logits.
    """

    logits: Float[Array, "*batch component"]
    components: SquashedGaussian

    @classmethod
    def from_parameters(cls, parameters: Float[Array, "*batch parameters"]) -> SquashedMixture:
        """Split a head's output into logits and components (:meth:`SquashedGaussian.from_parameters`)."""
        logits, flat = jnp.split(parameters, [_COMPONENTS], axis=-1)
        return cls(logits, SquashedGaussian.from_parameters(flat.reshape(*flat.shape[:-1], _COMPONENTS, -1)))

    def sample(self, key: Array) -> Float[Array, "*batch action"]:
        """Sample a component, then a raw action from it."""
        component_key, noise_key = jax.random.split(key)
        component = jax.random.categorical(component_key, self.logits)
        return _select_component(self.components.sample(noise_key), component)

    def log_prob(self, raw_action: Float[Array, "*batch action"]) -> Float[Array, "*batch"]:
        """Return the log of the weighted sum of the components' densities."""
        log_weights, sample = jax.nn.log_softmax(self.logits), raw_action[..., None, :]
        # Batch axes of samples and components must agree.
        samples = jnp.broadcast_to(sample, jnp.broadcast_shapes(sample.shape, self.components.loc.shape))
        return jax.nn.logsumexp(log_weights + self.components.log_prob(samples), axis=-1)

    def mode(self) -> Float[Array, "*batch action"]:
        """Return the squashed mean of the component with the largest weight."""
        return _select_component(self.components.mode(), jnp.argmax(self.logits, axis=-1))

    def mean_action(self) -> Float[Array, "*batch action"]:
        """Return the weighted mean of the components' means, within 1e-3."""
        return jnp.sum(jax.nn.softmax(self.logits)[..., None] * self.components.mean_action(), axis=-2)

    def entropy_estimate(self, noise: Float[Array, "*batch action"]) -> Float[Array, "*batch"]:
        """Return minus the mean log-density of one sample per component, weighted as the components are."""
        noise = jnp.broadcast_to(noise[..., None, :], self.components.loc.shape)
        raw_actions = self.components.sample_of(noise)
        log_probs = jnp.stack([self.log_prob(raw_actions[..., k, :]) for k in range(_COMPONENTS)], axis=-1)
        return -jnp.sum(jax.nn.softmax(self.logits) * log_probs, axis=-1)


def _select_component(values: Float[Array, "*batch component action"], index: Int[Array, "*batch"]) -> Array:
    return jnp.take_along_axis(values, index[..., None, None], axis=-2)[..., 0, :]


def combinations(levels: tuple[tuple[float, ...], ...]) -> Float[np.ndarray, "combination action"]:
    """Return all combinations of levels, the last component fastest."""
    axes = np.meshgrid(*(np.asarray(axis, np.float32) for axis in levels), indexing="ij")
    return np.stack([axis.ravel() for axis in axes], axis=-1)


def parameter_count(kind: DistributionName, actions: Actions) -> int:
    """Return the number of parameters of a distribution, which is the number of a head's outputs.

    Raises:
        UsageError: The distribution is a grid, but the actions have no levels.
    """
    if kind == "grid":
        return len(combinations(_levels(actions)))
    return _COMPONENTS * (1 + 2 * actions.size) if kind == "mixture" else 2 * actions.size


def initial_parameters(
    kind: DistributionName, actions: Actions, scale: float | tuple[float, ...]
) -> Float[np.ndarray, " parameters"]:
    """Return the parameters of a distribution centred at zero, to add to the outputs of an untrained head.

    ``scale``, one for all numbers of an action or one for each, is the standard deviation of the unsquashed Gaussian,
    of the Beta's action, or of the Gaussian whose density weights the grid's levels; in a mixture, of each component,
    with means between ``-scale`` and ``scale``.

    Raises:
        UsageError: A Gaussian cannot have this scale, a Beta with it has no peak, or the number of scales does not fit.
    """
    scales = np.atleast_1d(np.asarray(scale, np.float64))
    if len(scales) not in (1, actions.size):
        problem = f"first_scale has {len(scales)} numbers for actions of {actions.size}"
        raise UsageError(problem, cure="give one, or one for each number of an action")
    scales = np.broadcast_to(scales, actions.size)
    if kind == "grid":
        return (-0.5 * (combinations(_levels(actions)) / scales) ** 2).sum(axis=-1)
    if kind != "beta" and (scales.min() < _MIN_SCALE or scales.max() > _MAX_SCALE):
        raise UsageError(f"first_scale of a {kind} is {scale}", cure=f"use {_MIN_SCALE:g} to {_MAX_SCALE:g}")
    raw_scales = np.log(np.expm1(scales))  # the inverse of softplus
    if kind == "gaussian":
        return np.concatenate([np.zeros(actions.size), raw_scales]).astype(np.float32)
    if kind == "mixture":
        # Equal components would stay equal; the one around zero starts with the largest weight.
        means = np.linspace(-1.0, 1.0, _COMPONENTS)
        components = [np.concatenate([mean * scales, raw_scales]) for mean in means]
        return np.concatenate([(means == 0.0).astype(float), *components]).astype(np.float32)
    # A symmetric Beta's action has the variance 1 / (2 alpha + 1).
    alpha_minus_1 = (scales**-2 - 1.0) / 2.0 - 1.0
    if (alpha_minus_1 <= 0.0).any():
        raise UsageError(f"a Beta of first_scale {scales.max():g} has no peak", cure="use less than 0.577")
    # The inverse of softplus, ln(e^x - 1), without overflow.
    return np.tile(alpha_minus_1 + np.log(-np.expm1(-alpha_minus_1)), 2).astype(np.float32)


def distribution(
    kind: DistributionName, parameters: Float[Array, "*batch parameters"], actions: Actions
) -> Distribution:
    """Return the distribution with a head's output as parameters."""
    if kind == "grid":
        return Grid(parameters, _levels(actions))
    kinds = {"gaussian": SquashedGaussian, "beta": Beta, "mixture": SquashedMixture}
    return kinds[kind].from_parameters(parameters)


def _levels(actions: Actions) -> tuple[tuple[float, ...], ...]:
    if actions.levels is None:
        raise UsageError("the grid needs actions with levels", cure="choose the action space 'discrete'")
    return actions.levels
