"""Novelty: distance of a step to its nearest neighbours among steps of other recordings, in an embedding.

The embedding is that of an untrained encoder, whose distances resemble those of its inputs without depending on the
order of agents, or that of the first member of a saved ensemble, which has learned what matters for driving.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Bool, Float, Int

from drivax.checks import check_at_least
from drivax.curation.ensemble import OBSERVATION, Ensemble
from drivax.curation.logged import Numbers, Progress, map_batches, valid_steps
from drivax.errors import DataError
from drivax.learning.driving import Driving, Egos
from drivax.networks.actor_critic import graph_of
from drivax.networks.attention import EntityConfig
from drivax.networks.encoders import EncoderConfig
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.bank.sizes import Sizes
from drivax.scenario.store import ScenarioSet
from drivax.simulator.simulator import Simulator
from drivax.stats.clusters import recordings_of
from drivax.tasks.task import Task

#: Logs that are embedded at once.
_LOG_BATCH = 8


@dataclass(frozen=True)
class NoveltyConfig:
    """Settings of the novelty.

    Attributes:
        neighbours: Number of nearest steps over which the distance is averaged.
        reference: Approximate number of steps, at random from all scenarios, among which neighbours are searched.
        encoder: Encoder with random parameters; a saved ensemble has its own.
        task: Observation to embed.
        seed: Seed of the reference steps and of the encoder.
    """

    neighbours: int = 10
    reference: int = 4096
    encoder: EncoderConfig = field(default_factory=EntityConfig)
    task: Task = field(default_factory=lambda: Task(observation=OBSERVATION, metrics="none"))
    seed: int = 0

    def __post_init__(self) -> None:
        check_at_least(self, 1, "neighbours")
        check_at_least(self, 2, "reference")
        check_at_least(self, 0, "seed")


@dataclass(frozen=True, eq=False)
class _Encoder:
    """Encoder of an environment's observations; ``graph`` is its structure, or that of a policy that contains it."""

    environment: Driving
    graph: Any

    @partial(jax.jit, static_argnums=0)
    def values(self, parameters: Any, bank: ScenarioBank, steps: Int[Array, "M K"]) -> Float[Array, "M K D"]:
        """Return the embeddings of steps of the logs of a bank."""
        network: Any = nnx.merge(self.graph, parameters)
        encoder, observe = getattr(network, "encoder", network), self.environment.observe_recorded

        def embed_log(arguments: tuple[Array, Array]) -> Array:
            row, step = arguments
            return encoder(observe(bank, (jnp.full_like(step, row), step)))

        return jax.lax.map(embed_log, (jnp.arange(len(steps)), steps), batch_size=_LOG_BATCH)


@dataclass(frozen=True, eq=False)
class Embedding:
    """An embedding of the steps of logs, standardised by its mean and deviation over reference steps.

    Attributes:
        encoder, parameters: The encoder and its parameters.
        reference: Embeddings of the reference steps.
        recording: Number of the recording of each reference step.
        mean, deviation: Statistics before the standardisation.
    """

    encoder: _Encoder
    parameters: Any
    reference: Float[Array, "R D"]
    recording: Int[Array, " R"]
    mean: Float[Array, " D"]
    deviation: Float[Array, " D"]

    @classmethod
    def of(
        cls, config: NoveltyConfig, data: ScenarioSet, ensemble: Ensemble | None = None, egos: Egos = "recorded"
    ) -> Embedding:  # fmt: skip
        """Return the embedding of a set.

        Raises:
            DataError: Fewer than two recordings have a valid step.
        """
        task = config.task if ensemble is None else ensemble.config.task
        environment = Driving(Simulator(task), egos=egos)
        if ensemble is None:
            graph, parameters = _random_encoder(config, environment, data)
        else:
            graph = ensemble.learner.graph
            parameters = jax.tree.map(lambda leaf: leaf[0], ensemble.parameters)
        encoder = _Encoder(environment, graph)
        logs = 1 if egos == "recorded" else data.capacity.egos
        per_log = -(-config.reference // (len(data) * logs))
        valid = valid_steps(data, logs)
        rng = np.random.default_rng(config.seed)
        order = np.argsort(np.where(valid, rng.random(valid.shape), 2.0), axis=1)[:, :per_log]
        is_reference = np.take_along_axis(valid, order, axis=1)
        recording = np.repeat(np.unique(recordings_of(data.entries), return_inverse=True)[1], logs)
        reference_recording = np.broadcast_to(recording[:, None], order.shape)[is_reference]
        if len(np.unique(reference_recording)) < 2:
            problem = "fewer than two recordings have a valid step"
            raise DataError(problem, file=data.path, cure="use a set of two or more")
        kept = np.sort(rng.permutation(len(reference_recording))[: config.reference])

        def reference(bank: ScenarioBank, rows: Numbers) -> dict[str, Array]:
            log = (rows[:, None] * logs + np.arange(logs)).reshape(-1)
            steps = jnp.asarray(order[log])
            return {"embedding": encoder.values(parameters, bank, steps)}

        values = map_batches(data, reference)["embedding"][is_reference][kept]
        mean, deviation = values.mean(axis=0), np.maximum(values.std(axis=0), 1e-6)
        standardised = jnp.asarray((values - mean) / deviation, jnp.float32)
        recordings = jnp.asarray(reference_recording[kept])
        return cls(
            encoder, parameters, standardised, recordings, jnp.asarray(mean), jnp.asarray(deviation)
        )  # fmt: skip

    def of_bank(self, bank: ScenarioBank) -> Float[Array, "M T D"]:
        """Return the embedding of every step of the logs of a bank."""
        logs = bank.most_egos if self.encoder.environment.egos == "moving" else 1
        steps = jnp.broadcast_to(jnp.arange(bank.steps), (len(bank) * logs, bank.steps))
        return (self.encoder.values(self.parameters, bank, steps) - self.mean) / self.deviation


def _random_encoder(config: NoveltyConfig, environment: Driving, data: ScenarioSet) -> tuple[Any, Any]:
    """Return structure and random parameters of the configured encoder."""
    shapes = environment.shapes(ScenarioBank.from_scenarios([data[0]], trim=Sizes.used(data)))
    encoder = config.encoder.build(shapes, nnx.Rngs(config.seed))
    return graph_of(encoder), nnx.state(encoder, nnx.Param)


def novelty(
    config: NoveltyConfig, embedding: Embedding, data: ScenarioSet, progress: Progress | None = None
) -> Float[Numbers, "M T"]:
    """Return the mean distance of every step to its nearest reference steps of other recordings."""
    numbers = np.unique(recordings_of(data.entries), return_inverse=True)[1]
    logs = data.capacity.egos if embedding.encoder.environment.egos == "moving" else 1

    def distances(bank: ScenarioBank, rows: Numbers) -> dict[str, Array]:
        recording = jnp.asarray(np.repeat(numbers[rows], logs))
        values = embedding.of_bank(bank)
        result = nearest_distances(
            values, recording, embedding.reference, embedding.recording, config.neighbours
        )
        return {"distance": result}

    return map_batches(data, distances, progress)["distance"]


@partial(jax.jit, static_argnums=4)
def nearest_distances(
    values: Float[Array, "M T D"], recording: Int[Array, " M"], reference: Float[Array, "R D"],
    reference_recording: Int[Array, " R"], neighbours: int,
) -> Float[Array, "M T"]:  # fmt: skip
    """Return the mean distance of steps to the nearest ``neighbours`` reference steps of other recordings."""

    def log_distances(arguments: tuple[Array, Array]) -> Array:
        steps, log_recording = arguments
        # Expand the square to a matrix product: the differences of all pairs would not fit in caches.
        squares = jnp.sum(steps**2, axis=-1)[:, None] + jnp.sum(reference**2, axis=-1)
        squared = jnp.maximum(squares - 2.0 * steps @ reference.T, 0.0)
        squared = jnp.where(reference_recording == log_recording, jnp.inf, squared)
        nearest = -jax.lax.top_k(-squared, min(neighbours, len(reference)))[0]
        is_other = jnp.isfinite(nearest)
        total = jnp.sum(jnp.where(is_other, jnp.sqrt(nearest), 0.0), axis=-1)
        return total / jnp.maximum(is_other.sum(axis=-1), 1)

    return jax.lax.map(log_distances, (values, recording))


def scenario_embeddings(
    embedding: Embedding, data: ScenarioSet, valid: Bool[Numbers, "M T"]
) -> Float[Numbers, "N D"]:
    """Return the mean embedding of the valid steps of every scenario."""

    def mean(bank: ScenarioBank, rows: Numbers) -> dict[str, Array]:
        values = embedding.of_bank(bank).reshape(len(rows), -1, len(embedding.mean))
        mask = jnp.asarray(valid.reshape(len(data), -1)[rows], jnp.float32)[..., None]
        return {"mean": (values * mask).sum(axis=1) / jnp.maximum(mask.sum(axis=1), 1.0)}

    return map_batches(data, mean)["mean"]
