"""How fast the simulator steps on this machine, as a whole and by part."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from drivax.geometry.boxes import corners
from drivax.metrics.episode import episode_add, episode_metrics
from drivax.scenario.bank import ScenarioBank
from drivax.scenario.exhaustive import without_grid
from drivax.scenario.queries import around_lanes, left_of_edges, project_on_route
from drivax.simulator.contact import Contact, overlaps, time_to_collision
from drivax.simulator.dynamics import bicycle
from drivax.simulator.simulator import Simulator
from drivax.simulator.traffic import alone
from drivax.simulator.types import SimState
from drivax.tasks.task import Task
from drivax.tracking.runs import versions

#: Standard deviation of the random actions that drive the benchmark.
_NOISE = 0.1


@dataclass(frozen=True)
class BenchConfig:
    """What is timed.

    Attributes:
        batch: Environments side by side.
        steps: Steps per timed call.
        repeats: Timed calls; the median counts.
        task: Observation and reward.
    """

    batch: int = 256
    steps: int = 80
    repeats: int = 7
    task: Task = field(default_factory=Task)


def bench(bank: ScenarioBank, config: BenchConfig | None = None) -> dict[str, Any]:
    """Times stepping with resets, observation, reward and all metrics, and each part alone.

    Args:
        bank: Distinct scenarios; every episode that ends begins another at random.
        config: Sizes.

    Returns:
        The contract of ``drivax bench --json``: ``by_part`` in microseconds per environment and step.
    """
    config = config or BenchConfig()
    simulator = Simulator(config.task)
    index = jax.random.randint(jax.random.key(1), (config.batch,), 0, len(bank))
    states = jax.jit(jax.vmap(simulator.reset, in_axes=(None, 0)))(bank, index)
    whole = jax.jit(partial(_run, simulator, config))
    began = time.perf_counter()
    compiled = whole.lower(bank, states, jax.random.key(0)).compile()
    compile_seconds = time.perf_counter() - began
    seconds = _median(lambda: compiled(bank, states, jax.random.key(2)), config.repeats)
    parts = {name: _time_part(config, part, bank, states) for name, part in _parts(simulator).items()}
    whole_bank = without_grid(bank)
    brute = sum(
        _time_part(config, _parts(simulator)[name], whole_bank, states) for name in ("edges", "lanes")
    )
    return {
        "environment_steps_per_second": round(config.batch * config.steps / seconds),
        "batch": config.batch,
        "scenarios": len(bank),
        "state_bytes": sum(leaf.nbytes for leaf in jax.tree.leaves(states)) // config.batch,
        "bank_bytes_per_scenario": bank.nbytes // len(bank),
        "compile_seconds": round(compile_seconds, 2),
        "brute_force_ratio": round(brute / (parts["edges"] + parts["lanes"]), 2),
        "by_part": {name: round(value, 3) for name, value in parts.items()},
        "versions": versions(),
    }


def _run(
    simulator: Simulator, config: BenchConfig, bank: ScenarioBank, states: SimState, key: Array
) -> Array:
    """Steps a batch; the sum of everything that was computed, so that nothing is optimised away."""
    step = jax.vmap(simulator.step_or_begin, in_axes=(None, 0, 0, 0, 0))
    observe = jax.vmap(simulator.observe, in_axes=(None, 0))

    def one(carry: tuple[SimState, Array, Array, Array], _: None) -> tuple[Any, None]:
        states, over, key, total = carry
        key, action_key, index_key = jax.random.split(key, 3)
        action = _NOISE * jax.random.normal(action_key, (config.batch, 2))
        index = jax.random.randint(index_key, (config.batch,), 0, len(bank))
        states, transition = step(bank, states, action, over, index)
        seen = [jnp.sum(value, dtype=jnp.float32) for value in jax.tree.leaves(observe(bank, states.scene))]
        metrics = jax.vmap(episode_metrics, in_axes=(None, 0))(bank, states)
        total += sum(seen) + transition.reward.sum() + sum(v.value.sum() for v in metrics.values())
        return (states, transition.terminated | transition.truncated, key, total), None

    start = (states, jnp.zeros(config.batch, bool), key, jnp.zeros(()))
    return jax.lax.scan(one, start, None, config.steps)[0][3]


Part = Callable[[ScenarioBank, SimState], Any]


def _parts(simulator: Simulator) -> dict[str, Part]:
    """Parts of a step, unbatched; each alone, so what they share is counted in each."""

    def frame(bank: ScenarioBank, state: SimState) -> Any:
        return simulator.frame(bank, state.scene, alone(state.scene), 0)

    def box(bank: ScenarioBank, state: SimState) -> Array:
        x, y, heading, _ = state.scene.history[-1]
        size = bank.agent_box[state.scene.index, state.scene.slot]
        return jnp.stack([x, y, jnp.cos(heading), jnp.sin(heading), size[0], size[1]])

    def edges(bank: ScenarioBank, state: SimState) -> Any:
        me = box(bank, state)
        return left_of_edges(bank, state.scene.index, me[:2], corners(me), jnp.zeros(()))

    def lanes(bank: ScenarioBank, state: SimState) -> Any:
        me = box(bank, state)
        return around_lanes(bank, state.scene.index, me[:2], me[2:4], corners(me), jnp.zeros(()))

    def route(bank: ScenarioBank, state: SimState) -> Any:
        return project_on_route(bank, state.scene.index, state.scene.history[-1, :2], state.scene.route_m)

    def ttc(bank: ScenarioBank, state: SimState) -> Any:
        return time_to_collision(frame(bank, state), state.scene.slot, state.contacts == Contact.IGNORED)

    def metrics(bank: ScenarioBank, state: SimState) -> Any:
        found = simulator.situation(bank, state)  # no metric here looks at its surroundings, so they cost nothing
        return episode_add(state.episode, found, state.start, jnp.zeros((), bool))

    return {
        "dynamics": lambda bank, state: bicycle(state.scene.history[-1], jnp.ones(()), jnp.full((), 0.1)),
        "agents": frame,
        "contacts": lambda bank, state: overlaps(frame(bank, state), state.scene.slot),
        "ttc": ttc,
        "edges": edges,
        "lanes": lanes,
        "route": route,
        "metrics": metrics,
        "observation": lambda bank, state: simulator.observe(bank, state.scene),
        "reset": lambda bank, state: simulator.reset(bank, state.scene.index),
        "step": lambda bank, state: simulator.step(bank, state, jnp.zeros(2)),
    }


def _time_part(config: BenchConfig, part: Part, bank: ScenarioBank, states: SimState) -> float:
    """Microseconds per environment and step of one part."""

    def total(bank: ScenarioBank, state: SimState) -> Array:
        leaves = jax.tree.leaves(part(bank, state))
        return sum((jnp.sum(leaf, dtype=jnp.float32) for leaf in leaves), start=jnp.zeros(()))

    @jax.jit
    def many(bank: ScenarioBank, states: SimState) -> Array:
        def one(history: Array, _: None) -> tuple[Array, None]:
            moved = jax.vmap(lambda s, h: _with_history(s, h))(states, history)
            seen = jax.vmap(total, in_axes=(None, 0))(bank, moved)
            # The next round depends on this one, so that nothing is hoisted out of the loop.
            return history + 1e-9 * seen[:, None, None], None

        return jax.lax.scan(one, states.scene.history, None, config.steps)[0]

    seconds = _median(lambda: many(bank, states), config.repeats)
    return seconds / config.steps / config.batch * 1e6


def _with_history(state: SimState, history: Array) -> SimState:
    return replace(state, scene=replace(state.scene, history=history))


def _median(call: Callable[[], Any], repeats: int) -> float:
    jax.block_until_ready(call())
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - began)
    return statistics.median(times)
