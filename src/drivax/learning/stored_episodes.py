"""Episodes stored with their observations, to exchange them with other programs.

drivax itself observes steps when they are drawn, so that one recording serves every observation and reward. Other
programs need the transitions of one task.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from drivax.errors import UsageError
from drivax.files import atomic_write
from drivax.learning.driving import Driving
from drivax.learning.experience import ExpertSteps, StepIndex
from drivax.learning.recorded_episodes import RecordedDriving, RecordedEpisodes
from drivax.scenario.record import record

#: Episodes that are observed at once.
_CHUNK = 64


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
