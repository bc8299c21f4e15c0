"""Gymnasium environments over scenarios: numpy in, numpy out.

For libraries that expect the Gymnasium interface. ``VectorDrivingEnv`` steps a batch in one compiled call; a loop of
your own under ``vmap`` and ``scan`` (``docs/start/own_loop.md``) is faster: nothing leaves the device. Importing
this module registers ``drivax/<task>-v0`` for every name in :data:`TASKS`.
"""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from drivax.errors import DrivaxError, UsageError, did_you_mean, missing_package
from drivax.learning.policies import find_traffic
from drivax.metrics.episode import episode_metrics
from drivax.report.pictures.still import draw_pixels
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.scenario.schema import Scenario
from drivax.scenario.store import ScenarioSet
from drivax.settings.structure import kind_of
from drivax.simulator.simulator import Simulator, map_where
from drivax.simulator.traffic.bank_data import prepare_bank
from drivax.simulator.types import AgentContext, SimState, Traffic
from drivax.synthetic.world import generate_recording
from drivax.tasks.actions import DISCRETE, DirectState, Discrete, Trajectory
from drivax.tasks.observations import PRESETS
from drivax.tasks.rewards import RewardConfig
from drivax.tasks.task import Task

try:
    import gymnasium
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ModuleNotFoundError as error:
    raise missing_package(error) or error from error

#: Observations are clipped to this (5 km, 1.5 km/s): Gymnasium needs finite bounds.
LIMIT = 100.0


@runtime_checkable
class Scenarios(Protocol):
    """Scenarios on the device and as stored, such as those that ``drivax.load`` returns."""

    @property
    def bank(self) -> ScenarioBank:
        """The scenarios, stacked."""
        ...

    @property
    def names(self) -> Sequence[Mapping[str, str]]:
        """``scenario_id`` (and more) of each row of the bank."""
        ...

    @property
    def scenarios(self) -> Sequence[Scenario]:
        """The stored scenarios."""
        ...


def _open(data: Scenarios | str | Path | int) -> tuple[ScenarioBank, list[str], Sequence[Scenario]]:
    """Return bank, ids and stored scenarios of loaded data, a set's folder, or ``data`` generated scenarios."""
    if isinstance(data, int):
        made = [assemble(generate_recording(seed=0, index=index)) for index in range(data)]
        return ScenarioBank.from_scenarios(made), [scenario.id for scenario in made], made
    if isinstance(data, str | Path):
        stored = ScenarioSet.open(data)
        return ScenarioBank.from_scenarios(stored), [scenario.id for scenario in stored], stored
    if len(data.names) != len(data.bank):
        raise DrivaxError(f"{len(data.names)} scenario names for a bank of {len(data.bank)}")
    return data.bank, [name["scenario_id"] for name in data.names], data.scenarios


@partial(jax.jit, static_argnums=0)
def _reset(simulator: Simulator, bank: ScenarioBank, row: Any) -> tuple[SimState, dict[str, Array]]:
    """Return the first state of an episode and its observation."""
    state = simulator.reset(bank, row)
    return state, _observe(simulator, bank, state)


@partial(jax.jit, static_argnums=0)
def _reset_all(simulator: Simulator, bank: ScenarioBank, rows: Any) -> tuple[SimState, dict[str, Array]]:
    """Batched."""
    return jax.vmap(partial(_reset, simulator, bank))(rows)


@partial(jax.jit, static_argnums=0)
def _step(
    simulator: Simulator, bank: ScenarioBank, state: SimState, action: Float[Any, " D"]
) -> tuple[SimState, dict[str, Array], tuple[Array, Array, Array]]:
    """Return state, observation, and (reward, terminated, truncated)."""
    state, transition = simulator.step(bank, state, jnp.asarray(action))
    ending = (transition.reward, transition.terminated, transition.truncated)
    return state, _observe(simulator, bank, state), ending


@partial(jax.jit, static_argnums=0)
def _step_all(
    simulator: Simulator, bank: ScenarioBank, states: SimState, actions: Float[Any, "B D"],
    begins: Bool[Any, " B"], rows: Any,
) -> tuple[SimState, dict[str, Array], tuple[Array, Array, Array]]:  # fmt: skip
    """Step a batch; where an episode ``begins``, start the scenario of ``rows`` instead, with reward 0."""
    begins = jnp.asarray(begins)
    fresh = map_where(begins, partial(simulator.new_episode, bank), jnp.asarray(rows))
    step = jax.vmap(simulator.step_or_reset, in_axes=(None, 0, 0, 0, 0))
    states, transition = step(bank, states, jnp.asarray(actions), begins, fresh)
    reward = jnp.where(begins, 0.0, transition.reward)
    seen = jax.vmap(partial(_observe, simulator, bank))(states)
    return states, seen, (reward, transition.terminated, transition.truncated)


_metrics = jax.jit(episode_metrics)
_metrics_all = jax.jit(jax.vmap(episode_metrics, in_axes=(None, 0)))


def _observe(simulator: Simulator, bank: ScenarioBank, state: SimState) -> dict[str, Array]:
    """Return the observation within the bounds of its space, without empty groups."""
    seen = simulator.observe(bank, state.context)
    return {
        name: leaf.astype(jnp.int8) if leaf.dtype == bool else jnp.clip(leaf, -LIMIT, LIMIT)
        for name, leaf in seen.items()
        if leaf.size
    }


#: Scenarios of the built-in world that an environment drives where no data is given.
BUILT_IN = 16
#: Tasks by the name in their id, ``drivax/<name>-v0``.
TASKS: dict[str, Task] = {name: Task(observation=preset) for name, preset in PRESETS.items()} | {
    "behaviour": Task(rewards=RewardConfig(preset="behaviour")),
    "discrete": Task(actions=DISCRETE),
}
Observation = dict[str, Any]


class _Worlds:
    """Scenarios on the CPU, a simulator, and the spaces of one agent, for both environments."""

    def __init__(self, data: Scenarios | str | Path | int, task: Task | None, traffic: str | Traffic) -> None:
        bank, self.ids, self.scenarios = _open(data)
        self.task = task or Task()
        self.simulator = Simulator(self.task, find_traffic(traffic) if isinstance(traffic, str) else traffic)
        cpu = jax.devices("cpu")[0]
        self.bank = jax.device_put(prepare_bank(self.simulator.traffic, bank), cpu)
        self.actions = _action_space(self.task)
        seen = jax.eval_shape(partial(_reset, self.simulator), self.bank, 0)[1]
        self.observations = gymnasium.spaces.Dict({name: _space(leaf) for name, leaf in seen.items()})

    def row(self, scenario: Any) -> int:
        """Return a requested row of the bank."""
        try:
            row = operator.index(scenario)
        except TypeError:
            row = -1
        if not 0 <= row < len(self.ids):
            cure = f"use a row from 0 to {len(self.ids) - 1}"
            raise UsageError(f"there is no scenario {scenario!r}", cure=cure)
        return row

    def commands(self, actions: Any, lead: tuple[int, ...]) -> Float[Any, "*lead D"]:
        """Return actions in the form of the simulator."""
        space = self.task.actions
        if isinstance(space, Discrete):
            chosen = np.asarray(actions)
            valid = chosen.dtype.kind in "iu" and chosen.shape == lead
            if not valid or ((chosen < 0) | (chosen >= space.choices)).any():
                cure = f"give choices from 0 to {space.choices - 1}"
                raise UsageError(f"{actions!r} is not an action", cure=cure)
            accelerations, curvatures = (np.asarray(level) for level in space.levels())
            row, column = np.divmod(chosen, space.curvatures)
            return np.stack([accelerations[row], curvatures[column]], axis=-1).astype(np.float32)
        commands = np.asarray(actions, np.float32)
        shape = (*lead, space.size)
        if commands.shape != shape or not np.isfinite(commands).all():
            numbers = " x ".join(map(str, shape))
            raise UsageError(
                f"{actions!r} is not an action", cure=f"give {numbers} finite numbers in [-1, 1]"
            )
        return commands


class DrivingEnv(gymnasium.Env[Observation, Any]):
    """Drive ego from the current step of a scenario to the end of its log, one episode at a time.

    Observations are the task's groups: ``Box`` for features, ``MultiBinary`` for masks (1 where a row is valid).
    Actions are the task's, in [-1, 1], or ``Discrete`` choices. A failure that ends the episode is ``terminated``, the
    end of log or map is ``truncated``. ``info`` holds ``scenario_id`` and, after the last step, ``metrics``: all
    defined episode metrics. Everything runs on the CPU.

    Args:
        data: What ``drivax.load`` returned, the folder of a scenario set, or a number of generated scenarios.
        task: Action space, observation, reward and termination; by default ``Task()``.
        render_mode: ``rgb_array`` draws the scenario from above (needs the extra ``show``).
        traffic: How the other agents move: ``log``, ``idm``, the folder of a trained policy, ``zoo:NAME``,
            ``package.module:name``, or a traffic model.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 (Gymnasium's own spelling)

    def __init__(
        self, data: Scenarios | str | Path | int = BUILT_IN, task: Task | None = None,
        render_mode: str | None = None, traffic: str | Traffic = "log",
    ) -> None:  # fmt: skip
        self._worlds = _Worlds(data, task, traffic)
        self._state: SimState | None = None
        self._row, self._path = 0, np.zeros((0, 4), np.float32)
        self.render_mode = _check_render_mode(render_mode)
        self.action_space = self._worlds.actions
        self.observation_space = self._worlds.observations

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seed of the random choice of scenarios.
            options: ``{"scenario": i}`` chooses row i; by default rows are drawn uniformly.

        Raises:
            UsageError: There is no such option or no such row.
        """
        super().reset(seed=seed)
        chosen = _option(options, "scenario")
        worlds = self._worlds
        self._row = int(self.np_random.integers(len(worlds.ids))) if chosen is None else worlds.row(chosen)
        state, observation = _reset(worlds.simulator, worlds.bank, self._row)
        self._state, self._path = state, _path_of(state.context)
        return _plain(observation), {"scenario_id": worlds.ids[self._row]}

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Drive 0.1 s.

        Raises:
            UsageError: The action is not in the action space.
            gymnasium.error.ResetNeeded: No episode is running.
        """
        if self._state is None:
            raise gymnasium.error.ResetNeeded("no episode is running; call reset() first")
        worlds, command = self._worlds, self._worlds.commands(action, ())
        state, observation, ending = _step(worlds.simulator, worlds.bank, self._state, command)
        self._state = state
        if self.render_mode is not None:
            self._path = _path_of(state.context, self._path)
        reward, terminated, truncated = (leaf.item() for leaf in jax.device_get(ending))
        info: dict[str, Any] = {"scenario_id": worlds.ids[self._row]}
        if terminated or truncated:
            metrics = jax.device_get(_metrics(worlds.bank, state))
            info["metrics"] = {name: float(v.value) for name, v in metrics.items() if v.defined}
            self._state = None
        return _plain(observation), reward, terminated, truncated, info

    def render(self) -> Any:
        """Return the scenario from above as ``[height, width, 3]`` bytes; None without a render mode."""
        if self.render_mode is None:
            return None
        if not len(self._path):
            raise gymnasium.error.ResetNeeded("there is nothing to draw yet; call reset() first")
        return draw_pixels(self._worlds.scenarios[self._row], self._path)


class VectorDrivingEnv(VectorEnv):
    """Step ``num_envs`` :class:`DrivingEnv` in one compiled call; the other arguments are the same.

    Autoreset is Gymnasium's ``NEXT_STEP``: the step after the last one of an episode ignores that environment's action
    and starts its next episode with reward 0. ``info`` holds ``scenario_id`` of every environment and, for those whose
    episode ended, ``metrics`` as arrays with ``_metrics`` masks. ``render`` returns one picture per environment.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["rgb_array"], "render_fps": 10, "autoreset_mode": AutoresetMode.NEXT_STEP,
    }  # fmt: skip

    def __init__(
        self, num_envs: int = 1, data: Scenarios | str | Path | int = BUILT_IN, task: Task | None = None,
        render_mode: str | None = None, traffic: str | Traffic = "log",
    ) -> None:  # fmt: skip
        self._worlds = _Worlds(data, task, traffic)
        self.num_envs = num_envs
        self.render_mode = _check_render_mode(render_mode)
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
        """Start an episode in every environment.

        Args:
            seed: Seed of the random choice of scenarios in all environments.
            options: ``{"scenarios": [i, ...]}`` chooses a row per environment.

        Raises:
            UsageError: There is no such option or no such row.
        """
        super().reset(seed=seed)
        chosen = _option(options, "scenarios")
        rows = self._drawn() if chosen is None else [self._worlds.row(scenario) for scenario in chosen]
        self._rows = np.array(rows, np.int32)
        if self._rows.shape != (self.num_envs,):
            problem = f"{len(self._rows)} scenarios for {self.num_envs} environments"
            raise UsageError(problem, cure="give one per environment")
        self._over[:] = False
        self._state, observation = _reset_all(self._worlds.simulator, self._worlds.bank, self._rows)
        self._follow(self._over | True)
        return _plain(observation), self._info()

    def step(self, actions: Any) -> tuple[Observation, Any, Any, Any, dict[str, Any]]:
        """Drive 0.1 s in every environment; one whose episode is over starts its next episode instead.

        Raises:
            UsageError: The actions are not in the action space.
            gymnasium.error.ResetNeeded: ``reset`` was never called.
        """
        if self._state is None:
            raise gymnasium.error.ResetNeeded("no episode is running; call reset() first")
        worlds, begins = self._worlds, self._over
        commands = worlds.commands(actions, (self.num_envs,))
        self._rows = np.where(begins, self._drawn(), self._rows)
        arguments = (worlds.bank, self._state, commands, begins, self._rows)
        self._state, observation, ending = _step_all(worlds.simulator, *arguments)
        reward, terminated, truncated = (np.array(leaf) for leaf in jax.device_get(ending))
        self._over = terminated | truncated
        self._follow(begins)
        info = self._info()
        if self._over.any():
            metrics = jax.device_get(_metrics_all(worlds.bank, self._state))
            for number in np.flatnonzero(self._over):
                own = {n: float(v.value[number]) for n, v in metrics.items() if v.defined[number]}
                info = self._add_info(info, {"metrics": own}, int(number))
        return _plain(observation), reward, terminated, truncated, info

    def render(self) -> tuple[Any, ...] | None:
        """Return every scenario from above; None without a render mode."""
        if self.render_mode is None:
            return None
        if not self._paths:
            raise gymnasium.error.ResetNeeded("there is nothing to draw yet; call reset() first")
        scenarios = [self._worlds.scenarios[int(row)] for row in self._rows]
        return tuple(map(draw_pixels, scenarios, self._paths))

    def _drawn(self) -> Any:
        return self.np_random.integers(len(self._worlds.ids), size=self.num_envs, dtype=np.int32)

    def _info(self) -> dict[str, Any]:
        ids = np.array([self._worlds.ids[row] for row in self._rows], object)
        return {"scenario_id": ids, "_scenario_id": np.ones(self.num_envs, bool)}

    def _follow(self, begins: Any) -> None:
        """Record the driven paths if they are rendered."""
        if self.render_mode is None or self._state is None:
            return
        old = self._paths or [None] * self.num_envs
        before = [None if new else path for path, new in zip(old, begins, strict=True)]
        context = self._state.context
        contexts = [jax.tree.map(operator.itemgetter(number), context) for number in range(self.num_envs)]
        self._paths = list(map(_path_of, contexts, before))


def make(
    task: str | Task = "optimal", data: Scenarios | str | Path | int = BUILT_IN, *, num_envs: int | None = None,
    traffic: str | Traffic = "log", render_mode: str | None = None,
) -> DrivingEnv | VectorDrivingEnv:  # fmt: skip
    """Make an environment of a task, or of a name in :data:`TASKS`; a vector environment if ``num_envs`` is given."""
    if isinstance(task, str):
        if task not in TASKS:
            raise UsageError(f"there is no task {task!r}", cure=did_you_mean(task, TASKS))
        task = TASKS[task]
    if num_envs is None:
        return DrivingEnv(data, task, render_mode, traffic)
    return VectorDrivingEnv(num_envs, data, task, render_mode, traffic)


def _check_render_mode(render_mode: str | None) -> Any:
    if render_mode not in (None, "rgb_array"):
        raise UsageError(f"there is no render mode {render_mode!r}", cure="the only one is 'rgb_array'")
    return render_mode


def _option(options: Mapping[str, Any] | None, name: str) -> Any:
    unknown = sorted(set(options or {}) - {name})
    if unknown:
        raise UsageError(f"there is no reset option {unknown[0]!r}", cure=f"the only one is {name!r}")
    return (options or {}).get(name)


def _action_space(task: Task) -> gymnasium.spaces.Space[Any]:
    if isinstance(task.actions, DirectState | Trajectory):
        kind = kind_of(type(task.actions))
        raise UsageError(f"{kind} is unbounded and has no space", cure="use another action space")
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

    ``before`` is the path one step ago, None where an episode starts.
    """
    history, step = np.asarray(context.history), int(context.step)
    if before is not None:
        return np.concatenate([before, history[-1:]])
    known = history[-min(step + 1, len(history)) :]
    return np.concatenate([np.full((step + 1 - len(known), 4), np.nan, np.float32), known])
