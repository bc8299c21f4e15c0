"""The environment protocol, and rollouts of a batch of environments that reset themselves.

``learning.driving`` implements it for scenarios. An environment is configuration only: its data (for driving the
scenario bank) is an argument of every function, and all functions act on a batch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import field
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Float, Int, UInt

from drivax.errors import DataError
from drivax.scenario.record import record


@record
class Environments:
    """State and observation of a batch of environments.

    Where an episode is ``over``, the next step resets the environment or waits (self-play); mask that step.
    """

    #: The axis that counts environments, which several devices divide.
    environment_axis: ClassVar[int] = 0

    state: Any
    over: Bool[Array, "*batch"]
    observation: dict[str, Array]


@record
class Outcome:
    """Result of one step of a batch. Where an environment was over, only ``cache`` is meaningful.

    Attributes:
        reward: Rewards.
        terminated: The episode ended by a failure: bootstrap zero.
        truncated: The episode was cut off: bootstrap the value of the next state.
        cache: :meth:`Environment.cache` of the new state.
        totals: Values to log, summed over environments whose episode was not over: ``"<name>"`` with its count
            ``"<name>/n"``, and ``"reward/<name>"`` over steps. Each is an array of partial sums, of any shape.
        terms: Weighted terms of the reward by name; algorithms read those of ``Environment.penalties``.
    """

    reward: Float[Array, " B"]
    terminated: Bool[Array, " B"]
    truncated: Bool[Array, " B"]
    cache: Any
    totals: dict[str, Array]
    terms: dict[str, Float[Array, " B"]] = field(default_factory=dict)


@runtime_checkable
class Environment(Protocol):
    """An environment that algorithms train in.

    An optional mapping ``penalties`` lets algorithms constrain the reward: it has the terms with a constant negative
    weight, and the absolute values of these weights. An optional method ``past(count) -> PastPolicy`` returns the
    environments that an older copy of the policy drives.
    """

    @property
    def action_size(self) -> int:
        """Number of components of an action; each lies in [-1, 1]."""
        ...

    @property
    def levels(self) -> tuple[tuple[float, ...], ...] | None:
        """Ascending values that each component of an action can take; None if actions are continuous."""
        ...

    def shapes(self, data: Any) -> dict[str, tuple[int, ...]]:
        """Return the shape of each group of one observation; only shapes of the data are read."""
        ...

    def start(self, data: Any, key: Array, count: int) -> Environments:
        """Reset ``count`` environments to staggered steps, so that their episodes end at different times."""
        ...

    def stored(self, state: Any) -> Any:
        """Return the part of states that the replay buffer stores, which suffices to observe them."""
        ...

    def observe_all(self, data: Any, stored: Any) -> dict[str, Array]:
        """Observe a batch of stored states."""
        ...

    def cache(self, data: Any, state: Any) -> Any:
        """Return intermediate results of states that the next step reuses."""
        ...

    def draw(self, data: Any, key: Array, count: int) -> Any:
        """Return the random numbers of a step of ``count`` environments, which do not depend on their states."""
        ...

    def step(
        self, data: Any, now: Environments, cache: Any, action: Float[Array, "B D"], drawn: Any
    ) -> tuple[Environments, Outcome]:
        """Step every environment, or reset it (or wait) where its episode is over, with the result of :meth:`draw`.

        A reset takes a step of its own, so every state that the policy sees, final states included, is observed once.
        """
        ...


class PastPolicy(NamedTuple):
    """Environments ``[n]`` that an older copy of the policy drives; their steps are masked in learning.

    The current policy replaces the copy every ``refresh`` iterations.
    """

    environments: np.ndarray
    refresh: int


def past_policy(environment: Environment, count: int) -> PastPolicy | None:
    """Return those of ``count`` environments that an older copy of the policy drives; None if it drives none."""
    find: Callable[[int], PastPolicy] | None = getattr(environment, "past", None)
    past = None if find is None else find(count)
    return past if past is not None and len(past.environments) else None


@record
class Rollout:
    """Experience ``[time, batch]``. Mask out steps that are not ``alive``: their episode was over before them.

    The successor of row t is in row t + 1, final states included; that of the last row is the environments' current
    state. Either ``observation`` or ``state`` (for the replay buffer) is kept, the other is None. ``terms`` are the
    reward terms that the learner reads.
    """

    observation: dict[str, Array] | None
    state: Any
    raw_action: Float[Array, "*time batch D"]
    extra: dict[str, Array]
    reward: Float[Array, "*time batch"]
    terminated: Bool[Array, "*time batch"]
    truncated: Bool[Array, "*time batch"]
    alive: Bool[Array, "*time batch"]
    terms: dict[str, Float[Array, "*time batch"]] = field(default_factory=dict)


class SampledAction(NamedTuple):
    """A sampled raw action, its action in [-1, 1], and extras to store."""

    raw_action: Array
    action: Array
    extra: dict[str, Array]


_MAX_UINT32 = 2**32 - 1
#: The fields of :class:`SampledAction`. An actor samples them, given observations and a key.
Sampled = tuple[Array, Array, dict[str, Array]]
Actor = Callable[[Mapping[str, Array], Array], Sampled]
#: What a rollout keeps: observations, or states that can be observed again.
Store = Literal["state", "observation"]


def transition(
    environment: Environment, now: Environments, sampled: Sampled, outcome: Outcome,
    keep: Store = "observation", terms: Iterable[str] = (),
) -> Rollout:  # fmt: skip
    """Return one row of a rollout, given the environments before the step, the sampled actions, and the outcome.

    ``terms`` names the reward terms to keep.
    """
    raw_action, _, extra = sampled
    return Rollout(
        observation=now.observation if keep == "observation" else None,
        state=environment.stored(now.state) if keep == "state" else None,
        raw_action=raw_action,
        extra=extra,
        reward=jnp.where(now.over, 0.0, outcome.reward),
        terminated=outcome.terminated,
        truncated=outcome.truncated,
        alive=~now.over,
        terms={name: jnp.where(now.over, 0.0, outcome.terms[name]) for name in terms},
    )


def collect(
    environment: Environment, data: Any, environments: Environments, actor: Actor, key: Array, steps: int,
    keep: Store = "observation", terms: Iterable[str] = (),
) -> tuple[Environments, Rollout, dict[str, Array]]:  # fmt: skip
    """Collect a rollout of ``steps`` steps in every environment.

    Returns:
        The environments afterwards, the rollout, and sums to log: ``Outcome.totals``, the mean absolute action of each
        step (``action_magnitude``) with its count, and the numbers of ``episodes`` that ended and ``steps`` alive.
    """

    def split(key: Array, _: None) -> tuple[Array, tuple[Array, Array]]:
        key, *keys = jax.random.split(key, 3)
        return key, tuple(keys)

    def step(carry: tuple[Environments, Any], random: tuple[Array, Any]) -> tuple[Any, Any]:
        now, cache = carry
        sampled = actor(now.observation, random[0])
        after, outcome = environment.step(data, now, cache, sampled[1], random[1])
        row = transition(environment, now, sampled, outcome, keep, terms)
        magnitude = jnp.where(now.over, 0.0, jnp.abs(sampled[1]).mean(axis=-1))
        return (after, outcome.cache), (row, outcome.totals, after.over & row.alive, magnitude)

    _, (act_keys, step_keys) = jax.lax.scan(split, key, None, steps)
    # Drawn for all steps at once: on CPUs each call of the random generator is a loop of small operations.
    drawn = jax.vmap(lambda key: environment.draw(data, key, len(environments.over)))(step_keys)
    initial = (environments, environment.cache(data, environments.state))
    (environments, _), (rollout, totals, ends, magnitudes) = jax.lax.scan(step, initial, (act_keys, drawn))
    alive = rollout.alive.sum()
    sums = {"episodes": ends.sum(), "steps": alive}
    sums |= {"action_magnitude": magnitudes.sum(), "action_magnitude/n": alive}
    totals |= {name: value.astype(jnp.float32) for name, value in sums.items()}
    return environments, rollout, {name: value.sum() for name, value in totals.items()}


def cumulative_probability(weights: np.ndarray) -> UInt[np.ndarray, " n"]:
    """Return the cumulative probability of weights, in units of ``1 / (2^32 - 1)``.

    Raises:
        DataError: All weights are 0.
    """
    sums = np.cumsum(weights.reshape(-1), dtype=np.float64)
    if not sums[-1] > 0.0:
        raise DataError("all weights are 0", cure="give one a weight above 0")
    return np.floor(sums / sums[-1] * _MAX_UINT32).astype(np.uint32)


def draw_positions(cumulative: UInt[Array, " n"], key: Array, shape: tuple[int, ...]) -> Int[Array, "..."]:
    """Draw positions with replacement, given their cumulative probability; those of probability 0 are never drawn."""
    number = jnp.minimum(jax.random.bits(key, shape, jnp.uint32), jnp.uint32(_MAX_UINT32 - 1))
    return jnp.searchsorted(cumulative, number, side="right").astype(jnp.int32)


@custom_vmap
def any_across_learners(condition: Bool[Array, "*batch"]) -> Bool[Array, ""]:
    """Return whether a condition holds anywhere in the batch and, under ``vmap``, in any learner.

    With a condition per learner, ``jax.lax.cond`` computes both branches; with a single condition, only one of them.
    """
    return condition.any()


@any_across_learners.def_vmap
def _in_any_learner(
    axis_size: int, in_batched: Any, condition: Bool[Array, "*batch"]
) -> tuple[Bool[Array, ""], bool]:
    return any_across_learners(condition.reshape(-1)), False
