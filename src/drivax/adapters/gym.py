"""Gymnasium environments over scenarios: numpy in, numpy out.

For libraries that expect the Gymnasium interface, and for trying things out. ``VectorDrivingEnv`` steps a batch in one
compiled call; an own loop under ``vmap`` and ``scan`` (``docs/start/own_loop.md``) is faster still: nothing leaves the
device between steps. Importing this module registers ``drivax/<task>-v0`` for every name in :data:`TASKS`.
"""

from __future__ import annotations

import operator
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from drivax.adapters.driving import (
    LIMIT,
    Scenarios,
    advance,
    advance_all,
    begin,
    begin_all,
    judged,
    judged_all,
    opened,
)
from drivax.errors import UsageError
from drivax.report.pictures.still import draw_pixels
from drivax.simulator.simulator import Simulator
from drivax.simulator.types import AgentContext, SimState
from drivax.tasks.actions import DISCRETE, DirectState, Discrete
from drivax.tasks.observations import PRESETS
from drivax.tasks.rewards import RewardConfig
from drivax.tasks.task import Task

try:
    import gymnasium
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ModuleNotFoundError as error:
    raise UsageError("gymnasium is not installed", cure="pip install 'drivax[gym]'") from error

#: Scenarios of the built-in world that an environment drives where no data is given.
BUILT_IN = 16
#: Tasks by the name in their id, ``drivax/<name>-v0``.
TASKS: dict[str, Task] = {name: Task(observation=preset) for name, preset in PRESETS.items()} | {
    "behaviour": Task(rewards=RewardConfig(preset="behaviour")),
    "discrete": Task(actions=DISCRETE),
}
Observation = dict[str, Any]


class _Worlds:
    """What both environments share: scenarios on the CPU, a simulator, the spaces of one agent."""

    def __init__(self, data: Scenarios | str | Path | int, task: Task | None) -> None:
        bank, self.ids, self.scenarios = opened(data)
        self.bank = jax.device_put(bank, jax.devices("cpu")[0])
        self.task = task or Task()
        self.simulator = Simulator(self.task)
        self.actions = _action_space(self.task)
        seen = jax.eval_shape(partial(begin, self.simulator), self.bank, 0)[1]
        self.observations = gymnasium.spaces.Dict({name: _space(leaf) for name, leaf in seen.items()})

    def row(self, wanted: Any) -> int:
        """A row of the bank that a user names."""
        try:
            row = operator.index(wanted)
        except TypeError:
            row = -1
        if not 0 <= row < len(self.ids):
            raise UsageError(
                f"there is no scenario {wanted!r}", cure=f"use a row from 0 to {len(self.ids) - 1}"
            )
        return row

    def commands(self, actions: Any, lead: tuple[int, ...]) -> Float[Any, "*lead D"]:
        """Actions of the space as the simulator takes them."""
        space = self.task.actions
        if isinstance(space, Discrete):
            chosen = np.asarray(actions)
            good = chosen.dtype.kind in "iu" and chosen.shape == lead
            if not good or ((chosen < 0) | (chosen >= space.choices)).any():
                raise UsageError(
                    f"{actions!r} is no action", cure=f"give choices from 0 to {space.choices - 1}"
                )
            accelerations, curvatures = (np.asarray(level) for level in space.levels())
            row, column = np.divmod(chosen, space.curvatures)
            return np.stack([accelerations[row], curvatures[column]], axis=-1).astype(np.float32)
        commands = np.asarray(actions, np.float32)
        wanted = (*lead, space.size)
        if commands.shape != wanted or not np.isfinite(commands).all():
            numbers = " x ".join(map(str, wanted))
            raise UsageError(f"{actions!r} is no action", cure=f"give {numbers} finite numbers in [-1, 1]")
        return commands


class DrivingEnv(gymnasium.Env[Observation, Any]):
    """Drives ego through recorded traffic (``log``), from the current step of a scenario, one episode at a time.

    Observations are the task's groups: ``Box`` for features, ``MultiBinary`` for masks (1 where a row is valid).
    Actions are the task's, in [-1, 1], or ``Discrete`` choices. A failure that ends the episode is ``terminated``, the
    end of log or map is ``truncated``. ``info`` holds ``scenario_id`` and, after the last step, ``metrics``: every
    episode metric that is defined. Everything runs on the CPU, whatever else the machine has.

    Args:
        data: What ``drivax.load`` returned, the folder of a scenario set, or how many scenarios of the built-in world.
        task: Action space, observation, reward and what ends an episode; the default one otherwise.
        render_mode: ``rgb_array`` draws the scenario from above (needs the extra ``show``).
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 (Gymnasium's own spelling)

    def __init__(
        self,
        data: Scenarios | str | Path | int = BUILT_IN,
        task: Task | None = None,
        render_mode: str | None = None,
    ) -> None:
        self._worlds = _Worlds(data, task)
        self._state: SimState | None = None
        self._row, self._path = 0, np.zeros((0, 4), np.float32)
        self.render_mode = _known(render_mode)
        self.action_space = self._worlds.actions
        self.observation_space = self._worlds.observations

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begins an episode.

        Args:
            seed: Starts the random choice of scenarios anew.
            options: ``{"scenario": i}`` chooses row i; otherwise a row is drawn, each as likely as any other.

        Raises:
            UsageError: There is no such option or no such row.
        """
        super().reset(seed=seed)
        chosen = _option(options, "scenario")
        worlds = self._worlds
        self._row = int(self.np_random.integers(len(worlds.ids))) if chosen is None else worlds.row(chosen)
        state, observation = begin(worlds.simulator, worlds.bank, self._row)
        self._state = state
        self._path = _path_of(state.context)
        return _plain(observation), {"scenario_id": worlds.ids[self._row]}

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Drives 0.1 s.

        Raises:
            UsageError: The action is not in the action space.
            gymnasium.error.ResetNeeded: No episode is under way.
        """
        if self._state is None:
            raise gymnasium.error.ResetNeeded("no episode is under way; call reset() first")
        worlds = self._worlds
        command = worlds.commands(action, ())
        state, observation, ending = advance(worlds.simulator, worlds.bank, self._state, command)
        self._state = state
        if self.render_mode is not None:
            self._path = _path_of(state.context, self._path)
        reward, terminated, truncated = (leaf.item() for leaf in jax.device_get(ending))
        info: dict[str, Any] = {"scenario_id": worlds.ids[self._row]}
        if terminated or truncated:
            metrics = jax.device_get(judged(worlds.bank, state))
            info["metrics"] = {name: float(v.value) for name, v in metrics.items() if v.defined}
            self._state = None
        return _plain(observation), reward, terminated, truncated, info

    def render(self) -> Any:
        """The scenario from above as ``[height, width, 3]`` bytes; None without a render mode."""
        if self.render_mode is None:
            return None
        if not len(self._path):
            raise gymnasium.error.ResetNeeded("there is nothing to draw yet; call reset() first")
        return draw_pixels(self._worlds.scenarios[self._row], self._path)


class VectorDrivingEnv(VectorEnv):
    """Many :class:`DrivingEnv` in one compiled call.

    Autoreset is Gymnasium's ``NEXT_STEP``: the step after an episode's last one ignores that environment's action,
    begins its next episode and rewards nothing; an episode's last observation is what its last step returned.
    ``info`` holds ``scenario_id`` of every environment and, for those whose episode ended, ``metrics`` as arrays with
    ``_metrics`` masks, as Gymnasium's own vector environments do.

    Args:
        num_envs: How many.
        data: As in :class:`DrivingEnv`.
        task: As in :class:`DrivingEnv`.
        render_mode: As in :class:`DrivingEnv`; ``render`` returns one picture per environment.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["rgb_array"], "render_fps": 10, "autoreset_mode": AutoresetMode.NEXT_STEP,
    }  # fmt: skip

    def __init__(
        self,
        num_envs: int = 1,
        data: Scenarios | str | Path | int = BUILT_IN,
        task: Task | None = None,
        render_mode: str | None = None,
    ) -> None:
        self._worlds = _Worlds(data, task)
        self.num_envs = num_envs
        self.render_mode = _known(render_mode)
        self.single_action_space = self._worlds.actions
        self.single_observation_space = self._worlds.observations
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._state: SimState | None = None
        self._rows = np.zeros(num_envs, np.int32)
        self._over = np.zeros(num_envs, bool)
        self._paths: list[Any] = []

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begins an episode in every environment.

        Args:
            seed: Starts the random choice of scenarios anew; one number for all environments.
            options: ``{"scenarios": [i, ...]}`` chooses a row per environment.

        Raises:
            UsageError: There is no such option or no such row.
        """
        super().reset(seed=seed)
        chosen = _option(options, "scenarios")
        self._rows = (
            self._drawn() if chosen is None else np.array([self._worlds.row(i) for i in chosen], np.int32)
        )
        if self._rows.shape != (self.num_envs,):
            raise UsageError(
                f"{len(self._rows)} scenarios for {self.num_envs} environments",
                cure="give one per environment",
            )
        self._over[:] = False
        self._state, observation = begin_all(self._worlds.simulator, self._worlds.bank, self._rows)
        self._follow(self._over | True)
        return _plain(observation), self._info()

    def step(self, actions: Any) -> tuple[Observation, Any, Any, Any, dict[str, Any]]:
        """Drives 0.1 s everywhere; an environment whose episode is over begins its next one instead.

        Raises:
            UsageError: The actions are not in the action space.
            gymnasium.error.ResetNeeded: ``reset`` was never called.
        """
        if self._state is None:
            raise gymnasium.error.ResetNeeded("no episode is under way; call reset() first")
        worlds, begins = self._worlds, self._over
        commands = worlds.commands(actions, (self.num_envs,))
        self._rows = np.where(begins, self._drawn(), self._rows)
        self._state, observation, ending = advance_all(
            worlds.simulator, worlds.bank, self._state, commands, begins, self._rows
        )
        reward, terminated, truncated = (np.array(leaf) for leaf in jax.device_get(ending))
        self._over = terminated | truncated
        self._follow(begins)
        info = self._info()
        if self._over.any():
            metrics = jax.device_get(judged_all(worlds.bank, self._state))
            for number in np.flatnonzero(self._over):
                own = {n: float(v.value[number]) for n, v in metrics.items() if v.defined[number]}
                info = self._add_info(info, {"metrics": own}, int(number))
        return _plain(observation), reward, terminated, truncated, info

    def render(self) -> tuple[Any, ...] | None:
        """Every scenario from above; None without a render mode."""
        if self.render_mode is None:
            return None
        if not self._paths:
            raise gymnasium.error.ResetNeeded("there is nothing to draw yet; call reset() first")
        scenarios = self._worlds.scenarios
        return tuple(
            draw_pixels(scenarios[int(row)], path) for row, path in zip(self._rows, self._paths, strict=True)
        )

    def _drawn(self) -> Any:
        return self.np_random.integers(len(self._worlds.ids), size=self.num_envs, dtype=np.int32)

    def _info(self) -> dict[str, Any]:
        ids = np.array([self._worlds.ids[row] for row in self._rows], object)
        return {"scenario_id": ids, "_scenario_id": np.ones(self.num_envs, bool)}

    def _follow(self, begins: Any) -> None:
        """Keeps the driven paths where they are drawn."""
        if self.render_mode is None or self._state is None:
            return
        scenes = [jax.tree.map(lambda leaf, n=n: leaf[n], self._state.context) for n in range(self.num_envs)]
        old = self._paths or [None] * self.num_envs
        self._paths = [
            _path_of(context, None if new else path)
            for context, path, new in zip(scenes, old, begins, strict=True)
        ]


def _known(render_mode: str | None) -> Any:
    if render_mode not in (None, "rgb_array"):
        raise UsageError(f"there is no render mode {render_mode!r}", cure="the only one is 'rgb_array'")
    return render_mode


def _option(options: Mapping[str, Any] | None, name: str) -> Any:
    unknown = sorted(set(options or {}) - {name})
    if unknown:
        raise UsageError(f"there is no reset option {unknown[0]!r}", cure=f"the only one is {name!r}")
    return (options or {}).get(name)


def _action_space(task: Task) -> gymnasium.spaces.Space[Any]:
    if isinstance(task.actions, DirectState):
        raise UsageError(
            "direct_state has no bounds that a space could have", cure="use another action space"
        )
    if isinstance(task.actions, Discrete):
        return gymnasium.spaces.Discrete(task.actions.choices)
    return gymnasium.spaces.Box(-1.0, 1.0, (task.actions.size,), np.float32)


def _space(leaf: jax.ShapeDtypeStruct) -> gymnasium.spaces.Space[Any]:
    if leaf.dtype == jnp.int8:
        return gymnasium.spaces.MultiBinary(leaf.shape)
    return gymnasium.spaces.Box(-LIMIT, LIMIT, leaf.shape, np.float32)


def _plain(observation: Mapping[str, Array]) -> Observation:
    return {name: np.array(leaf) for name, leaf in observation.items()}


for _name, _task in TASKS.items():
    gymnasium.register(
        f"drivax/{_name}-v0",
        entry_point="drivax.adapters.gym:DrivingEnv",
        vector_entry_point="drivax.adapters.gym:VectorDrivingEnv",
        kwargs={"task": _task},
    )


def _path_of(context: AgentContext, before: Any = None) -> Any:
    """Return ego's motion from the first step of the log to the present one ``[step + 1, 4]``; NaN where unknown.

    Args:
        context: The present context.
        before: The path one step ago; None where an episode starts.
    """
    history, step = np.asarray(context.history), int(context.step)
    if before is not None:
        return np.concatenate([before, history[-1:]])
    known = history[-min(step + 1, len(history)) :]
    return np.concatenate([np.full((step + 1 - len(known), 4), np.nan, np.float32), known])
