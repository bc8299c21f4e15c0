"""What environments outside the graph call: scenarios from wherever they are, and compiled steps, one or a batch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drivax.errors import DrivaxError
from drivax.metrics.episode import episode_metrics
from drivax.metrics.scores import Value
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.scenario.schema import Scenario
from drivax.scenario.store import ScenarioSet
from drivax.simulator.simulator import Simulator
from drivax.simulator.sparse import map_where
from drivax.simulator.types import SimState
from drivax.synthetic.world import generate_recording

#: Observations are limited to this: 5 km for positions, 1.5 km/s for speeds. Gymnasium wants finite bounds.
LIMIT = 100.0


@runtime_checkable
class Scenarios(Protocol):
    """Scenarios on the device and as they are stored; what ``drivax.load`` returns."""

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


def opened(data: Scenarios | str | Path | int) -> tuple[ScenarioBank, list[str], Sequence[Scenario]]:
    """Bank, names and stored scenarios of what ``drivax.load`` returned, a set's folder, or so many of the world."""
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
def begin(simulator: Simulator, bank: ScenarioBank, row: Any) -> tuple[SimState, dict[str, Array]]:
    """The first state of an episode, and what is seen in it."""
    state = simulator.reset(bank, row)
    return state, limited(simulator, bank, state)


@partial(jax.jit, static_argnums=0)
def begin_all(simulator: Simulator, bank: ScenarioBank, rows: Any) -> tuple[SimState, dict[str, Array]]:
    """The same for a batch."""
    return jax.vmap(partial(begin, simulator, bank))(rows)


@partial(jax.jit, static_argnums=0)
def advance(
    simulator: Simulator, bank: ScenarioBank, state: SimState, action: Float[Any, " D"]
) -> tuple[SimState, dict[str, Array], tuple[Array, Array, Array]]:
    """One step: state, observation, and reward, terminated, truncated."""
    state, transition = simulator.step(bank, state, jnp.asarray(action))
    ending = (transition.reward, transition.terminated, transition.truncated)
    return state, limited(simulator, bank, state), ending


@partial(jax.jit, static_argnums=0)
def advance_all(
    simulator: Simulator, bank: ScenarioBank, states: SimState, actions: Float[Any, "B D"],
    begins: Bool[Any, " B"], rows: Any,
) -> tuple[SimState, dict[str, Array], tuple[Array, Array, Array]]:  # fmt: skip
    """The same for a batch; where an episode ``begins``, scenario ``rows`` starts instead and earns nothing."""
    begins = jnp.asarray(begins)
    fresh = map_where(begins, partial(simulator.beginning, bank), jnp.asarray(rows))
    step = jax.vmap(simulator.step_or_begin, in_axes=(None, 0, 0, 0, 0))
    states, transition = step(bank, states, jnp.asarray(actions), begins, fresh)
    reward = jnp.where(begins, 0.0, transition.reward)
    seen = jax.vmap(partial(limited, simulator, bank))(states)
    return states, seen, (reward, transition.terminated, transition.truncated)


@jax.jit
def judged(bank: ScenarioBank, state: SimState) -> dict[str, Value]:
    """The episode metrics."""
    return episode_metrics(bank, state)


@jax.jit
def judged_all(bank: ScenarioBank, states: SimState) -> dict[str, Value]:
    """The same for a batch."""
    return jax.vmap(episode_metrics, in_axes=(None, 0))(bank, states)


def limited(simulator: Simulator, bank: ScenarioBank, state: SimState) -> dict[str, Array]:
    """The observation within the bounds of its space; groups without rows are left out."""
    seen = simulator.observe(bank, state.context)
    return {
        name: leaf.astype(jnp.int8) if leaf.dtype == bool else jnp.clip(leaf, -LIMIT, LIMIT)
        for name, leaf in seen.items()
        if leaf.size
    }
