"""Checks of algorithms."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from drivax.learning.algorithm import AlgorithmConfig, Learner, LearnerState, training_data
from drivax.learning.driving import Driving
from drivax.planners.planner import Planner
from drivax.plugins import find_named
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.simulator.simulator import Simulator
from drivax.tasks.observations import ObservationConfig
from drivax.tasks.task import Task
from drivax.testing import worlds
from drivax.testing.contract import check_numbers, expect, same

#: A small observation: compiling is what a check takes.
_TASK = Task(
    observation=ObservationConfig(agents=2, steps=1, road=0, lights=1, route=3),
    metrics="training",
)
_ITERATIONS = 4


def check_algorithm(config: AlgorithmConfig | str) -> None:
    """Check an algorithm.

    Its learner has a state with ``parameters`` and ``iteration`` of constant structure, shapes and types. Iterations
    are pure, bit-for-bit repeatable after storing the state, change the parameters and log finite numbers. The planner
    acts within [-1, 1], deterministically by the mode. Use small sizes: the check runs three iterations.

    Args:
        config: The algorithm's settings, or the dotted name of such a class or instance.

    Raises:
        BrokenContract: It breaks a rule; the message names rule and cure.
    """
    settings: Any = find_named(config) if isinstance(config, str) else config
    settings = settings() if isinstance(settings, type) else settings
    what = f"algorithm {type(settings).__name__}"
    expect(
        isinstance(settings, AlgorithmConfig),
        f"{what} lacks build or steps_per_iteration",
        "see AlgorithmConfig",
    )
    expect(
        isinstance(settings.steps_per_iteration, int) and settings.steps_per_iteration > 0,
        f"{what} counts {settings.steps_per_iteration!r} steps per iteration",
        "count environment steps as a whole number",
    )
    bank, simulator = worlds.worlds(), Simulator(_TASK)
    environment = Driving(simulator)
    learner = settings.build(environment, bank, _ITERATIONS)
    expect(isinstance(learner, Learner), f"{what} builds no Learner", "give it init, iterate and planner")
    state = _check_iterations(what, learner, training_data(settings, environment, bank))
    _check_planner(what, learner, bank, simulator, state.parameters)


def _check_iterations(what: str, learner: Learner, data: Any) -> Any:
    init, iterate = jax.jit(learner.init), jax.jit(learner.iterate, donate_argnums=1)
    first = init(data, jax.random.key(0))
    expect(
        isinstance(first, LearnerState),
        f"{what} has a state without parameters or iteration",
        "add these fields",
    )
    expect(
        _forms(jax.eval_shape(learner.init, data, jax.random.key(1))) == _forms(first),
        f"{what} has a state whose shape depends on the key",
        "let shapes depend on the configuration only",
    )
    next_state, _ = jax.eval_shape(learner.iterate, data, first)
    expect(
        _forms(next_state) == _forms(first),
        f"{what} changes the shape of its state in an iteration",
        "return the same record with the same shapes and types",
    )
    stored = _stored(first)
    second, logs = iterate(data, first)
    expect(
        int(second.iteration) == int(stored.iteration) + 1,
        f"{what} counts from iteration {int(stored.iteration)} to {int(second.iteration)}",
        "add one",
    )
    expect(
        not same(jax.device_get(second.parameters), jax.device_get(stored.parameters), 0.0),
        f"{what} learns nothing in an iteration",
        "return the new parameters",
    )
    _check_logs(what, logs)
    again, _ = iterate(data, jax.tree.map(jnp.copy, stored))
    expect(
        same(_numbers(again), _numbers(second), 0.0),
        f"{what} does not repeat an iteration bit for bit",
        "keep keys and all other inputs of an iteration in the state",
    )
    third, logs = iterate(data, second)
    _check_logs(what, logs)
    check_numbers(what, [np.atleast_1d(leaf) for leaf in jax.tree.leaves(_numbers(third.parameters))])
    return third


def _check_logs(what: str, logs: dict[str, Any]) -> None:
    for name, value in logs.items():
        expect(
            np.shape(value) == () and np.isfinite(value),
            f"{what} logs {name!r} as {np.asarray(value)}",
            "log finite numbers without axes",
        )


def _check_planner(
    what: str, learner: Learner, bank: ScenarioBank, simulator: Simulator, parameters: Any
) -> None:
    @jax.jit
    def act(planner: Any, bank: ScenarioBank, key: Any) -> Any:
        state = simulator.reset(bank, 0)
        carry = planner.init(bank, state, key)
        situation, seen = simulator.situation(bank, state), simulator.observe(bank, state.context)
        return planner.act(carry, bank, state, situation, seen, key)[0]

    keys = jax.random.key(0), jax.random.key(1)
    for samples in (False, True):
        planner = learner.planner(parameters, "checked", samples)
        expect(isinstance(planner, Planner), f"{what} returns no Planner", "see planners.planner.Planner")
        first, second = (np.asarray(act(planner, bank, key)) for key in keys)
        expect(
            first.shape == (2,) and np.isfinite(first).all() and (np.abs(first) <= 1.0).all(),
            f"{what} returns action {first}",
            "return two numbers in [-1, 1]",
        )
        if not samples:
            expect(
                (first == second).all(), f"{what} uses randomness in its mode", "use the key only to sample"
            )


def _forms(tree: Any) -> Any:
    leaves = [(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(tree)]
    return jax.tree.structure(tree), leaves


def _stored(tree: Any) -> Any:
    """Return a copy that survives donation of the state."""
    return jax.tree.map(jnp.copy, tree)


def _numbers(tree: Any) -> Any:
    """Return all leaves on the host, random keys as numbers."""

    def number(leaf: Any) -> Any:
        key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return np.asarray(jax.random.key_data(leaf) if key else leaf)

    return jax.tree.map(number, tree)
