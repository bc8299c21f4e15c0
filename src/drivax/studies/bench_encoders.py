"""Size and speed of encoders: parameters, and time of forward and backward passes per observation."""

from __future__ import annotations

import math
import statistics
import time
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array

from drivax.errors import UsageError, did_you_mean
from drivax.learning.driving import Driving
from drivax.networks.encoders import EncoderConfig, GroupSpec, MlpConfig
from drivax.networks.entity import EntityConfig
from drivax.networks.transformers import LqConfig, LqhConfig, MtrConfig, WayformerConfig
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.simulator.simulator import Simulator
from drivax.synthetic.world import generate_recording
from drivax.tasks.observations import PRESETS, ObservationConfig
from drivax.tasks.task import Task
from drivax.tracking.run_folder import versions

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
