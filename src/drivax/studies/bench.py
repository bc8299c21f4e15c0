"""Speed on this machine: of the simulator as a whole, by part, and by set of metrics, and of encoders.

Every device steps its share of the environments. A CPU is one device unless ``program.use_all_cores`` makes each core a
device, which is faster: most operations of a step are too small to divide between cores.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Float, Int

from drivax import kernels
from drivax.errors import UsageError, did_you_mean
from drivax.geometry.boxes import corners
from drivax.learning.driving import Driving
from drivax.learning.policies import find_traffic
from drivax.metrics.catalogue import MetricNames
from drivax.metrics.episode import episode_add, episode_metrics
from drivax.networks.attention import EntityConfig
from drivax.networks.encoders import EncoderConfig, GroupSpec, MlpConfig
from drivax.networks.transformers import LqConfig, LqhConfig, MtrConfig, WayformerConfig
from drivax.planners.simple import IdmPlanner
from drivax.scenario.bank.queries import around_lanes, left_of_edges, project_on_route
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.simulator.contact import ignored_overlaps, overlaps, time_to_collision
from drivax.simulator.dynamics import bicycle
from drivax.simulator.simulator import Simulator, map_where
from drivax.simulator.traffic.bank_data import prepare_bank
from drivax.simulator.traffic.log import alone
from drivax.simulator.types import Frame, SimState
from drivax.synthetic.world import generate_recording
from drivax.tasks.observations import PRESETS, ObservationConfig
from drivax.tasks.task import Task
from drivax.tracking.run_folder import versions

#: Sets of metrics and batch sizes of :func:`bench_metrics`, as in the published table.
METRIC_SETS, BATCHES = ("none", "training", "full"), (32, 128)
#: Larger batch sizes, reported only if they are fastest.
LARGER_BATCHES = (256, 512, 1024)
#: Number of environments in the compiler's cost analysis.
_COST_BATCH = 16384
#: Factor that makes the results of a part too small to change a state.
_NEGLIGIBLE = 1e-20
#: Actions, observations and frames.
_PlannerOutputs = tuple[Array, Mapping[str, Array], Frame]
#: Carry of the loop: states, mask of ended episodes, sums of rewards and metrics, outputs of the planner.
_Carry = tuple[SimState, Bool[Array, " B"], Float[Array, " B"], _PlannerOutputs]
_Encoder = MlpConfig | EntityConfig | LqConfig | LqhConfig | MtrConfig | WayformerConfig
#: Encoders by name and size. All but the MLP are also timed in bfloat16.
ENCODERS: dict[str, _Encoder] = {
    "mlp": MlpConfig(),
    "mlp rows": MlpConfig(rows=(64, 64)),
    "entity small": EntityConfig(),
    "entity published": EntityConfig(size="published"),
    "lq small": LqConfig(),
    "lq published": LqConfig(size="published"),
    "lqh small": LqhConfig(),
    "lqh published": LqhConfig(size="published"),
    "mtr small": MtrConfig(),
    "mtr published": MtrConfig(size="published"),
    "wayformer small": WayformerConfig(),
    "wayformer published": WayformerConfig(size="published"),
}
#: Variants, in float32 only.
VARIANTS: dict[str, _Encoder] = {
    "wayformer small, early": WayformerConfig(fusion="early"),
    "wayformer small, hierarchical": WayformerConfig(fusion="hierarchical"),
    "wayformer small, factorised": WayformerConfig(factorised=True),
}
#: Minimum duration of a timing, s; single calls of small encoders are too short for the clock.
_MIN_TIMING_S = 0.05


@dataclass(frozen=True)
class BenchConfig:
    """Settings of a benchmark.

    Attributes:
        batch: Parallel environments, a multiple of the number of devices.
        steps: Steps per timed call.
        repeats: Timed calls; the median is reported.
        task: Observation, reward, metrics.
        traffic: Traffic model: log, idm, package.module:name, a run folder or zoo:NAME.
        trust_code: Run code of this module of yours that a policy in the traffic names; repeat it to trust several.
    """

    batch: int = 256
    steps: int = 80
    repeats: int = 7
    task: Task = field(default_factory=Task)
    traffic: str = "log"
    trust_code: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("batch", "steps", "repeats"):
            if getattr(self, name) < 1:
                raise UsageError(f"{name} is {getattr(self, name)}", cure="use 1 or more")


def bench(bank: ScenarioBank, config: BenchConfig | None = None) -> dict[str, Any]:
    """Measure the time of steps driven by IDM, with resets, observation, reward and metrics, and of each part alone.

    Args:
        bank: Distinct scenarios; when an episode ends, another starts in a random one.
        config: Settings.

    Returns:
        The object of ``drivax bench --json``: ``by_part`` in microseconds per environment and step, ``cost_by_part`` in
        operations and bytes as counted by the compiler for the part alone.
    """
    config = config or BenchConfig()
    simulator, bank = _simulator(bank, config)
    program = compile_program(bank, config)
    states = _states(simulator, bank, config.batch)
    parts = _parts(simulator)
    times_us = {name: _time_part(config, part, bank, states) for name, part in parts.items()}
    no_grid = without_grid(bank)
    brute_force_us = sum(_time_part(config, parts[name], no_grid, states) for name in ("edges", "lanes"))
    return {
        "environment_steps_per_second": round(steps_per_second([program], config.repeats)[0]),
        "batch": config.batch,
        "devices": jax.device_count(),
        "scenarios": len(bank),
        "traffic": simulator.traffic.name,
        "state_bytes": program.state_bytes,
        "bank_bytes_per_scenario": bank.nbytes // len(bank),
        "compile_seconds": round(program.compile_seconds, 2),
        "brute_force_ratio": round(brute_force_us / (times_us["edges"] + times_us["lanes"]), 2),
        "by_part": {name: round(value, 3) for name, value in times_us.items()},
        "cost_by_part": {name: _cost(part, bank, states) for name, part in parts.items()},
        "kernels": kernels.state(),
        "versions": versions(),
    }


def bench_metrics(bank: ScenarioBank, config: BenchConfig | None = None) -> dict[str, Any]:
    """Measure steps per second by set of metrics and batch size, relative to the full set at batch 32 (as published).

    Returns:
        The object of ``drivax bench --metrics --json``: ``rows`` of ``metrics``, ``batch``, ``best`` (fastest size),
        ``steps_per_second`` and ``relative``, number of ``scenarios``, and ``versions``. A batch larger than
        :data:`BATCHES` has a row only if it is the fastest.
    """
    config = config or BenchConfig()
    if BATCHES[0] % jax.device_count():
        problem = f"batches of {BATCHES[0]} cannot be divided among {jax.device_count()} devices"
        raise UsageError(
            problem, cure="use a number of cores that divides them: `taskset -c 0-3 drivax bench --metrics`"
        )

    def program(metrics: MetricNames, batch: int) -> Program:
        task = replace(config.task, metrics=metrics)
        return compile_program(bank, replace(config, batch=batch, task=task))

    bank = replicate(bank)
    cases = [(metrics, batch) for metrics in METRIC_SETS for batch in (*BATCHES, *LARGER_BATCHES)]
    speeds = steps_per_second([program(metrics, batch) for metrics, batch in cases], config.repeats)
    rows = metric_rows(dict(zip(cases, speeds, strict=True)))
    return {"scenarios": len(bank), "rows": rows, "versions": versions()}


def metric_rows(speeds: Mapping[tuple[str, int], float]) -> list[dict[str, Any]]:
    """Return the rows of :func:`bench_metrics` from steps per second by set of metrics and batch size."""
    base, rows = speeds["full", BATCHES[0]], []
    for metrics in METRIC_SETS:
        by_batch = {batch: speed for (name, batch), speed in speeds.items() if name == metrics}
        best = max(by_batch, key=by_batch.__getitem__)
        for batch in dict.fromkeys((*BATCHES, best)):
            row = {"metrics": metrics, "batch": batch, "best": batch == best}
            speed = by_batch[batch]
            rows.append(row | {"steps_per_second": round(speed), "relative": round(speed / base, 2)})
    return rows


@dataclass(frozen=True)
class Program:
    """A compiled program that steps a batch.

    Attributes:
        run: Runs the program asynchronously.
        steps: Environment steps of a run, without steps that only reset.
        compile_seconds: Time to compile.
        state_bytes: Size of the state of one environment.
        temporary_bytes: Temporary memory per environment.
    """

    run: Callable[[], Any]
    steps: int
    compile_seconds: float
    state_bytes: int
    temporary_bytes: int


def compile_program(bank: ScenarioBank, config: BenchConfig) -> Program:
    """Compile a program that steps and resets a batch driven by IDM, with observations, rewards and metrics."""
    simulator, bank = _simulator(bank, config)
    states = _states(simulator, bank, config.batch)
    keys = jax.random.split(jax.random.key(2), jax.device_count())
    carry = _carry(simulator, config, bank, states)
    start = time.perf_counter()
    program = _jit_sharded(lambda *args: _run(simulator, config, *args)).lower(bank, carry, keys).compile()
    seconds = time.perf_counter() - start
    memory = program.memory_analysis()
    temporary_bytes = 0 if memory is None else memory.temp_size_in_bytes * jax.device_count()
    return Program(
        run=lambda: program(bank, carry, keys),
        steps=int(program(bank, carry, keys)[1].sum()),
        compile_seconds=seconds,
        state_bytes=sum(leaf.nbytes for leaf in jax.tree.leaves(states)) // config.batch,
        temporary_bytes=temporary_bytes // config.batch,
    )


def steps_per_second(programs: Sequence[Program], repeats: int) -> list[float]:
    """Return the environment steps per second of each program: medians of alternating runs, after one that warms up."""
    rounds_s = [[_seconds(program.run) for program in programs] for _ in range(repeats + 1)]
    medians_s = map(statistics.median, zip(*rounds_s[1:], strict=True))
    return [program.steps / median_s for program, median_s in zip(programs, medians_s, strict=True)]


def _seconds(call: Callable[[], Any]) -> float:
    """Return the duration of a call that computes JAX arrays."""
    start = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - start


def _simulator(bank: ScenarioBank, config: BenchConfig) -> tuple[Simulator, ScenarioBank]:
    """Return the simulator, and the bank with its traffic data on every device."""
    if config.batch % jax.device_count():
        raise UsageError(
            f"batch size {config.batch} is not a multiple of the {jax.device_count()} devices",
            cure="choose a multiple",
        )
    traffic = find_traffic(config.traffic, config.trust_code)
    return Simulator(config.task, traffic), replicate(prepare_bank(traffic, bank))


def replicate(bank: ScenarioBank) -> ScenarioBank:
    """Copy the bank to every device that lacks it."""
    return jax.device_put(bank, NamedSharding(_mesh(), PartitionSpec()))


def _states(simulator: Simulator, bank: ScenarioBank, batch: int) -> SimState:
    """Return the states of a batch in random scenarios, sharded over the devices."""
    index = jax.random.randint(jax.random.key(1), (batch,), 0, len(bank))
    states = _reset(simulator, bank, index)
    return jax.device_put(states, NamedSharding(_mesh(), PartitionSpec("device")))


@partial(jax.jit, static_argnums=0)
def _reset(simulator: Simulator, bank: ScenarioBank, index: Int[Array, " B"]) -> SimState:
    return jax.vmap(simulator.reset, in_axes=(None, 0))(bank, index)


def _mesh() -> Mesh:
    """Return all devices as one axis, ``device``."""
    return jax.make_mesh((jax.device_count(),), ("device",), axis_types=(AxisType.Auto,))


def _jit_sharded(function: Callable[..., Any]) -> Any:
    """Jit a function of bank, states and keys, with the states and keys sharded over the devices."""
    sharded, whole = PartitionSpec("device"), PartitionSpec()
    return jax.jit(
        jax.shard_map(
            function, mesh=_mesh(), in_specs=(whole, sharded, sharded), out_specs=sharded,
            check_vma=False,  # It would refuse loops whose carry starts from constants, which do not vary by device.
        )
    )  # fmt: skip


def _run(
    simulator: Simulator, config: BenchConfig, bank: ScenarioBank, carry: _Carry, keys: Array
) -> tuple[Any, Array]:
    """Step one device's environments; return all results, so that the compiler keeps them, and the number of steps."""
    key, batch = keys[0], carry[1].shape[0]
    step = jax.vmap(simulator.step_or_reset, in_axes=(None, 0, 0, 0, 0, 0))

    def sum_metrics(states: SimState) -> Array:
        """Return the sum of the metrics of all episodes so far."""
        values = jax.vmap(episode_metrics, in_axes=(None, 0))(bank, states)
        return jnp.sum(jnp.asarray([value.value for value in values.values()], jnp.float32))

    def iteration(carry: _Carry, index: Int[Array, " B"]) -> tuple[_Carry, Array]:
        """Step every environment, or start an episode in scenario ``index``; count the steps."""
        states, done, total, (action, _, frame) = carry
        starts = map_where(done, partial(simulator.new_episode, bank), index)
        states, transition = step(bank, states, action, done, starts, frame)
        next_done = transition.terminated | transition.truncated
        # As in training: metrics are computed when some episode of the batch ends.
        total += jax.lax.cond(next_done.any(), sum_metrics, lambda _: jnp.zeros(()), states)
        total += transition.reward
        # Computed in this iteration, which knows the frame of all agents, not at the start of the next one.
        return (states, next_done, total, _planner_outputs(simulator, config, bank, states)), (~done).sum()

    start_index = jax.random.randint(key, (config.steps, batch), 0, len(bank))
    (_, _, total, outputs), step_counts = jax.lax.scan(iteration, carry, start_index)
    return (total, outputs), step_counts.sum()[None]


def _planner_outputs(
    simulator: Simulator, config: BenchConfig, bank: ScenarioBank, states: SimState
) -> _PlannerOutputs:
    """Return the planner's actions, the task's observations and the frame of all agents."""
    planner = IdmPlanner(config.task.actions)

    def outputs(state: SimState) -> _PlannerOutputs:
        situation = simulator.situation(bank, state)
        action, _ = planner.act((), bank, state, situation, None, jax.random.key(0))
        return action, simulator.observe(bank, state.context), situation.surroundings.frame

    return jax.vmap(outputs)(states)


def _carry(simulator: Simulator, config: BenchConfig, bank: ScenarioBank, states: SimState) -> _Carry:
    """Return the initial carry, which makes the first iteration reset every environment."""
    outputs = jax.eval_shape(lambda: _planner_outputs(simulator, config, bank, states))
    outputs = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), outputs)
    done, total = jnp.ones(config.batch, bool), jnp.zeros(config.batch)
    return states, *jax.device_put((done, total, outputs), NamedSharding(_mesh(), PartitionSpec("device")))


Part = Callable[[ScenarioBank, SimState], Any]


def without_grid(bank: ScenarioBank) -> ScenarioBank:
    """Return the bank with a grid of one cell, where each query visits all segments."""
    return replace(
        bank,
        grid_edge=jnp.stack([jnp.zeros_like(bank.grid_edge[:, 0]), bank.grid_edge[:, -1]], axis=1),
        grid_lane=jnp.stack([jnp.zeros_like(bank.grid_lane[:, 0]), bank.grid_lane[:, -1]], axis=1),
        grid_side=jnp.zeros((len(bank), 1), bank.grid_side.dtype),
    )


def _parts(simulator: Simulator) -> Mapping[str, Part]:
    """Return the parts of a step, unbatched; work that parts share counts in each of them."""

    def frame(bank: ScenarioBank, state: SimState) -> Any:
        return simulator.frame(bank, state.context, alone(state.context), 0)

    def box(bank: ScenarioBank, state: SimState) -> Array:
        x, y, heading, _ = state.context.history[-1]
        size = bank.agent_box[state.context.index, state.context.slot]
        return jnp.stack([x, y, jnp.cos(heading), jnp.sin(heading), size[0], size[1]])

    def ground(bank: ScenarioBank, state: SimState) -> Array:
        return state.context.z - bank.height_m(state.context.index, state.context.slot) / 2

    def edges(bank: ScenarioBank, state: SimState) -> Any:
        ego = box(bank, state)
        return left_of_edges(bank, state.context.index, ego[:2], corners(ego), ground(bank, state))

    def lanes(bank: ScenarioBank, state: SimState) -> Any:
        ego = box(bank, state)
        return around_lanes(bank, state.context.index, ego[:2], ego[2:4], corners(ego), ground(bank, state))

    def route(bank: ScenarioBank, state: SimState) -> Any:
        return project_on_route(bank, state.context.row, state.context.history[-1, :2], state.context.route_m)

    def ttc(bank: ScenarioBank, state: SimState) -> Any:
        return time_to_collision(frame(bank, state), state.context.slot, ignored_overlaps(state.contacts))

    def metrics(bank: ScenarioBank, state: SimState) -> Any:
        # Time of the accumulators alone: no metric reads the surroundings, and the compiler removes their computation.
        situation = simulator.situation(bank, state)
        return episode_add(state.episode, situation, state.start, jnp.zeros((), bool))

    return {
        "dynamics": lambda bank, state: bicycle(state.context.history[-1], jnp.ones(()), jnp.full((), 0.1)),
        "agents": frame,
        "contacts": lambda bank, state: overlaps(frame(bank, state), state.context.slot),
        "ttc": ttc,
        "edges": edges,
        "lanes": lanes,
        "route": route,
        "metrics": metrics,
        "observation": lambda bank, state: simulator.observe(bank, state.context),
        "reset": lambda bank, state: simulator.reset(bank, state.context.index),
        "step": lambda bank, state: simulator.step(bank, state, state.context.action),
    }


def _total(part: Part, bank: ScenarioBank, state: SimState) -> Array:
    """Return the sum of all results of a part, which keeps the compiler from removing any."""
    leaves = jax.tree.leaves(part(bank, state))
    return sum((jnp.sum(leaf, dtype=jnp.float32) for leaf in leaves), start=jnp.zeros(()))


def _time_part(config: BenchConfig, part: Part, bank: ScenarioBank, states: SimState) -> float:
    """Return the time of a part in microseconds per environment and step."""
    program = _repeat_part(config, part)
    seconds = _median_seconds(lambda: program(bank, states, None), config.repeats)
    return seconds / config.steps / config.batch * 1e6


def _repeat_part(config: BenchConfig, part: Part) -> Any:
    """Return a program that computes a part ``config.steps`` times in sequence; its keys are not read."""

    def run(bank: ScenarioBank, states: SimState, _: Any) -> Array:
        def iteration(shift: Array, _: None) -> tuple[Array, None]:
            """Compute the part in shifted states."""
            totals = jax.vmap(lambda state, shift: _total(part, bank, _shift(state, shift)))(states, shift)
            # Each iteration depends on the last one, which keeps the compiler from hoisting work out of the loop.
            return shift + _NEGLIGIBLE * jnp.where(jnp.isfinite(totals), totals, 0.0), None

        return jax.lax.scan(iteration, jnp.zeros(states.start.shape), None, config.steps)[0]

    return _jit_sharded(run)


def _shift(state: SimState, distance: Array) -> SimState:
    """Shift the state by a negligible distance, and the index by 0, so that every part depends on the distance."""
    history = state.context.history + distance
    index = state.context.index + distance.astype(jnp.int32)
    return replace(state, context=replace(state.context, history=history, index=index))


def _cost(part: Part, bank: ScenarioBank, states: SimState) -> dict[str, float]:
    """Return a part's operations and bytes per environment by the compiler's cost analysis.

    The analysis counts an indexed array as read in full, which is negligible for many environments in a bank of one
    scenario.
    """

    def with_rows(tree: Any, rows: int) -> Any:
        """Return the shapes of a tree with another number of rows."""
        return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((rows, *leaf.shape[1:]), leaf.dtype), tree)

    program = jax.jit(jax.vmap(part, in_axes=(None, 0)))
    counts = program.lower(with_rows(bank, 1), with_rows(states, _COST_BATCH)).compile().cost_analysis() or {}
    return {
        "operations": round(counts.get("flops", 0.0) / _COST_BATCH),
        "bytes": round(counts.get("bytes accessed", 0.0) / _COST_BATCH),
    }


def _median_seconds(call: Callable[[], Any], repeats: int) -> float:
    """Return the median duration of a call in seconds, after one call that warms up."""
    _seconds(call)
    return statistics.median(_seconds(call) for _ in range(repeats))


@dataclass(frozen=True)
class EncoderBench:
    """Settings of :func:`bench_encoders`.

    Attributes:
        only: Names of encoders in :data:`ENCODERS` and :data:`VARIANTS`; empty for all.
        batches: Batch sizes of the forward pass; the backward pass uses the last.
        repeats: Number of timings; the median is reported.
        observation: The observation that is encoded.
    """

    only: tuple[str, ...] = ()
    batches: tuple[int, ...] = (1, 64)
    repeats: int = 5
    observation: ObservationConfig = field(default_factory=lambda: PRESETS["optimal"])

    def __post_init__(self) -> None:
        for name in self.only:
            if name not in ENCODERS and name not in VARIANTS:
                raise UsageError(f"unknown encoder {name!r}", cure=did_you_mean(name, [*ENCODERS, *VARIANTS]))
        if not self.batches or min(*self.batches, self.repeats) < 1:
            raise UsageError(
                f"invalid batches {self.batches} or repeats {self.repeats}",
                cure="use at least one batch size, and numbers of 1 or more",
            )


def bench_encoders(config: EncoderBench | None = None, *, times: bool = True) -> dict[str, Any]:
    """Measure sizes and times of encoders.

    Args:
        config: Settings.
        times: Whether to measure times; sizes need no computation.

    Returns:
        The object of ``drivax bench --encoders --json``: ``observation`` with the shapes of the groups, ``device``,
        and ``rows`` of ``encoder``, ``dtype``, ``parameters``, ``width`` (of the embedding) and, in microseconds per
        observation, ``forward_us`` by batch and ``gradient_us``, a forward and a backward pass for all parameters at
        the last batch; and ``versions``.
    """
    config = config or EncoderBench()
    spec = observation_shapes(config.observation)
    rows = []
    for name, encoder in (ENCODERS | VARIANTS).items():
        if config.only and name not in config.only:
            continue
        encoders = {"float32": encoder}
        if name in ENCODERS and not isinstance(encoder, MlpConfig):
            encoders["bfloat16"] = replace(encoder, dtype="bfloat16")
        for dtype, encoder_config in encoders.items():
            row = {"encoder": name, "dtype": dtype} | encoder_sizes(encoder_config, spec)
            rows.append(row | (_times(encoder_config, spec, config) if times else {}))
    return {
        "observation": {group: list(shape) for group, shape in spec.items()},
        "device": jax.devices()[0].device_kind,
        "rows": rows,
        "versions": versions(),
    }


def observation_shapes(config: ObservationConfig) -> dict[str, tuple[int, ...]]:
    """Return the shapes of an observation, by group."""
    bank = ScenarioBank.from_scenarios([assemble(generate_recording(seed=0, index=0))])
    return Driving(Simulator(Task(observation=config))).shapes(bank)


def encoder_sizes(config: EncoderConfig, spec: GroupSpec) -> dict[str, int]:
    """Return the number of parameters and the width of the embedding."""
    encoder: Any = nnx.eval_shape(lambda: config.build(spec, nnx.Rngs(0)))
    leaves = jax.tree.leaves(nnx.state(encoder, nnx.Param))
    return {"parameters": sum(leaf.size for leaf in leaves), "width": encoder.width}


def random_observations(spec: GroupSpec, batch: int) -> dict[str, Array]:
    """Return observations of normal noise with about half of the rows valid."""
    rng, groups = np.random.default_rng(0), {}
    for name, shape in sorted(spec.items()):
        values = rng.normal(size=(batch, *shape)).astype(np.float32)
        groups[name] = jnp.asarray(values > 0 if name.endswith("_mask") else values)
    return groups


def _times(config: EncoderConfig, spec: GroupSpec, bench: EncoderBench) -> dict[str, Any]:
    """Return the times of a forward pass by batch size, and of a forward and backward pass, in µs per observation."""
    graph, shapes = nnx.split(nnx.eval_shape(lambda: config.build(spec, nnx.Rngs(0))))
    # Times do not depend on the values of parameters.
    rng = np.random.default_rng(0)
    parameters = jax.tree.map(
        lambda leaf: jnp.asarray(0.05 * rng.normal(size=leaf.shape), leaf.dtype), shapes
    )

    def encode(parameters: Any, groups: Any) -> Array:
        encoder: Any = nnx.merge(graph, parameters)
        return encoder(groups)

    def loss(parameters: Any, groups: Any) -> Array:
        """Return a number that depends on every parameter."""
        return jnp.mean(encode(parameters, groups) ** 2)

    forward, gradient = jax.jit(encode), jax.jit(jax.grad(loss))
    by_batch, groups = {}, {}
    for batch in bench.batches:
        groups = random_observations(spec, batch)
        by_batch[str(batch)] = _microseconds(forward, parameters, groups, bench.repeats)
    return {"forward_us": by_batch, "gradient_us": _microseconds(gradient, parameters, groups, bench.repeats)}


def _microseconds(function: Any, parameters: Any, groups: dict[str, Array], repeats: int) -> float:
    """Return the median time per observation; the first call compiles, the second sets the calls per timing."""
    batch = next(iter(groups.values())).shape[0]

    def seconds(calls: int) -> float:
        """Return the mean duration of some calls."""
        start = time.perf_counter()
        for _ in range(calls):
            jax.block_until_ready(function(parameters, groups))
        return (time.perf_counter() - start) / calls

    seconds(1)
    calls = math.ceil(_MIN_TIMING_S / seconds(1))
    return round(1e6 * statistics.median(seconds(calls) for _ in range(repeats)) / batch, 2)
