"""Action distributions.

A *choice* is what a policy draws and what is stored; its *action* is what it means, in [-1, 1]. The choice of a
Gaussian, or of a mixture of them, is the unsquashed sample, so that a saturated action keeps a finite log-probability;
the Beta's lies in (0, 1); the grid's is the number of a combination of levels. Log-densities are those of the action,
so that entropies can be compared, but for the grid's.
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
#: Those whose samples have a gradient in all of their parameters.
REPARAMETRISED: tuple[DistributionName, ...] = ("gaussian", "beta")

_MIN_SCALE, _MAX_SCALE = 1e-3, 2.0
#: Actions so near to the bounds stand for all beyond when a Gaussian's choice is asked for: arctanh has poles there.
_SQUASHED = 0.999
#: How near a Beta's choice comes to 0 and 1, where the log-density has poles.
_EDGE = 1e-6
#: Gaussians in a mixture.
_PARTS = 3
#: Nodes of the Gauss-Hermite rule; the mean of tanh is within 1e-3 for every scale up to 2.
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(24)


@dataclass(frozen=True)
class Actions:
    """What a policy's head has to know about actions.

    Attributes:
        size: Numbers in an action.
        levels: For the grid: the values in [-1, 1] that each of these numbers can have.
    """

    size: int = 2
    levels: tuple[tuple[float, ...], ...] | None = None

    def __post_init__(self) -> None:
        if self.levels is not None and len(self.levels) != self.size:
            raise ValueError(f"levels of {len(self.levels)} numbers for actions of {self.size}")


@runtime_checkable
class Distribution(Protocol):
    """A distribution over actions, or a batch of them; a pytree."""

    def sample(self, key: Array) -> Float[Array, "*batch choice"]:
        """A choice at random, differentiable in all parameters if :data:`REPARAMETRISED`."""
        ...

    def log_prob(self, choice: Float[Array, "*batch choice"]) -> Float[Array, "*batch"]:
        """Log-density of the choice's action (log-probability on the grid)."""
        ...

    def action(self, choice: Float[Array, "*batch choice"]) -> Float[Array, "*batch action"]:
        """What a choice means, in [-1, 1]."""
        ...

    def choice_of(self, action: Float[Array, "*batch action"]) -> Float[Array, "*batch choice"]:
        """The choice that means an action, or comes nearest to it."""
        ...

    def mode(self) -> Float[Array, "*batch action"]:
        """The action that policies take in evaluation."""
        ...

    def mean_action(self) -> Float[Array, "*batch action"]:
        """The mean of the actions."""
        ...

    def entropy_estimate(self, key: Array) -> Float[Array, "*batch"]:
        """The entropy of the action: exact where it has a closed form, else estimated by one sample."""
        ...


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
        """A sample before squashing, ``loc + scale * noise``."""
        return self.loc + self.scale * jax.random.normal(key, self.loc.shape)

    def log_prob(self, choice: Float[Array, "*batch action"]) -> Float[Array, "*batch"]:
        """Log-density of ``tanh(choice)``, with the exact Jacobian ``2 (ln 2 - x - softplus(-2 x))``."""
        z = (choice - self.loc) / self.scale
        gaussian = -0.5 * z * z - jnp.log(self.scale) - 0.5 * math.log(2 * math.pi)
        jacobian = 2.0 * (math.log(2.0) - choice - jax.nn.softplus(-2.0 * choice))
        return jnp.sum(gaussian - jacobian, axis=-1)

    def action(self, choice: Float[Array, "*batch action"]) -> Float[Array, "*batch action"]:
        """The squashed choice."""
        return jnp.tanh(choice)

    def choice_of(self, action: Float[Array, "*batch action"]) -> Float[Array, "*batch action"]:
        """``arctanh``, of actions within +-0.999 (a choice of +-3.8)."""
        return jnp.arctanh(jnp.clip(action, -_SQUASHED, _SQUASHED))

    def mode(self) -> Float[Array, "*batch action"]:
        """The squashed mean, which is the median of the action; its density may peak elsewhere."""
        return jnp.tanh(self.loc)

    def mean_action(self) -> Float[Array, "*batch action"]:
        """The mean of ``tanh``, by Gauss-Hermite quadrature; within 1e-3."""
        nodes = jnp.tanh(self.loc[..., None] + self.scale[..., None] * jnp.asarray(_NODES, jnp.float32))
        return nodes @ jnp.asarray(_WEIGHTS / _WEIGHTS.sum(), jnp.float32)

    def entropy_estimate(self, key: Array) -> Float[Array, "*batch"]:
        """Minus the log-density of one sample: the entropy has no closed form."""
        return -self.log_prob(self.sample(key))


@record
class Beta:
    """``2 x - 1`` of independent ``x ~ Beta(alpha, beta)`` with both above 1, so that there is one peak.

    Attributes:
        alpha, beta: The parameters.
    """

    alpha: Float[Array, "*batch action"]
    beta: Float[Array, "*batch action"]

    @classmethod
    def from_parameters(cls, parameters: Float[Array, "*batch two_actions"]) -> Beta:
        """From a head's output: ``1 + softplus`` of either half."""
        alpha, beta = jnp.split(1.0 + jax.nn.softplus(parameters), 2, axis=-1)
        return cls(alpha, beta)

    def sample(self, key: Array) -> Float[Array, "*batch action"]:
        """A sample in [1e-6, 1 - 1e-6], reparametrised implicitly (Figurnov et al. 2018, arXiv 1805.08498)."""
        return jnp.clip(jax.random.beta(key, self.alpha, self.beta), _EDGE, 1.0 - _EDGE)

    def log_prob(self, choice: Float[Array, "*batch action"]) -> Float[Array, "*batch"]:
        """Log-density of ``2 choice - 1``: that of the choice minus ``ln 2`` for each number."""
        x = jnp.clip(choice, _EDGE, 1.0 - _EDGE)
        density = (self.alpha - 1.0) * jnp.log(x) + (self.beta - 1.0) * jnp.log1p(-x)
        return jnp.sum(density - betaln(self.alpha, self.beta) - math.log(2.0), axis=-1)

    def action(self, choice: Float[Array, "*batch action"]) -> Float[Array, "*batch action"]:
        """``2 choice - 1``."""
        return 2.0 * choice - 1.0

    def choice_of(self, action: Float[Array, "*batch action"]) -> Float[Array, "*batch action"]:
        """``(action + 1) / 2``, within [1e-6, 1 - 1e-6]."""
        return jnp.clip((action + 1.0) / 2.0, _EDGE, 1.0 - _EDGE)

    def mode(self) -> Float[Array, "*batch action"]:
        """Where the density peaks."""
        # Where both are 1 (the uniform distribution) every action is a mode; the middle is taken.
        above = jnp.maximum(self.alpha + self.beta - 2.0, _EDGE)
        return (self.alpha - self.beta) / above

    def mean_action(self) -> Float[Array, "*batch action"]:
        """``(alpha - beta) / (alpha + beta)``."""
        return (self.alpha - self.beta) / (self.alpha + self.beta)

    def entropy_estimate(self, key: Array) -> Float[Array, "*batch"]:
        """The differential entropy of the action, exactly; needs no sample."""
        a, b = self.alpha, self.beta
        peaks = (a - 1.0) * digamma(a) + (b - 1.0) * digamma(b) - (a + b - 2.0) * digamma(a + b)
        return jnp.sum(betaln(a, b) - peaks + math.log(2.0), axis=-1)


@record
class Grid:
    """One of finitely many actions: every combination of levels, the last number of the action counting fastest.

    Attributes:
        logits: Of each combination.
        levels: The levels of each number of the action.
    """

    logits: Float[Array, "*batch combination"]
    levels: tuple[tuple[float, ...], ...] = static()

    def sample(self, key: Array) -> Float[Array, "*batch 1"]:
        """The number of a combination, as a float."""
        return jax.random.categorical(key, self.logits)[..., None].astype(jnp.float32)

    def log_prob(self, choice: Float[Array, "*batch 1"]) -> Float[Array, "*batch"]:
        """Log-probability of a combination."""
        log_probs = jax.nn.log_softmax(self.logits)
        return jnp.take_along_axis(log_probs, choice.astype(jnp.int32), axis=-1)[..., 0]

    def action(self, choice: Float[Array, "*batch 1"]) -> Float[Array, "*batch action"]:
        """The levels of a combination."""
        return self._actions()[choice[..., 0].astype(jnp.int32)]

    def choice_of(self, action: Float[Array, "*batch action"]) -> Float[Array, "*batch 1"]:
        """The combination of the nearest levels."""
        number = jnp.zeros(action.shape[:-1], jnp.int32)
        for axis, levels in enumerate(self.levels):
            nearest = jnp.argmin(jnp.abs(action[..., axis, None] - jnp.asarray(levels)), axis=-1)
            number = number * len(levels) + nearest.astype(jnp.int32)
        return number[..., None].astype(jnp.float32)

    def mode(self) -> Float[Array, "*batch action"]:
        """The likeliest action."""
        return self._actions()[jnp.argmax(self.logits, axis=-1)]

    def mean_action(self) -> Float[Array, "*batch action"]:
        """The mean of the actions."""
        return jax.nn.softmax(self.logits) @ self._actions()

    def entropy_estimate(self, key: Array) -> Float[Array, "*batch"]:
        """The entropy, exactly; needs no sample."""
        log_probs = jax.nn.log_softmax(self.logits)
        return -jnp.sum(jnp.exp(log_probs) * log_probs, axis=-1)

    def _actions(self) -> Float[Array, "combination action"]:
        return jnp.asarray(combinations(self.levels))


@record
class Mixture:
    """``tanh`` of one of several diagonal Gaussians (mixture density network; Bishop 1994): it can have several modes.

    Its samples have no gradient in the shares of the parts.

    Attributes:
        logits: Of each part's share.
        parts: The Gaussians, side by side.
    """

    logits: Float[Array, "*batch part"]
    parts: SquashedGaussian

    @classmethod
    def from_parameters(cls, parameters: Float[Array, "*batch parameters"]) -> Mixture:
        """From a head's output: logits, then each part as :meth:`SquashedGaussian.from_parameters` reads it."""
        logits, rest = jnp.split(parameters, [_PARTS], axis=-1)
        return cls(logits, SquashedGaussian.from_parameters(rest.reshape(*rest.shape[:-1], _PARTS, -1)))

    def sample(self, key: Array) -> Float[Array, "*batch action"]:
        """A sample of one of the parts, before squashing."""
        which_key, noise_key = jax.random.split(key)
        which = jax.random.categorical(which_key, self.logits)
        return _part(self.parts.sample(noise_key), which)

    def log_prob(self, choice: Float[Array, "*batch action"]) -> Float[Array, "*batch"]:
        """Log of the weighted sum of the parts' densities."""
        shares, sample = jax.nn.log_softmax(self.logits), choice[..., None, :]
        each = jnp.broadcast_to(sample, jnp.broadcast_shapes(sample.shape, self.parts.loc.shape))
        return jax.nn.logsumexp(shares + self.parts.log_prob(each), axis=-1)

    def action(self, choice: Float[Array, "*batch action"]) -> Float[Array, "*batch action"]:
        """The squashed choice."""
        return jnp.tanh(choice)

    def choice_of(self, action: Float[Array, "*batch action"]) -> Float[Array, "*batch action"]:
        """As of the Gaussian."""
        return jnp.arctanh(jnp.clip(action, -_SQUASHED, _SQUASHED))

    def mode(self) -> Float[Array, "*batch action"]:
        """The squashed mean of the part with the largest share."""
        return _part(self.parts.mode(), jnp.argmax(self.logits, axis=-1))

    def mean_action(self) -> Float[Array, "*batch action"]:
        """The mean of the parts' means; within 1e-3."""
        return jnp.sum(jax.nn.softmax(self.logits)[..., None] * self.parts.mean_action(), axis=-2)

    def entropy_estimate(self, key: Array) -> Float[Array, "*batch"]:
        """Minus the log-density of one sample: the entropy has no closed form."""
        return -self.log_prob(self.sample(key))


def _part(values: Float[Array, "*batch part action"], which: Int[Array, "*batch"]) -> Array:
    return jnp.take_along_axis(values, which[..., None, None], axis=-2)[..., 0, :]


def combinations(levels: tuple[tuple[float, ...], ...]) -> Float[np.ndarray, "combination action"]:
    """Every combination of levels, the last axis counting fastest."""
    axes = np.meshgrid(*(np.asarray(axis, np.float32) for axis in levels), indexing="ij")
    return np.stack([axis.ravel() for axis in axes], axis=-1)


def parameters_of(kind: DistributionName, actions: Actions) -> int:
    """How many numbers a head gives for a distribution.

    Raises:
        UsageError: If a grid is asked for where actions have no levels.
    """
    if kind == "grid":
        return len(combinations(_levels(actions)))
    return _PARTS * (1 + 2 * actions.size) if kind == "mixture" else 2 * actions.size


def first_parameters(
    kind: DistributionName, actions: Actions, scale: float
) -> Float[np.ndarray, " parameters"]:
    """Parameters of a distribution around zero with a standard deviation.

    Args:
        kind: Which.
        actions: What it is over.
        scale: Of the unsquashed Gaussian; of the Beta's action; on the grid, of the Gaussian whose density gives the
            levels their probabilities; of each part of a mixture, whose means begin up to so far from zero.

    Raises:
        UsageError: If a Beta cannot be so wide.
    """
    if kind == "grid":
        return (-0.5 * (combinations(_levels(actions)) / scale) ** 2).sum(axis=-1)
    spread = math.log(math.expm1(scale))
    if kind == "gaussian":
        return np.repeat(np.array([0.0, spread], np.float32), actions.size)
    if kind == "mixture":
        # Equal parts would stay equal; the part around zero starts as the largest.
        means = np.linspace(-scale, scale, _PARTS)
        parts = [np.repeat([mean, spread], actions.size) for mean in means]
        return np.concatenate([(means == 0.0).astype(float), *parts]).astype(np.float32)
    # A symmetric Beta's action has the variance 1 / (2 alpha + 1).
    above = (scale**-2 - 1.0) / 2.0 - 1.0
    if above <= 0.0:
        raise UsageError(f"a Beta of first_scale {scale:g} has no peak", cure="use less than 0.577")
    # ln(e^x - 1) without overflow.
    return np.full(2 * actions.size, above + math.log(-math.expm1(-above)), np.float32)


def distribution(
    kind: DistributionName, parameters: Float[Array, "*batch parameters"], actions: Actions
) -> Distribution:
    """The distribution that a head's output means."""
    if kind == "grid":
        return Grid(parameters, _levels(actions))
    made = {"gaussian": SquashedGaussian, "beta": Beta, "mixture": Mixture}[kind]
    return made.from_parameters(parameters)


def _levels(actions: Actions) -> tuple[tuple[float, ...], ...]:
    if actions.levels is None:
        raise UsageError("the grid needs actions with levels", cure="choose the action space 'discrete'")
    return actions.levels
