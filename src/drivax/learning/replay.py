"""Replay: a ring of what environments went through, kept as states that are observed when they are sampled.

A state in log traffic is a tenth of its observation, and what is stored is observed by the same function as what is
driven (design, ideas 1 and 4). The price is that every sampled step is observed twice, before and after; ``store:
observation`` keeps observations in bfloat16 instead.

Rows are steps of all environments side by side. What row t led to is in the row behind it, the final state of an
episode in the row that only begins the next one, so nothing is stored twice. The newest row has no row behind it yet
and is not sampled; writing over the oldest row leaves none that leads to it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.errors import UsageError
from drivax.learning.collector import Rollout
from drivax.learning.environment import Environment, Environments
from drivax.scenario.record import record, static

Store = Literal["state", "observation"]


@dataclass(frozen=True)
class ReplayConfig:
    """What is kept for off-policy learning.

    Attributes:
        capacity: Steps that are kept, over all environments; the oldest make room.
        store: ``state``: as little as an observation can be made of; ``observation``: the observation in bfloat16,
            which takes more memory and less time.
    """

    capacity: int = 100_000
    store: Store = "state"

    def rows(self, environments: int) -> int:
        """Rows of the ring.

        Raises:
            UsageError: There is no room for two: a step and what it led to.
        """
        rows = self.capacity // environments
        if rows < 2:
            raise UsageError(
                f"a replay of {self.capacity} steps for {environments} environments",
                cure=f"give it a capacity of at least {2 * environments}",
            )
        return rows


@record
class Replay:
    """The ring ``[row, environment]``.

    Attributes:
        stored: States, or observations in bfloat16.
        action: What was done, in [-1, 1].
        reward: What it earned.
        terminated: The episode ended for good.
        alive: Whether the row is a step; false where it only begins an episode, and where nothing was written yet.
        next_row: Where the next row goes: the oldest, once the ring is full.
        store: What is stored.
        environment_axis: The axis that counts environments; several devices divide it among them.
    """

    environment_axis: ClassVar[int] = 1

    stored: Any
    action: Float[Array, "*batch row environment D"]
    reward: Float[Array, "*batch row environment"]
    terminated: Bool[Array, "*batch row environment"]
    alive: Bool[Array, "*batch row environment"]
    next_row: Int[Array, "*batch"]
    store: Store = static()


#: Rows and environments of steps that were drawn.
Places = tuple[Int[Array, "..."], Int[Array, "..."]]


@record
class Transitions:
    """A batch of steps; ``following`` is the observation of what each led to, final states included."""

    observation: dict[str, Array]
    action: Float[Array, "*batch D"]
    reward: Float[Array, "*batch"]
    terminated: Bool[Array, "*batch"]
    following: dict[str, Array]


def init(config: ReplayConfig, environment: Environment, environments: Environments) -> Replay:
    """An empty replay for these environments."""
    count = environments.over.shape[0]
    rows = config.rows(count)
    like = (
        _floats(environments.observation, jnp.bfloat16)
        if config.store == "observation"
        else environment.stored(environments.state)
    )

    def empty(*shape: int, dtype: Any = jnp.float32) -> Array:
        return jnp.zeros((rows, count, *shape), dtype)

    return Replay(
        stored=jax.tree.map(lambda leaf: jnp.zeros((rows, *leaf.shape), leaf.dtype), like),
        action=empty(environment.action_size),
        reward=empty(),
        terminated=empty(dtype=jnp.bool_),
        alive=empty(dtype=jnp.bool_),
        next_row=jnp.zeros((), jnp.int32),
        store=config.store,
    )


def add(replay: Replay, rollout: Rollout) -> Replay:
    """Writes a rollout of at most as many steps as there are rows over the oldest rows.

    Args:
        replay: The replay.
        rollout: Experience that goes on where the last one stopped, with states or observations as the replay stores;
            the actor's choices are its actions, in [-1, 1].
    """
    rows = replay.reward.shape[0]
    steps = rollout.reward.shape[0]
    if steps > rows:
        raise UsageError(f"{steps} steps for a replay of {rows} rows", cure="give it a larger capacity")
    new = {
        "stored": rollout.state
        if rollout.observation is None
        else _floats(rollout.observation, jnp.bfloat16),
        "action": rollout.choice,
        "reward": rollout.reward,
        "terminated": rollout.terminated,
        "alive": rollout.alive,
    }
    old = {name: getattr(replay, name) for name in new}
    at = (replay.next_row + jnp.arange(steps)) % rows
    written = jax.tree.map(lambda ring, part: ring.at[at].set(part), old, new)
    return replace(replay, **written, next_row=(replay.next_row + steps) % rows)


def draw(replay: Replay, key: Array, shape: tuple[int, ...]) -> Places:
    """Steps to learn from, with replacement: each that has a successor is as likely as any other.

    One call for all batches of an iteration, because it looks at every row. There must be a step with a successor.
    """
    rows, environments = replay.reward.shape
    newest = (replay.next_row - 1) % rows
    counts = replay.alive & (jnp.arange(rows) != newest)[:, None]
    # The n-th step that counts is where the running count first exceeds n.
    running = jnp.cumsum(counts.reshape(-1), dtype=jnp.int32)
    number = jax.random.randint(key, shape, 0, jnp.maximum(running[-1], 1))
    place = jnp.searchsorted(running, number, side="right").astype(jnp.int32)
    return place // environments, place % environments


def sample(environment: Environment, data: Any, replay: Replay, places: Places) -> Transitions:
    """The steps at these places (of :func:`draw`), observed before and after."""
    row, column = places

    def look(row: Array) -> dict[str, Array]:
        kept = jax.tree.map(lambda leaf: leaf[row, column], replay.stored)
        return environment.observe_all(data, kept) if replay.store == "state" else _floats(kept, jnp.float32)

    return Transitions(
        observation=look(row),
        action=replay.action[row, column],
        reward=replay.reward[row, column],
        terminated=replay.terminated[row, column],
        following=look((row + 1) % replay.reward.shape[0]),
    )


def _floats(observation: dict[str, Array], dtype: Any) -> dict[str, Array]:
    """Its numbers in another precision; masks stay."""
    return {
        name: value.astype(dtype) if jnp.issubdtype(value.dtype, jnp.floating) else value
        for name, value in observation.items()
    }
