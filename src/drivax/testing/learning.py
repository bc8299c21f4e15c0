"""Checks of encoders and algorithms."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from drivax.learning.algorithm import AlgorithmConfig, Learner, LearnerState, training_data
from drivax.learning.driving import Driving
from drivax.networks.encoders import EncoderConfig
from drivax.planners.planner import Planner
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.simulator.simulator import Simulator
from drivax.tasks.observations import ObservationConfig
from drivax.tasks.task import Task
from drivax.testing import worlds
from drivax.testing.contract import (
    TOLERANCE,
    are_same,
    check_numbers,
    expect,
    instance,
    layout,
    program,
)

#: Groups with up to two row axes, with and without masks; one group of the second specification has no rows.
_SPECS = (
    {
        "agents": (4, 2, 3), "agents_mask": (4, 2), "ego": (2, 6), "ego_static": (4,), "route": (5, 5),
        "route_mask": (5,),
    },
    {"ego": (1, 6), "lights": (2, 7), "lights_mask": (2,), "route": (0, 5), "route_mask": (0,)},
)  # fmt: skip
_BATCH = 6
#: Tolerance for ``dtype: bfloat16``, which has eight significant bits.
_BFLOAT16_TOLERANCE = 5e-2
#: A small observation, because compilation takes most of the time of a check.
_TASK = Task(observation=ObservationConfig(agents=2, steps=1, road=0, lights=1, route=3), metrics="training")
#: Iterations of the training run for which a learner is built; the check runs three.
_ITERATIONS = 4


def check_encoder(config: EncoderConfig | str) -> None:
    """Check an encoder by its settings or their dotted name; raise :class:`BrokenContract` if it violates a rule.

    It builds for groups with and without rows and masks. It embeds an observation or a batch as ``[..., width]``
    float32, compiled or not. Its parameters depend only on the key, and are its only state. Values and gradients are
    finite, also if all rows are masked. Valid rows of every group have an effect, masked rows have none.
    """
    settings = instance(config)
    what = f"encoder {type(settings).__name__}"
    expect(isinstance(settings, EncoderConfig), f"{what} has no build(spec, rngs)", "see EncoderConfig")
    tolerance = _BFLOAT16_TOLERANCE if getattr(settings, "dtype", "") == "bfloat16" else TOLERANCE
    for number, spec in enumerate(_SPECS):
        encoder: Any = settings.build(spec, nnx.Rngs(0))
        batch = _observations(spec, number)
        run = program(what, encoder)
        embedding = run(batch)
        width = getattr(encoder, "width", None)
        structure, types = layout(embedding)
        valid = structure == jax.tree.structure(0.0) and embedding.shape == (_BATCH, width)
        valid = valid and embedding.dtype == jnp.float32
        problem = f"{what} embeds {_BATCH} observations as {', '.join(types)} with width {width}"
        expect(valid, problem, "return [*batch, width] float32, and set width")
        check_numbers(what, embedding)
        _check_state(what, settings, spec, encoder)
        # Eager calls are slow: only the first specification is embedded without compilation too.
        _check_batches(what, (encoder if number == 0 else run, run), batch, embedding, tolerance)
        _check_masks(what, run, batch, embedding, tolerance)
        _check_gradients(what, encoder, batch)
        _check_effects(what, run, batch, embedding, _observations(spec, len(_SPECS) + number))


def _observations(spec: Any, seed: int) -> dict[str, Any]:
    rng = np.random.default_rng(seed)

    def draw(name: str, shape: tuple[int, ...]) -> Any:
        if name.endswith("_mask"):
            return jnp.asarray(rng.random((_BATCH, *shape)) < 0.6)
        return jnp.asarray(rng.normal(size=(_BATCH, *shape)), jnp.float32)

    return {name: draw(name, shape) for name, shape in spec.items()}


def _check_state(what: str, config: EncoderConfig, spec: Any, encoder: Any) -> None:
    variables = jax.tree.leaves(nnx.state(encoder))
    parameters = jax.tree.leaves(nnx.state(encoder, nnx.Param))
    expect(
        len(variables) == len(parameters) > 0,
        f"{what} keeps {len(variables) - len(parameters)} variables that are not parameters, of {len(variables)}",
        "keep nnx.Param only: no dropout, no running means",
    )
    rebuilt = jax.tree.leaves(nnx.state(config.build(spec, nnx.Rngs(0)), nnx.Param))
    is_repeatable = are_same(jax.device_get(parameters), jax.device_get(rebuilt), 0.0)
    expect(is_repeatable, f"{what} has other initial parameters every time", "draw them from rngs")


def _check_batches(
    what: str, encoders: tuple[Any, Any], batch: Any, embedding: Any, tolerance: float
) -> None:
    """Check one observation, alone by the first encoder and in a batch with two axes of size one by the second.

    Check also that not all observations have the same embedding.
    """
    single, (encoder, run) = jax.tree.map(lambda leaf: leaf[0], batch), encoders
    for result in (encoder(single), run(jax.tree.map(lambda leaf: leaf[None, None], single))[0, 0]):
        valid = are_same(embedding[0], jax.device_get(result), tolerance)
        expect(valid, f"{what} differs in a batch", "use the last axes; any axes may lead")
    spread = np.abs(embedding - embedding[:1]).max()
    expect(spread > 0, f"{what} embeds all observations equally", "let it read the groups")


def _check_masks(what: str, run: Any, batch: Any, embedding: Any, tolerance: float) -> None:
    garbage = {
        name: jnp.where(batch[f"{name}_mask"][..., None], rows, worlds.GARBAGE)
        for name, rows in batch.items()
        if f"{name}_mask" in batch
    }
    is_unchanged = are_same(embedding, run(batch | garbage), tolerance)
    cure = "use jnp.where(mask[..., None], rows, 0) first, and mask after each bias"
    expect(is_unchanged, f"{what} changes with masked rows", cure)
    check_numbers(f"{what} without rows", run(_without_rows(batch)), "a mean or softmax over no rows")


def _without_rows(batch: Any) -> dict[str, Any]:
    return {name: jnp.zeros_like(value) if name.endswith("_mask") else value for name, value in batch.items()}


def _check_gradients(what: str, encoder: Any, batch: Any) -> None:
    graph, parameters = nnx.split(encoder)

    def loss(parameters: Any, batch: Any) -> Any:
        return jnp.mean(nnx.merge(graph, parameters)(batch) ** 2)

    run = program(what, jax.grad(loss))
    for groups in (batch, _without_rows(batch)):
        gradient = run(parameters, groups)
        is_finite = all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
        expect(is_finite, f"{what} has non-finite gradients", "guard roots and divisions on their input")


def _check_effects(what: str, run: Any, batch: Any, embedding: Any, others: Any) -> None:
    """Check that the embedding changes if the valid rows of any group are those of other observations."""
    for name, rows in batch.items():
        if rows.size and not name.endswith("_mask"):
            mask = batch.get(f"{name}_mask", jnp.ones(rows.shape[:-1], bool))
            result = run(batch | {name: jnp.where(mask[..., None], others[name], rows)})
            expect(
                not are_same(embedding, result, 0.0), f"{what} ignores the group {name!r}", "read all groups"
            )


def check_algorithm(config: AlgorithmConfig | str) -> None:
    """Check an algorithm by its settings or their dotted name; raise :class:`BrokenContract` if it violates a rule.

    Its learner has a state with ``parameters`` and ``iteration`` of constant structure, shapes and types. Iterations
    are pure, repeat bit for bit from a stored state, change the parameters, and log finite numbers. The planner acts
    within [-1, 1]; its mode is deterministic. Use small sizes and no warm-up, because the check runs three iterations
    of a training run of four, and the first must learn.
    """
    settings = instance(config)
    what = f"algorithm {type(settings).__name__}"
    valid = isinstance(settings, AlgorithmConfig)
    expect(valid, f"{what} lacks build or steps_per_iteration", "see AlgorithmConfig")
    steps = settings.steps_per_iteration
    valid = isinstance(steps, int) and steps > 0
    expect(valid, f"{what} counts {steps!r} steps per iteration", "count environment steps as an integer")
    bank, simulator = worlds.worlds(), Simulator(_TASK)
    environment = Driving(simulator)
    learner = settings.build(environment, bank, _ITERATIONS)
    expect(isinstance(learner, Learner), f"{what} builds no Learner", "give it init, iterate and planner")
    state = _check_iterations(what, learner, training_data(settings, environment, bank))
    _check_planner(what, learner, bank, simulator, state.parameters)


def _check_iterations(what: str, learner: Learner, data: Any) -> Any:
    init, iterate = jax.jit(learner.init), jax.jit(learner.iterate, donate_argnums=1)
    first = init(data, jax.random.key(0))
    valid = isinstance(first, LearnerState)
    expect(valid, f"{what} has a state without parameters or iteration", "add these fields")
    _check_state_layout(what, learner, data, first)
    stored_state = jax.tree.map(jnp.copy, first)  # survives the donation of the state
    second, logs = iterate(data, first)
    before, after = int(stored_state.iteration), int(second.iteration)
    expect(after == before + 1, f"{what} counts from iteration {before} to {after}", "add one")
    is_unchanged = are_same(jax.device_get(second.parameters), jax.device_get(stored_state.parameters), 0.0)
    cure = "return the new parameters, and set any warm-up to 0 for the check"
    expect(not is_unchanged, f"{what} learns nothing in an iteration", cure)
    _check_logs(what, logs)
    repeated_state, _ = iterate(data, jax.tree.map(jnp.copy, stored_state))
    valid = are_same(_host_arrays(repeated_state), _host_arrays(second), 0.0)
    cure = "keep keys and all other inputs of an iteration in the state"
    expect(valid, f"{what} does not repeat an iteration bit for bit", cure)
    third, logs = iterate(data, second)
    _check_logs(what, logs)
    parameters = jax.tree.leaves(_host_arrays(third.parameters))
    check_numbers(f"a parameter of {what}", [np.atleast_1d(leaf) for leaf in parameters])
    return third


def _check_state_layout(what: str, learner: Learner, data: Any, state: Any) -> None:
    """Check that the layout of a state is the same for other keys and after an iteration."""
    valid = layout(jax.eval_shape(learner.init, data, jax.random.key(1))) == layout(state)
    cure = "let shapes depend on the configuration only"
    expect(valid, f"{what} has a state whose shape depends on the key", cure)
    valid = layout(jax.eval_shape(learner.iterate, data, state)[0]) == layout(state)
    cure = "return the same record with the same shapes and types"
    expect(valid, f"{what} changes the shape of its state in an iteration", cure)


def _check_logs(what: str, logs: dict[str, Any]) -> None:
    for name, value in logs.items():
        valid = np.shape(value) == () and np.isfinite(value)
        expect(valid, f"{what} logs {name!r} as {np.asarray(value)}", "log finite numbers without axes")


def _check_planner(
    what: str, learner: Learner, bank: ScenarioBank, simulator: Simulator, parameters: Any
) -> None:
    @jax.jit
    def act(planner: Any, bank: ScenarioBank, key: Any) -> Any:
        state = simulator.reset(bank, 0)
        carry = planner.init(bank, state, key)
        situation, observation = simulator.situation(bank, state), simulator.observe(bank, state.context)
        return planner.act(carry, bank, state, situation, observation, key)[0]

    keys = jax.random.key(0), jax.random.key(1)
    for samples in (False, True):
        planner = learner.planner(parameters, "checked", samples)
        expect(isinstance(planner, Planner), f"{what} returns no Planner", "see drivax.planners.Planner")
        first, second = (np.asarray(act(planner, bank, key)) for key in keys)
        valid = first.shape == (2,) and np.isfinite(first).all() and (np.abs(first) <= 1.0).all()
        expect(valid, f"{what} returns action {first}", "return two numbers in [-1, 1]")
        valid = samples or (first == second).all()
        expect(valid, f"{what} uses randomness in its mode", "use the key only to sample")


def _host_arrays(tree: Any) -> Any:
    """Return a tree on the host, with the data of random keys."""

    def host_array(leaf: Any) -> Any:
        is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return np.asarray(jax.random.key_data(leaf) if is_key else leaf)

    return jax.tree.map(host_array, tree)
