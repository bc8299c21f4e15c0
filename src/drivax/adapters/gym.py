"""A Gymnasium environment over scenarios: one agent, one episode at a time, numpy in and numpy out.

For libraries that expect the Gymnasium interface, and for trying things out. A step costs a call into compiled code,
so a batch under ``vmap`` (``docs/start/own_loop.md``) is faster by orders of magnitude.
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
from jaxtyping import Array, Float

from drivax.errors import DrivaxError, UsageError
from drivax.metrics.episode import episode_metrics
from drivax.metrics.scores import Value
from drivax.scenario.bank import ScenarioBank
from drivax.scenario.store import ScenarioSet
from drivax.simulator.simulator import Simulator
from drivax.simulator.types import SimState
from drivax.tasks.task import Task

try:
    import gymnasium
except ModuleNotFoundError as error:
    raise UsageError("gymnasium is not installed", cure="pip install 'drivax[gym]'") from error

#: Observations are limited to this: 5 km for positions, 1.5 km/s for speeds. Gymnasium wants finite bounds.
LIMIT = 100.0
Observation = dict[str, Any]


@runtime_checkable
class Scenarios(Protocol):
    """Scenarios on the device with their names; what ``drivax.load`` returns."""

    @property
    def bank(self) -> ScenarioBank:
        """The scenarios, stacked."""
        ...

    @property
    def names(self) -> Sequence[Mapping[str, str]]:
        """``scenario_id`` (and more) of each row of the bank."""
        ...


class DrivingEnv(gymnasium.Env[Observation, np.ndarray[Any, Any]]):
    """Drives ego through recorded traffic (``log``), from the current step of a scenario.

    Observations are the task's groups: ``Box`` for features, ``MultiBinary`` for masks (1 where a row is valid).
    Actions are the task's, in [-1, 1]^2. A failure that ends the episode is ``terminated``, the end of log or map is
    ``truncated``. ``info`` holds ``scenario_id`` and, after the last step, ``metrics``: every episode metric that is
    defined. Everything runs on the CPU, whatever else the machine has.

    Args:
        data: What ``drivax.load`` returned, or the folder of a scenario set.
        task: Action space, observation, reward and what ends an episode; the default one otherwise.
    """

    metadata: dict[str, Any] = {"render_modes": [], "render_fps": 10}  # noqa: RUF012 (Gymnasium's own spelling)

    def __init__(self, data: Scenarios | str | Path, task: Task | None = None) -> None:
        bank, self._ids = _opened(data)
        self._bank = jax.device_put(bank, jax.devices("cpu")[0])
        self._simulator = Simulator(task or Task())
        self._state: SimState | None = None
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
        seen = jax.eval_shape(partial(_begin, self._simulator), self._bank, 0)[1]
        self.observation_space = gymnasium.spaces.Dict({name: _space(leaf) for name, leaf in seen.items()})

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
        row = self._row(options or {})
        self._state, observation = _begin(self._simulator, self._bank, row)
        self._id = self._ids[row]
        return _plain(observation), {"scenario_id": self._id}

    def step(self, action: np.ndarray[Any, Any]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Drives 0.1 s.

        Raises:
            UsageError: The action does not have two finite numbers.
            gymnasium.error.ResetNeeded: No episode is under way.
        """
        if self._state is None:
            raise gymnasium.error.ResetNeeded("no episode is under way; call reset() first")
        command = np.asarray(action, np.float32)
        if command.shape != (2,) or not np.isfinite(command).all():
            raise UsageError(f"{action!r} is no action", cure="give two finite numbers in [-1, 1]")
        self._state, observation, ending = _advance(self._simulator, self._bank, self._state, command)
        reward, terminated, truncated = (leaf.item() for leaf in jax.device_get(ending))
        info: dict[str, Any] = {"scenario_id": self._id}
        if terminated or truncated:
            metrics = jax.device_get(_judged(self._bank, self._state))
            info["metrics"] = {name: float(v.value) for name, v in metrics.items() if v.defined}
            self._state = None
        return _plain(observation), reward, terminated, truncated, info

    def _row(self, options: Mapping[str, Any]) -> int:
        unknown = sorted(set(options) - {"scenario"})
        if unknown:
            raise UsageError(f"there is no reset option {unknown[0]!r}", cure="the only one is 'scenario'")
        if "scenario" not in options:
            return int(self.np_random.integers(len(self._ids)))
        try:
            row = operator.index(options["scenario"])
        except TypeError:
            row = -1
        if not 0 <= row < len(self._ids):
            raise UsageError(
                f"there is no scenario {options['scenario']!r}",
                cure=f"use a row from 0 to {len(self._ids) - 1}",
            )
        return row


def _opened(data: Scenarios | str | Path) -> tuple[ScenarioBank, list[str]]:
    if isinstance(data, str | Path):
        stored = list(ScenarioSet.open(data))
        return ScenarioBank.from_scenarios(stored), [scenario.id for scenario in stored]
    if len(data.names) != len(data.bank):
        raise DrivaxError(f"{len(data.names)} scenario names for a bank of {len(data.bank)}")
    return data.bank, [name["scenario_id"] for name in data.names]


def _space(leaf: jax.ShapeDtypeStruct) -> gymnasium.spaces.Space[Any]:
    if leaf.dtype == jnp.int8:
        return gymnasium.spaces.MultiBinary(leaf.shape)
    return gymnasium.spaces.Box(-LIMIT, LIMIT, leaf.shape, np.float32)


@partial(jax.jit, static_argnums=0)
def _begin(simulator: Simulator, bank: ScenarioBank, row: Any) -> tuple[SimState, dict[str, Array]]:
    state = simulator.reset(bank, row)
    return state, _limited(simulator, bank, state)


@partial(jax.jit, static_argnums=0)
def _advance(
    simulator: Simulator, bank: ScenarioBank, state: SimState, action: Float[Any, "2"]
) -> tuple[SimState, dict[str, Array], tuple[Array, Array, Array]]:
    state, transition = simulator.step(bank, state, jnp.asarray(action))
    ending = (transition.reward, transition.terminated, transition.truncated)
    return state, _limited(simulator, bank, state), ending


@jax.jit
def _judged(bank: ScenarioBank, state: SimState) -> dict[str, Value]:
    return episode_metrics(bank, state)


def _limited(simulator: Simulator, bank: ScenarioBank, state: SimState) -> dict[str, Array]:
    """The observation within the bounds of its space; groups without rows are left out."""
    seen = simulator.observe(bank, state.scene)
    return {
        name: leaf.astype(jnp.int8) if leaf.dtype == bool else jnp.clip(leaf, -LIMIT, LIMIT)
        for name, leaf in seen.items()
        if leaf.size
    }


def _plain(observation: Mapping[str, Array]) -> Observation:
    return {name: np.array(leaf) for name, leaf in observation.items()}
