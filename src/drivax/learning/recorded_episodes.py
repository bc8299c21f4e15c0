"""Recorded episodes: evaluations of any planners, as logged steps that offline algorithms learn from.

An evaluation stores the motion and the executed actions of its planner. Before training, every episode is replayed once
with the rewards and episode ends of the training task. Only what observations depend on is kept: some 60 bytes per step
in log traffic, more in reactive traffic.

drivax observes steps when they are drawn, so that one recording serves every observation and reward. Other programs
need the transitions of one task: :class:`StoredEpisodes` hold observations, too.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from drivax.errors import UsageError
from drivax.files import atomic_write
from drivax.learning.driving import BATCH, Driving
from drivax.learning.experience import ExpertSteps, StepIndex
from drivax.planners.simple import logged_motion
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record
from drivax.simulator.simulator import Simulator
from drivax.simulator.types import HISTORY, AgentContext
from drivax.tasks.actions import Route

#: Episodes that are observed at once.
_CHUNK = 64


@record
class RecordedEpisodes:
    """M episodes in the scenarios of a bank, at T steps of the log.

    Attributes:
        bank: The scenarios.
        contexts: Fields of the context (:class:`~drivax.simulator.types.AgentContext`) at these steps, ``[M, T, ...]``,
            without its ``history``.
        motion: x, y (m), heading (rad), speed (m/s) at these steps, and at the ``HISTORY - 1`` steps before the first.
        steps: Actions of the planners and their outcome.
    """

    bank: ScenarioBank
    contexts: dict[str, Any]
    motion: Float[Array, "M times 4"]
    steps: ExpertSteps


@dataclass(frozen=True)
class RecordedDriving(Driving):
    """Recorded episodes as an environment of logged steps; its data are :class:`RecordedEpisodes`."""

    start_step: int = 0

    def shapes(self, data: Any) -> dict[str, tuple[int, ...]]:
        """Return the shape of each group of one observation."""
        return super().shapes(data.bank)

    def expert_steps(self, data: Any) -> ExpertSteps:
        """Return the steps of the episodes."""
        return data.steps

    def observe_recorded(self, data: Any, index: StepIndex) -> dict[str, Array]:
        """Observe steps of the episodes."""
        row, step = index
        values = jax.tree.map(lambda leaf: leaf[row, step], data.contexts)
        history = data.motion[row[..., None], step[..., None] + jnp.arange(HISTORY)]
        return self.observe_all(data.bank, AgentContext(**values, history=history))

    def replay(
        self, bank: ScenarioBank, episode: tuple[Int[Array, ""], Float[Array, "S 4"], Float[Array, "S1 D"]]
    ) -> tuple[dict[str, Any], Float[Array, "times 4"], tuple[Array, ...]]:
        """Replay an episode, which begins as logged.

        Returns contexts and motion from ``start_step`` on, and for each step the action, the reward, the episode ends,
        and whether the action does not lead to the next state: it exceeds the bounds, or reaches them in an exact
        replay of the log, where evaluations clip it.
        """
        index, motion, action = episode
        simulator = Simulator(replace(self.task, metrics="none"), self.simulator.traffic)
        initial = simulator.reset(bank, index, self.start_step)

        def step(state: Any, episode: tuple[Array, Array]) -> tuple[Any, tuple[Any, ...]]:
            motion, action = episode
            after, result = simulator.replay(bank, state, motion, action)
            is_logged = (motion == logged_motion(bank, state.context, 1)).all()
            space = self.task.actions
            # In the space ``route``, the executed action is not in the space of the requested one.
            if isinstance(space, Route):
                action = space.unsteer(bank, state.context, action)
            clipped = space.exceeds_bounds(action)
            action = jnp.clip(action, -1.0, 1.0)
            outcome = (action, result.reward, result.terminated, result.truncated)
            return after, (_without_history(state.context), outcome, clipped, is_logged)

        final, (contexts, outcome, clipped, is_logged) = jax.lax.scan(step, initial, (motion[1:], action))
        last = jax.tree.map(lambda leaf: leaf[None], _without_history(final.context))
        contexts = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), contexts, last)
        clipped |= is_logged.all() & (jnp.abs(outcome[0]) >= 1.0).any(axis=-1)
        return contexts, jnp.concatenate([initial.context.history[:-1], motion]), (*outcome, clipped)


def _without_history(context: AgentContext) -> dict[str, Any]:
    return {field.name: getattr(context, field.name) for field in fields(context) if field.name != "history"}


def replay_episodes(
    environment: RecordedDriving, bank: ScenarioBank, index: Int[Array, " M"], motion: Float[Array, "M S 4"],
    action: Float[Array, "M S1 D"],
) -> RecordedEpisodes:  # fmt: skip
    """Replay all episodes, in batches."""
    # A compiled function that returned the bank would copy it.
    return RecordedEpisodes(bank, *_replay_all(environment, bank, index, motion, action))


@partial(jax.jit, static_argnums=0)
def _replay_all(
    environment: RecordedDriving, bank: ScenarioBank, index: Int[Array, " M"], motion: Float[Array, "M S 4"],
    action: Float[Array, "M S1 D"],
) -> tuple[dict[str, Any], Float[Array, "M times 4"], ExpertSteps]:  # fmt: skip
    """Return contexts, motion and steps of all episodes, as in :class:`RecordedEpisodes`."""
    finite = jnp.isfinite(action).all(axis=-1)
    action = jnp.where(finite[..., None], action, 0.0)
    replay = partial(environment.replay, bank)
    contexts, motion, outcome = jax.lax.map(
        replay, (index, motion, action), batch_size=min(len(index), BATCH)
    )
    start = environment.start_step

    def pad(values: Array, last: int = 0) -> Array:
        """Pad by zeros before the start, and at the last step, which has no successor."""
        return jnp.pad(values, ((0, 0), (start, last), *((0, 0),) * (values.ndim - 2)))

    action, reward, terminated, truncated, clipped = (pad(values, 1) for values in outcome)
    ends, time = terminated | truncated, jnp.arange(action.shape[1])
    over = jnp.cumsum(ends, axis=1) > ends
    is_decision = (time - start) % environment.task.hold == 0
    usable = pad(finite, 1) & ~over & (time >= start)
    steps = ExpertSteps(
        action, reward, terminated, truncated, usable, clipped | ~is_decision, environment.task.hold,
        scenarios=len(bank), scenario=index,
    )  # fmt: skip
    return jax.tree.map(pad, contexts), pad(motion), steps


class StoredEpisode(NamedTuple):
    """An episode of L steps.

    Attributes:
        observation: Observation of each step and after the last one, by group, ``[L + 1, ...]``.
        action: Actions within the bounds, ``[L, D]``.
        reward: Rewards, ``[L]``.
        terminated: Whether a failure ended it; otherwise it was truncated.
        clipped: Steps whose action does not lead to the next state (:class:`ExpertSteps`), ``[L]``.
        scenario: Row of the scenario; -1: unknown.
    """

    observation: dict[str, np.ndarray]
    action: Float[np.ndarray, "L D"]
    reward: Float[np.ndarray, " L"]
    terminated: bool
    clipped: Bool[np.ndarray, " L"]
    scenario: int = -1


@record
class StoredEpisodes:
    """M episodes, padded to T steps.

    Attributes:
        observation: Observation of every step, by group, ``[M, T, ...]``.
        steps: Actions and their outcome.
    """

    observation: dict[str, Array]
    steps: ExpertSteps

    @classmethod
    def of(cls, episodes: Sequence[StoredEpisode]) -> StoredEpisodes:
        """Stack episodes."""
        steps = 1 + max(len(episode.reward) for episode in episodes)

        def stack(values: Iterable[np.ndarray]) -> Array:
            return jnp.asarray(
                np.stack([np.pad(x, [(0, steps - len(x)), *[(0, 0)] * (x.ndim - 1)]) for x in values])
            )

        length = jnp.array([len(episode.reward) for episode in episodes])[:, None]
        last = jnp.arange(steps) == length - 1
        terminated = last & jnp.array([episode.terminated for episode in episodes])[:, None]
        expert = ExpertSteps(
            action=stack(episode.action for episode in episodes),
            reward=stack(episode.reward for episode in episodes),
            terminated=terminated,
            truncated=last & ~terminated,
            usable=jnp.arange(steps) < length,
            clipped=stack(episode.clipped for episode in episodes),
            # Weights of scenarios do not apply to them.
            scenarios=0,
            scenario=jnp.array([episode.scenario for episode in episodes]),
        )
        names = episodes[0].observation
        return cls({name: stack(e.observation[name] for e in episodes) for name in names}, expert)


@dataclass(frozen=True)
class StoredDriving(Driving):
    """Stored episodes of driving as an environment of logged steps; its data are :class:`StoredEpisodes`."""

    def shapes(self, data: Any) -> dict[str, tuple[int, ...]]:
        """Return the shape of each group of one observation."""
        return {name: values.shape[2:] for name, values in data.observation.items()}

    def expert_steps(self, data: Any) -> ExpertSteps:
        """Return the steps of the episodes."""
        return data.steps

    def observe_recorded(self, data: Any, index: StepIndex) -> dict[str, Array]:
        """Return stored observations."""
        return {name: values[index] for name, values in data.observation.items()}


def minari_folder(path: str | Path) -> Path | None:
    """Return the data folder of a Minari data set, given the folder of the set or its data; None for other folders."""
    folders = (Path(path) / "data", Path(path))
    return next((folder for folder in folders if (folder / "metadata.json").is_file()), None)


def match_observations(
    episodes: StoredEpisodes, shapes: Mapping[str, tuple[int, ...]], action_size: int
) -> StoredEpisodes:
    """Return the episodes with exactly the groups of a task's observation: groups of size 0, not stored, are added.

    Raises:
        UsageError: Groups, their shapes or the size of actions differ.
    """
    stored = {name: values.shape[2:] for name, values in episodes.observation.items()}
    expected = {name: shape for name, shape in shapes.items() if 0 not in shape}
    if stored != expected:
        problem = (
            f"observations of the episodes are {_describe(stored)}, those of the task {_describe(expected)}"
        )
        raise UsageError(problem, cure="train with their observation (task.observation)")
    if (size := episodes.steps.action.shape[-1]) != action_size:
        problem = f"actions of the episodes have {size} numbers, those of the task {action_size}"
        raise UsageError(problem, cure="train with their action space (task.actions)")
    batch_shape = episodes.steps.usable.shape
    observation = {
        name: episodes.observation[name] if name in stored else jnp.zeros(batch_shape + shape)
        for name, shape in shapes.items()
    }
    return StoredEpisodes(observation, episodes.steps)


def _describe(shapes: Mapping[str, tuple[int, ...]]) -> str:
    return ", ".join(f"{name} {'x'.join(map(str, shape))}" for name, shape in sorted(shapes.items()))


def observe_episodes(environment: RecordedDriving, recorded: RecordedEpisodes) -> Iterator[StoredEpisode]:
    """Yield recorded episodes with their observations; those without a usable step are left out.

    Raises:
        UsageError: The task holds decisions for several steps.
    """
    if environment.task.hold > 1:
        problem = f"the task holds decisions for {environment.task.hold} steps"
        raise UsageError(problem, cure="record with task.hold 1")
    steps = jax.device_get(recorded.steps)
    count, times = steps.usable.shape
    for begin in range(0, count, _CHUNK):
        rows = np.minimum(np.arange(begin, begin + _CHUNK), count - 1)  # of one shape, to compile once
        observation = jax.device_get(_observe(environment, recorded, jnp.asarray(rows), times))
        for number, row in enumerate(rows[: count - begin]):
            (usable,) = np.nonzero(steps.usable[row])
            if not len(usable):
                continue
            window = np.s_[usable[0] : usable[-1] + 1]
            yield StoredEpisode(
                {name: values[number, usable[0] : usable[-1] + 2] for name, values in observation.items()},
                steps.action[row, window],
                steps.reward[row, window],
                bool(steps.terminated[row, usable[-1]]),
                steps.clipped[row, window],
                int(steps.scenario[row]),
            )


@partial(jax.jit, static_argnums=(0, 3))
def _observe(
    environment: RecordedDriving, recorded: RecordedEpisodes, rows: Array, times: int
) -> dict[str, Array]:
    """Observe all steps of episodes, ``[B, T, ...]``."""
    index = (jnp.repeat(rows, times), jnp.tile(jnp.arange(times), len(rows)))
    observation = environment.observe_recorded(recorded, index)
    return {name: values.reshape(len(rows), times, *values.shape[1:]) for name, values in observation.items()}


def write_npz(out: Path, episodes: Iterable[StoredEpisode]) -> tuple[int, int]:
    """Write the transitions of episodes as a compressed npz file with the names of D4RL.

    ``observations`` and ``next_observations`` are ``[N, F]``: all groups in alphabetical order, each flattened;
    ``layout`` has their shapes by name (JSON). ``actions`` are ``[N, D]``; ``rewards``, ``terminals`` (failures),
    ``timeouts`` (the episode was cut off after this step), ``clipped`` (:class:`StoredEpisode`) and ``scenario`` (row)
    are ``[N]``. Returns the number of episodes and the number N of transitions.
    """
    columns: dict[str, list[np.ndarray]] = {}
    layout, count = {}, 0
    for episode in episodes:
        groups = sorted(episode.observation.items())
        layout = {name: list(values.shape[1:]) for name, values in groups}
        flat = np.concatenate([x.reshape(len(x), -1) for _, x in groups], axis=1, dtype=np.float32)
        last = np.arange(len(episode.reward)) == len(episode.reward) - 1
        values = {
            "observations": flat[:-1],
            "actions": episode.action.astype(np.float32),
            "rewards": episode.reward.astype(np.float32),
            "next_observations": flat[1:],
            "terminals": last & episode.terminated,
            "timeouts": last & (not episode.terminated),
            "clipped": episode.clipped,
            "scenario": np.full(len(last), episode.scenario, np.int32),
        }
        for name, rows in values.items():
            columns.setdefault(name, []).append(rows)
        count += 1
    transitions = sum(map(len, columns.get("rewards", ())))
    arrays = {name: np.concatenate(chunks) for name, chunks in columns.items()}
    with atomic_write(out) as file:
        np.savez_compressed(file, allow_pickle=False, layout=np.array(json.dumps(layout)), **arrays)
    return count, transitions
