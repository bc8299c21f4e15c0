"""Replay buffer: a ring of transitions, stored as states or as observations.

A state takes 0.4 kB in log traffic, more with the number of vehicles in reactive traffic (2 to 4 kB in the built-in
world), and is observed whenever it is sampled, twice per transition. An observation in bfloat16 takes 1.2 kB (preset
``sac``) to 44 kB (``published/sac``).

A row holds one step of all environments. Its successor is the next row; the final state of an episode is in the row
that resets the environment. The newest row has no successor yet and is not sampled.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.checks import check_at_most
from drivax.errors import UsageError
from drivax.learning.environment import Environment, Environments, Rollout, Store
from drivax.learning.program import device_count, read_columns
from drivax.rl.equations import n_step_returns
from drivax.scenario.record import record, static

#: Largest number of steps of a buffer; the published one has a million.
MOST_CAPACITY = 100_000_000
#: Environments of a row that are counted together to draw from the buffer.
_BLOCK = 8


@dataclass(frozen=True)
class ReplayConfig:
    """Size and format of the replay buffer.

    Attributes:
        capacity: Steps over all environments; new steps replace the oldest.
        store: ``state``, or ``observation`` in bfloat16, which takes less time and, in log traffic, more memory.
    """

    capacity: int = 100_000
    store: Store = "state"

    def __post_init__(self) -> None:
        check_at_most(self, MOST_CAPACITY, "capacity")

    def rows(self, environments: int) -> int:
        """Return the number of rows.

        Raises:
            UsageError: There are fewer than two, for a step and its successor.
        """
        rows = self.capacity // environments
        if rows < 2:
            problem = f"replay capacity of {self.capacity} steps is too small for {environments} environments"
            raise UsageError(problem, cure=f"set replay.capacity to {2 * environments} or more")
        return rows


@record
class Replay:
    """Contents of the buffer ``[row, environment]``.

    Attributes:
        stored: States, or observations in bfloat16, according to ``store``.
        action: Actions in [-1, 1].
        reward: Rewards.
        terminated: Whether the episode ended by a failure.
        alive: Whether the entry is a step; false where an episode was over before it, or nothing is written yet.
        next_row: Row to write next: the oldest, once the ring is full.
    """

    #: The axis that counts environments, which several devices divide.
    environment_axis: ClassVar[int] = 1

    stored: Any
    action: Float[Array, "*batch row environment D"]
    reward: Float[Array, "*batch row environment"]
    terminated: Bool[Array, "*batch row environment"]
    alive: Bool[Array, "*batch row environment"]
    next_row: Int[Array, "*batch"]
    store: Store = static()


#: Rows and environments of drawn steps.
ReplayIndex = tuple[Int[Array, "..."], Int[Array, "..."]]


@record
class Transitions:
    """A batch of transitions over one step or up to n steps.

    Attributes:
        reward: Discounted sum of the rewards of these steps, which belong to one episode.
        terminated: Whether the episode ended by a failure within these steps.
        next_observation: Observation after these steps, final states included.
        discount: ``gamma`` to the power of the number of these steps (of decisions, where they are held).
    """

    observation: dict[str, Array]
    action: Float[Array, "*batch D"]
    reward: Float[Array, "*batch"]
    terminated: Bool[Array, "*batch"]
    next_observation: dict[str, Array]
    discount: Float[Array, "*batch"]


@dataclass(frozen=True)
class ReplayBuffer:
    """Pure functions over a :class:`Replay`, in the environment whose states it stores."""

    config: ReplayConfig
    environment: Environment

    def init(self, environments: Environments) -> Replay:
        """Return an empty buffer for these environments."""
        count = environments.over.shape[0]
        rows = self.config.rows(count)
        if self.config.store == "observation":
            template = _cast(environments.observation, jnp.bfloat16)
        else:
            template = self.environment.stored(environments.state)
        return Replay(
            stored=jax.tree.map(lambda leaf: jnp.zeros((rows, *leaf.shape), leaf.dtype), template),
            action=jnp.zeros((rows, count, self.environment.action_size)),
            reward=jnp.zeros((rows, count)),
            terminated=jnp.zeros((rows, count), jnp.bool_),
            alive=jnp.zeros((rows, count), jnp.bool_),
            next_row=jnp.zeros((), jnp.int32),
            store=self.config.store,
        )

    def add(self, replay: Replay, rollout: Rollout) -> Replay:
        """Write a rollout over the oldest rows.

        The rollout must continue the last one, keep states or observations according to ``store``, and have raw actions
        in [-1, 1].

        Raises:
            UsageError: It has more steps than the buffer has rows.
        """
        rows, steps = replay.reward.shape[0], rollout.reward.shape[0]
        if steps > rows:
            problem = f"{steps} steps do not fit a replay buffer of {rows} rows"
            raise UsageError(problem, cure=f"set replay.capacity to {steps * replay.reward.shape[1]} or more")
        observation = rollout.observation
        stored = rollout.state if observation is None else _cast(observation, jnp.bfloat16)
        new = {"stored": stored, "action": rollout.raw_action}
        new |= {name: getattr(rollout, name) for name in ("reward", "terminated", "alive")}
        old = {name: getattr(replay, name) for name in new}
        index = (replay.next_row + jnp.arange(steps)) % rows
        columns = jax.tree.map(lambda ring, values: ring.at[index].set(values), old, new)
        return replace(replay, **columns, next_row=(replay.next_row + steps) % rows)

    def draw(self, replay: Replay, key: Array, shape: tuple[int, ...]) -> ReplayIndex:
        """Draw steps uniformly, with replacement, among those with a successor, of which there must be at least one.

        Call it once for all batches of an iteration, because it reads every row.
        """
        rows, environments = replay.reward.shape
        newest = (replay.next_row - 1) % rows
        # Blocks of neighbouring environments of one device: a running count over all steps is slower.
        size = math.gcd(environments, environments // device_count(), _BLOCK)
        sampleable = (replay.alive & (jnp.arange(rows) != newest)[:, None]).reshape(rows, -1, size)
        counts = sampleable.sum(axis=-1, dtype=jnp.int32).reshape(-1)
        running = jnp.cumsum(counts)
        # The n-th sampleable step is where the running count first exceeds n: over blocks, then within the block.
        rank = jax.random.randint(key, shape, 0, jnp.maximum(running[-1], 1))
        block = jnp.searchsorted(running, rank, side="right").astype(jnp.int32)
        rank_in_block = rank - (running - counts)[block]
        count_in_block = jnp.cumsum(sampleable.reshape(-1, size)[block], axis=-1, dtype=jnp.int32)
        position = jnp.argmax(count_in_block > rank_in_block[..., None], axis=-1).astype(jnp.int32)
        step = block * size + position
        return step // environments, step % environments

    def sample(
        self, data: Any, replay: Replay, index: ReplayIndex, gamma: float, steps: int = 1
    ) -> Transitions:
        """Return the transitions over up to ``steps`` steps from an index of :meth:`draw`.

        They have fewer steps where the episode ends or the next state is not written yet.
        """
        rows = replay.reward.shape[0]

        def read(ring: dict[str, Any], row: Array, column: Array) -> dict[str, Any]:
            window = (row + jnp.arange(steps).reshape(-1, *[1] * row.ndim)) % rows
            names = ("reward", "terminated", "alive")
            reward, terminated, alive = (ring[name][window, column] for name in names)
            # A row that resets an environment, or the newest, ends the window.
            follows = alive & (window != (replay.next_row - 1) % rows)
            returns = n_step_returns(reward, terminated, follows, gamma)
            successor = (row + returns.steps) % rows
            return {
                "observation": jax.tree.map(lambda leaf: leaf[row, column], ring["stored"]),
                "action": ring["action"][row, column],
                "reward": returns.reward,
                "terminated": returns.terminated,
                "next_observation": jax.tree.map(lambda leaf: leaf[successor, column], ring["stored"]),
                "discount": returns.discount,
            }

        def observe(sampled: Any) -> dict[str, Array]:
            if replay.store == "state":
                return self.environment.observe_all(data, sampled)
            return _cast(sampled, jnp.float32)

        ring = {name: getattr(replay, name) for name in ("stored", "action", "reward", "terminated", "alive")}
        columns = read_columns(read, ring, *index)
        observed = {name: observe(columns[name]) for name in ("observation", "next_observation")}
        return Transitions(**columns | observed)


def _cast(observation: dict[str, Array], dtype: Any) -> dict[str, Array]:
    """Cast floating-point arrays; masks keep their type."""
    return {
        name: value.astype(dtype) if jnp.issubdtype(value.dtype, jnp.floating) else value
        for name, value in observation.items()
    }
