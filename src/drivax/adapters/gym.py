"""Gymnasium environments over scenarios: numpy in, numpy out.

For libraries that expect the Gymnasium interface. ``VectorDrivingEnv`` steps a batch in one compiled call. Your own
loop under ``vmap`` and ``scan`` (``docs/start/own_loop.md``) is faster: no array leaves the device. Importing this
module registers ``drivax/<task>-v0`` for every name in :data:`TASKS`.
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

from drivax.errors import DrivaxError, UsageError, did_you_mean, explain_missing_package
from drivax.learning.policies import find_traffic
from drivax.metrics.episode import episode_metrics
from drivax.report.pictures.drawing import draw_pixels
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

with explain_missing_package():
    import gymnasium
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space

#: Bound to which observations are clipped (5 km, 1.5 km/s), user-defined groups too, so that spaces are bounded.
LIMIT = 100.0


@runtime_checkable
class Scenarios(Protocol):
    """Scenarios on the device and as stored, as returned by ``drivax.load``."""

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


def _load(data: Scenarios | str | Path | int) -> tuple[ScenarioBank, list[str], Sequence[Scenario]]:
    """Return bank, ids and stored scenarios of loaded data, a set's folder, or a number of scenarios to generate."""
    if isinstance(data, int | str | Path):
        scenarios: Sequence[Scenario]
        if isinstance(data, int):
            if data < 1:
                raise UsageError(f"{data} scenarios to generate", cure="use 1 or more")
            scenarios = [assemble(generate_recording(seed=0, index=index)) for index in range(data)]
        else:
            scenarios = ScenarioSet.open(data)
        return ScenarioBank.from_scenarios(scenarios), [scenario.id for scenario in scenarios], scenarios
    if len(data.names) != len(data.bank):
        raise DrivaxError(f"{len(data.names)} scenario names for a bank of {len(data.bank)}")
    return data.bank, [name["scenario_id"] for name in data.names], data.scenarios


@partial(jax.jit, static_argnums=0)
def _reset(simulator: Simulator, bank: ScenarioBank, row: Any) -> tuple[SimState, dict[str, Array]]:
    """Return the initial state of an episode and its observation."""
    state = simulator.reset(bank, row)
    return state, _observe(simulator, bank, state)


@partial(jax.jit, static_argnums=0)
def _reset_all(simulator: Simulator, bank: ScenarioBank, rows: Any) -> tuple[SimState, dict[str, Array]]:
    """Return the initial states of a batch of episodes and their observations."""
    return jax.vmap(partial(_reset, simulator, bank))(rows)


@partial(jax.jit, static_argnums=0)
def _step(
    simulator: Simulator, bank: ScenarioBank, state: SimState, action: Float[Any, " D"]
) -> tuple[SimState, dict[str, Array], tuple[Array, Array, Array]]:
    """Return state, observation, and (reward, terminated, truncated)."""
    state, transition = simulator.step(bank, state, jnp.asarray(action))
    outcome = (transition.reward, transition.terminated, transition.truncated)
    return state, _observe(simulator, bank, state), outcome


@partial(jax.jit, static_argnums=0)
def _step_all(
    simulator: Simulator, bank: ScenarioBank, states: SimState, actions: Float[Any, "B D"],
    done: Bool[Any, " B"], rows: Any,
) -> tuple[SimState, dict[str, Array], tuple[Array, Array, Array]]:  # fmt: skip
    """Step a batch; where the last episode is ``done``, begin one in the scenario of ``rows`` with reward 0."""
    done = jnp.asarray(done)
    starts = map_where(done, partial(simulator.new_episode, bank), jnp.asarray(rows))
    step = jax.vmap(simulator.step_or_reset, in_axes=(None, 0, 0, 0, 0))
    states, transition = step(bank, states, jnp.asarray(actions), done, starts)
    reward = jnp.where(done, 0.0, transition.reward)
    observations = jax.vmap(partial(_observe, simulator, bank))(states)
    return states, observations, (reward, transition.terminated, transition.truncated)


_metrics = jax.jit(episode_metrics)
_metrics_all = jax.jit(jax.vmap(episode_metrics, in_axes=(None, 0)))


def _observe(simulator: Simulator, bank: ScenarioBank, state: SimState) -> dict[str, Array]:
    """Return the observation within the bounds of its space, without empty groups."""
    groups = simulator.observe(bank, state.context)
    return {
        name: leaf.astype(jnp.int8) if leaf.dtype == bool else jnp.clip(leaf, -LIMIT, LIMIT)
        for name, leaf in groups.items()
        if leaf.size
    }


#: Number of scenarios to generate for an environment without data.
DEFAULT_SCENARIOS = 16
#: Tasks by the name in their id, ``drivax/<name>-v0``.
TASKS: dict[str, Task] = {name: Task(observation=preset) for name, preset in PRESETS.items()} | {
    "behaviour": Task(rewards=RewardConfig(preset="behaviour")),
    "discrete": Task(actions=DISCRETE),
}
Observation = dict[str, Any]


class _Backend:
    """Scenarios on the CPU, simulator and spaces of an environment; both classes of environments use it."""

    def __init__(
        self,
        data: Scenarios | str | Path | int,
        task: Task | None,
        traffic: str | Traffic,
        trust: Sequence[str],
    ) -> None:
        bank, self.ids, self.scenarios = _load(data)
        self.task = task or Task()
        if self.task.hold > 1:
            cure = "set hold to 1 and repeat the action"
            raise UsageError(f"the task holds decisions for {self.task.hold} steps", cure=cure)
        model = find_traffic(traffic, trust) if isinstance(traffic, str) else traffic
        self.simulator = Simulator(self.task, model)
        cpu = jax.devices("cpu")[0]
        self.bank = jax.device_put(prepare_bank(self.simulator.traffic, bank), cpu)
        self.actions = action_space(self.task)
        _, groups = jax.eval_shape(partial(_reset, self.simulator), self.bank, 0)
        self.observations = observation_space(groups)

    def check_row(self, scenario: Any) -> int:
        """Return ``scenario`` as a row of the bank, or raise an error if it is not one."""
        try:
            row = operator.index(scenario)
        except TypeError:
            row = -1
        if not 0 <= row < len(self.ids):
            cure = f"use a row from 0 to {len(self.ids) - 1}"
            raise UsageError(f"unknown scenario {scenario!r}", cure=cure)
        return row

    def convert_actions(self, actions: Any, lead: tuple[int, ...]) -> Float[Any, "*lead D"]:
        """Return checked actions ``[*lead, D]`` of the simulator; choices become the levels of ``Discrete``.

        Values beyond [-1, 1] pass: the simulator clips them.
        """
        space = self.task.actions
        try:
            values = np.asarray(actions, None if isinstance(space, Discrete) else np.float32)
        except (TypeError, ValueError):  # strings, or rows of different lengths
            values = np.array(None)  # refused below
        if isinstance(space, Discrete):
            choices = values
            is_index = choices.dtype.kind in "iu" and choices.shape == lead
            if not is_index or ((choices < 0) | (choices >= space.choices)).any():
                cure = f"give choices from 0 to {space.choices - 1}"
                cure += f", one for each of {lead[0]} environments" if lead else ""
                raise UsageError(f"{actions!r} is not an action", cure=cure)
            accelerations, curvatures = (np.asarray(level) for level in space.levels())
            row, column = np.divmod(choices, space.curvatures)
            return np.stack([accelerations[row], curvatures[column]], axis=-1).astype(np.float32)
        shape = (*lead, space.size)
        if values.shape != shape or not np.isfinite(values).all():
            cure = f"give {' x '.join(map(str, shape))} finite numbers in [-1, 1]"
            raise UsageError(f"{actions!r} is not an action", cure=cure)
        return values


class DrivingEnv(gymnasium.Env[Observation, Any]):
    """Drive ego from the current step of a scenario to the end of its log, one episode at a time.

    Observations are the task's groups that are not empty: ``Box`` for features, clipped to [-100, 100], ``MultiBinary``
    for masks (1 for a valid row). Actions are the task's, in [-1, 1], or ``Discrete`` choices. A failure that ends the
    episode is ``terminated``, the end of log or map is ``truncated``. ``info`` has ``scenario_id`` and, after the last
    step, ``metrics``: all defined episode metrics. The simulation runs on the CPU.

    Args:
        data: Result of ``drivax.load``, folder of a scenario set, or number of scenarios to generate.
        task: Action space, observation, reward and termination; by default ``Task()``. Its ``conditions`` keep the
            values of evaluation.
        render_mode: ``rgb_array`` draws the scenario from above (needs the extra ``show``).
        traffic: Model of the other agents: ``log``, ``idm``, the folder of a trained policy, ``zoo:NAME``,
            ``package.module:name``, or a traffic model.
        trust: Modules outside drivax whose code a policy in the traffic may name.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 (Gymnasium's own spelling)

    def __init__(
        self, data: Scenarios | str | Path | int = DEFAULT_SCENARIOS, task: Task | None = None,
        render_mode: str | None = None, traffic: str | Traffic = "log", trust: Sequence[str] = (),
    ) -> None:  # fmt: skip
        self._backend = _Backend(data, task, traffic, trust)
        self._state: SimState | None = None
        self._row, self._path = 0, np.zeros((0, 4), np.float32)
        self.render_mode = _check_render_mode(render_mode)
        self.action_space = self._backend.actions
        self.observation_space = self._backend.observations

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seed of the random choice of scenarios.
            options: ``{"scenario": i}`` chooses row i; by default rows are drawn uniformly.

        Raises:
            UsageError: Unknown option or row.
        """
        super().reset(seed=seed)
        backend, scenario = self._backend, _option(options, "scenario")
        if scenario is None:
            self._row = int(self.np_random.integers(len(backend.ids)))
        else:
            self._row = backend.check_row(scenario)
        state, observation = _reset(backend.simulator, backend.bank, self._row)
        self._state, self._path = state, _ego_path(state.context)
        return _to_numpy(observation), {"scenario_id": backend.ids[self._row]}

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Step the simulation by 0.1 s.

        Raises:
            UsageError: The action has the wrong shape, is not finite, or is not a choice of ``Discrete``.
            gymnasium.error.ResetNeeded: No episode is running.
        """
        if self._state is None:
            raise gymnasium.error.ResetNeeded("no episode is running; call reset() first")
        backend, command = self._backend, self._backend.convert_actions(action, ())
        state, observation, outcome = _step(backend.simulator, backend.bank, self._state, command)
        self._state = state
        if self.render_mode is not None:
            self._path = _ego_path(state.context, self._path)
        reward, terminated, truncated = (leaf.item() for leaf in jax.device_get(outcome))
        info: dict[str, Any] = {"scenario_id": backend.ids[self._row]}
        if terminated or truncated:
            metrics = jax.device_get(_metrics(backend.bank, state))
            info["metrics"] = {name: float(v.value) for name, v in metrics.items() if v.defined}
            self._state = None
        return _to_numpy(observation), reward, terminated, truncated, info

    def render(self) -> Any:
        """Return a picture of the scenario from above, ``[height, width, 3]`` bytes; None without a render mode."""
        if self.render_mode is None:
            return None
        if not len(self._path):
            raise gymnasium.error.ResetNeeded("there is nothing to draw yet; call reset() first")
        return draw_pixels(self._backend.scenarios[self._row], self._path)


class VectorDrivingEnv(VectorEnv):
    """Step ``num_envs`` :class:`DrivingEnv` in one compiled call; the other arguments are the same.

    Autoreset is Gymnasium's ``NEXT_STEP``: after the last step of an episode, the next step checks but does not execute
    the environment's action, and starts its next episode with reward 0. ``info`` has ``scenario_id`` of every
    environment and, for episodes that end, ``metrics`` as arrays with ``_metrics`` masks. ``render`` returns one
    picture per environment.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["rgb_array"], "render_fps": 10, "autoreset_mode": AutoresetMode.NEXT_STEP,
    }  # fmt: skip

    def __init__(
        self, num_envs: int = 1, data: Scenarios | str | Path | int = DEFAULT_SCENARIOS, task: Task | None = None,
        render_mode: str | None = None, traffic: str | Traffic = "log", trust: Sequence[str] = (),
    ) -> None:  # fmt: skip
        if num_envs < 1:
            raise UsageError(f"num_envs is {num_envs}", cure="use 1 or more")
        self._backend = _Backend(data, task, traffic, trust)
        self.num_envs = num_envs
        self.render_mode = _check_render_mode(render_mode)
        self.single_action_space = self._backend.actions
        self.single_observation_space = self._backend.observations
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._state: SimState | None = None
        self._rows = np.zeros(num_envs, np.int32)
        self._done = np.zeros(num_envs, bool)
        self._paths: list[Any] = []

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode in every environment.

        Args:
            seed: Seed of the random choice of scenarios in all environments.
            options: ``{"scenarios": [i, ...]}`` chooses a row per environment.

        Raises:
            UsageError: Unknown option or row, or the numbers of rows and environments differ.
        """
        super().reset(seed=seed)
        backend, scenarios = self._backend, _option(options, "scenarios")
        try:
            rows = self._sample_rows() if scenarios is None else list(scenarios)
        except TypeError as error:
            problem = f"the reset option 'scenarios' is {scenarios!r}"
            raise UsageError(problem, cure=f"give a list of {self.num_envs} rows") from error
        rows = [backend.check_row(row) for row in rows]
        if len(rows) != self.num_envs:
            problem = f"{len(rows)} scenarios for {self.num_envs} environments"
            raise UsageError(problem, cure="give one per environment")
        self._rows = np.array(rows, np.int32)
        self._done[:] = False
        self._state, observation = _reset_all(backend.simulator, backend.bank, self._rows)
        self._extend_paths(np.ones(self.num_envs, bool))
        return _to_numpy(observation), self._info()

    def step(self, actions: Any) -> tuple[Observation, Any, Any, Any, dict[str, Any]]:
        """Step every environment by 0.1 s; if its episode has ended, start the next one instead.

        Raises:
            UsageError: The actions have the wrong shape, are not finite, or are not choices of ``Discrete``.
            gymnasium.error.ResetNeeded: ``reset`` was never called.
        """
        if self._state is None:
            raise gymnasium.error.ResetNeeded("no episode is running; call reset() first")
        backend, done = self._backend, self._done
        commands = backend.convert_actions(actions, (self.num_envs,))
        self._rows = np.where(done, self._sample_rows(), self._rows)
        self._state, observation, outcome = _step_all(
            backend.simulator, backend.bank, self._state, commands, done, self._rows
        )
        reward, terminated, truncated = (np.array(leaf) for leaf in jax.device_get(outcome))
        self._done = terminated | truncated
        self._extend_paths(done)
        info = self._info()
        if self._done.any():
            metrics = jax.device_get(_metrics_all(backend.bank, self._state))
            for env in np.flatnonzero(self._done):
                values = {name: float(v.value[env]) for name, v in metrics.items() if v.defined[env]}
                info = self._add_info(info, {"metrics": values}, int(env))
        return _to_numpy(observation), reward, terminated, truncated, info

    def render(self) -> tuple[Any, ...] | None:
        """Return a picture of every scenario from above; None without a render mode."""
        if self.render_mode is None:
            return None
        if not self._paths:
            raise gymnasium.error.ResetNeeded("there is nothing to draw yet; call reset() first")
        scenarios = [self._backend.scenarios[int(row)] for row in self._rows]
        return tuple(map(draw_pixels, scenarios, self._paths))

    def _sample_rows(self) -> Any:
        return self.np_random.integers(len(self._backend.ids), size=self.num_envs, dtype=np.int32)

    def _info(self) -> dict[str, Any]:
        ids = np.array([self._backend.ids[row] for row in self._rows], object)
        return {"scenario_id": ids, "_scenario_id": np.ones(self.num_envs, bool)}

    def _extend_paths(self, is_new: Any) -> None:
        """Extend the paths of all egos for rendering; those of new episodes start again."""
        if self.render_mode is None or self._state is None:
            return
        paths = self._paths or [None] * self.num_envs
        previous = [None if new else path for path, new in zip(paths, is_new, strict=True)]
        context = self._state.context
        contexts = [jax.tree.map(operator.itemgetter(env), context) for env in range(self.num_envs)]
        self._paths = list(map(_ego_path, contexts, previous))


def make(
    task: str | Task = "optimal", data: Scenarios | str | Path | int = DEFAULT_SCENARIOS, *,
    num_envs: int | None = None, traffic: str | Traffic = "log", render_mode: str | None = None,
    trust: Sequence[str] = (),
) -> DrivingEnv | VectorDrivingEnv:  # fmt: skip
    """Make an environment for a task or a name in :data:`TASKS`, vectorised if ``num_envs`` is given.

    The other arguments are those of :class:`DrivingEnv`.
    """
    if isinstance(task, str):
        if task not in TASKS:
            raise UsageError(f"unknown task {task!r}", cure=did_you_mean(task, TASKS))
        task = TASKS[task]
    if num_envs is None:
        return DrivingEnv(data, task, render_mode, traffic, trust)
    return VectorDrivingEnv(num_envs, data, task, render_mode, traffic, trust)


def _check_render_mode(render_mode: str | None) -> Any:
    if render_mode not in (None, "rgb_array"):
        raise UsageError(f"unknown render mode {render_mode!r}", cure="the only one is 'rgb_array'")
    return render_mode


def _option(options: Mapping[str, Any] | None, name: str) -> Any:
    """Return the value of the only reset option, or None."""
    options = options or {}
    unknown = sorted(set(options) - {name})
    if unknown:
        raise UsageError(f"unknown reset option {unknown[0]!r}", cure=f"the only one is {name!r}")
    return options.get(name)


def action_space(task: Task) -> gymnasium.spaces.Space[Any]:
    """Return the space of a task's actions.

    Raises:
        UsageError: It has no bounds.
    """
    if isinstance(task.actions, DirectState | Trajectory):
        kind = kind_of(type(task.actions))
        raise UsageError(f"{kind} is unbounded and has no space", cure="use another action space")
    if isinstance(task.actions, Discrete):
        return gymnasium.spaces.Discrete(task.actions.choices)
    return gymnasium.spaces.Box(-1.0, 1.0, (task.actions.size,), np.float32)


def observation_space(groups: Mapping[str, Any]) -> gymnasium.spaces.Space[Any]:
    """Return the space of observations with the shapes and types of these groups, without empty ones."""
    return gymnasium.spaces.Dict(
        {
            name: gymnasium.spaces.MultiBinary(leaf.shape)
            if leaf.dtype in (bool, np.int8)
            else gymnasium.spaces.Box(-LIMIT, LIMIT, leaf.shape, np.float32)
            for name, leaf in groups.items()
            if leaf.size
        }
    )


def _to_numpy(observation: Mapping[str, Array]) -> Observation:
    return {name: np.array(leaf) for name, leaf in observation.items()}


def _ego_path(context: AgentContext, previous: Any = None) -> Any:
    """Return ego's motions since the first step of the log ``[step + 1, 4]``, NaN where unknown.

    ``previous`` is the path one step ago, None at the start of an episode.
    """
    history, step = np.asarray(context.history), int(context.step)
    if previous is not None:
        return np.concatenate([previous, history[-1:]])
    recent = history[-min(step + 1, len(history)) :]
    return np.concatenate([np.full((step + 1 - len(recent), 4), np.nan, np.float32), recent])


for _name, _task in TASKS.items():
    gymnasium.register(
        f"drivax/{_name}-v0",
        entry_point="drivax.adapters.gym:DrivingEnv",
        vector_entry_point="drivax.adapters.gym:VectorDrivingEnv",
        kwargs={"task": _task},
    )
