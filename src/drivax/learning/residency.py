"""Training on more scenarios than memory holds: some are resident, and blocks of them are exchanged in training.

Scenarios enter in shuffled passes through the set. Which of them are resident depends only on the number of finished
iterations, so a resumed run goes on with the same ones. No new episode begins in a block that is about to leave. Should
one be under way all the same, as in a warm start, whose environments rest during behaviour cloning, it is abandoned.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, UInt

from drivax.errors import DataError, UsageError
from drivax.files import format_bytes
from drivax.learning.config import SELF, Residency, TrainConfig, split_traffic
from drivax.learning.curriculum import Curriculum, LoggedValues
from drivax.learning.driving import with_expert_steps
from drivax.learning.environment import Environments, cumulative_probability
from drivax.learning.experience import Experience, environment_data
from drivax.learning.program import Program
from drivax.learning.replay import Replay
from drivax.learning.training_set import Indices, Source
from drivax.metrics.catalogue import select_metrics
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.stats.intervals import effective_size

#: Mean number of episodes that begin in a scenario while it is resident, and the steps of an episode that is assumed.
_EPISODES, _EPISODE_STEPS = 8, 40
#: Largest share of the resident scenarios in which no episode begins because they are about to leave.
_MOST_LEAVING = 0.125
#: Most scenarios of a block: their arrays are stacked together.
_MOST_BLOCK = 64
#: Scenarios whose bytes stand for those of all.
_SAMPLE = 32


@dataclass(frozen=True)
class Rotation:
    """Which of ``total`` scenarios are resident after a number of exchanges.

    ``lead`` is the number of iterations in which an episode surely ends: before a block leaves, it takes no new
    episodes for that long.
    """

    residency: Residency
    total: int
    seed: int
    lead: int

    def __post_init__(self) -> None:
        if 2 * self.leaving > self.blocks:
            problem = (
                f"{self.residency.scenarios} resident scenarios are too few: episodes take up to {self.lead} "
                f"iterations, in which {self.leaving} of {self.blocks} blocks leave"
            )
            raise UsageError(
                problem, cure="raise --memory or residency.scenarios, or exchange them less often"
            )

    @property
    def blocks(self) -> int:
        """Number of resident blocks."""
        return self.residency.scenarios // self.residency.block

    @property
    def leaving(self) -> int:
        """Number of blocks that take no new episodes."""
        return -(-self.lead // self.residency.every) + 1 if self.lead else 0

    def exchanges(self, iteration: int) -> int:
        """Return the number of exchanges in a number of iterations."""
        return iteration // self.residency.every

    def resident(self, exchanges: int) -> Int[np.ndarray, " R"]:
        """Return the resident scenarios after a number of exchanges, by row."""
        block = self.residency.block
        # Block b was last written by the newest exchange with this remainder, or at the start.
        newest = exchanges - 1 - (exchanges - 1 - np.arange(self.blocks)) % self.blocks
        position = (self.blocks + newest)[:, None] * block + np.arange(block)
        return self._scenarios(position.reshape(-1))

    def entering(self, exchange: int) -> Int[np.ndarray, " block"]:
        """Return the scenarios that exchange number ``exchange`` (from 0) brings."""
        start = self.residency.scenarios + exchange * self.residency.block
        return self._scenarios(np.arange(start, start + self.residency.block))

    def first_row(self, exchange: int) -> int:
        """Return the first row that an exchange replaces."""
        return exchange % self.blocks * self.residency.block

    def chances(self, exchanges: int) -> UInt[np.ndarray, " R"]:
        """Return the cumulative probability that an episode begins in each row, equal except where a block leaves."""
        weight = np.ones((self.blocks, self.residency.block))
        weight[(exchanges + np.arange(self.leaving)) % self.blocks] = 0.0
        return cumulative_probability(weight)

    def _scenarios(self, position: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
        """Return the scenarios at positions of the endless sequence of shuffled passes."""
        passes, place = np.divmod(position, self.total)
        result = np.empty(len(position), np.int64)
        for number in np.unique(passes):
            of_pass = passes == number
            result[of_pass] = _shuffled(self.total, self.seed, int(number))[place[of_pass]]
        return result


@lru_cache(maxsize=2)
def _shuffled(total: int, seed: int, number: int) -> Int[np.ndarray, " total"]:
    """Return the order of scenarios in a pass."""
    return np.random.default_rng([seed, number]).permutation(total)


def _choose_residency(scenarios: int, steps_per_iteration: int, lead: int) -> Residency:
    """Return the exchange of this many resident scenarios or a few less, given the iterations of an episode.

    A scenario stays for about eight episodes, or longer if more than an eighth would be about to leave.
    """
    rate = steps_per_iteration / (_EPISODES * _EPISODE_STEPS)
    block = max(1, min(_MOST_BLOCK, scenarios // 64))
    most = max(_MOST_LEAVING * scenarios - 2 * block, block / 2) / max(lead, 1)
    every = max(1, math.ceil(block / min(rate, most)))
    return Residency(max(scenarios // block, 2) * block, block, every)


class Residents:
    """The scenarios on the device in a training run: all of them, or some that a thread reads and exchanges."""

    def __init__(self, source: Source, rotation: Rotation | None = None, replays_log: bool = False) -> None:
        self.source, self.rotation = source, rotation
        self._replays_log = replays_log
        self._thread = ThreadPoolExecutor(1, "residents")
        self._next: Future[ScenarioBank] | None = None
        config = source.config
        self.curriculum: Curriculum | None = None
        if config.curriculum:
            terms = config.task.rewards.weights()
            steps = config.algorithm.steps_per_iteration
            metrics = select_metrics(config.task.metrics).names
            entries = source.scenarios.entries
            self.curriculum = Curriculum(config.curriculum, entries, terms, metrics, steps)

    @classmethod
    def of(cls, source: Source, memory: int | None) -> Residents:
        """Return the residents of a run: as configured, as many as fit in ``memory`` bytes, or all.

        Raises:
            UsageError: There are recorded episodes, or too few scenarios are resident for the length of episodes.
        """
        config, total = source.config, len(source.scenarios)
        if memory is None and config.residency is None:
            return cls(source)
        if memory is not None and config.residency is not None:
            raise UsageError("both --memory and residency", cure="leave out one of them")
        if any(split_traffic(name)[0] is not None for name in config.shares if name != SELF):
            problem = "trained policies in the traffic need all scenarios on the device"
            raise UsageError(problem, cure="leave out --memory and residency")
        if config.curriculum:
            raise UsageError("a curriculum needs all scenarios on the device", cure="leave out --memory")
        if source.episodes:
            cure = "leave out --memory and residency, or the episodes"
            raise UsageError("recorded episodes need all of their scenarios on the device", cure=cure)
        rows = np.arange(min(total, _SAMPLE))
        sample = _load(source, False, rows)
        learner = config.algorithm.build(source.environment, sample, config.iterations)
        # Weights may be 0 in the sample.
        unweighted = None if source.weights is None else np.ones_like(source.weights)
        experience = replace(source, weights=unweighted).complete(sample, rows)
        replays_log = isinstance(experience, Experience)
        if replays_log:
            sample = with_expert_steps(source.environment, sample)
        scenario_bytes = sum(leaf.nbytes for leaf in jax.tree.leaves(sample)) / len(rows)
        state = jax.eval_shape(learner.init, experience, jax.random.key(0))
        environments = sum(node.over.shape[0] for node in _nodes(state) if isinstance(node, Environments))
        steps = config.algorithm.steps_per_iteration
        lead = math.ceil((sample.steps + 1) * environments / steps) + 1 if environments else 0
        residency = config.residency
        if residency is None:
            # Every core that is a device has a copy.
            copies = config.devices or jax.local_device_count() if jax.default_backend() == "cpu" else 1
            scenarios = int((memory or 0) / (scenario_bytes * copies))
            if scenarios >= total:
                return cls(source)
            if scenarios < 2:
                problem = f"{format_bytes(memory or 0)} hold {scenarios} scenarios of {format_bytes(scenario_bytes)}"
                raise UsageError(problem, cure="raise --memory")
            residency = _choose_residency(scenarios, steps, lead)
        return cls(source, Rotation(residency, total, config.seed, lead), replays_log)

    @property
    def config(self) -> TrainConfig:
        """Settings of the run, with the residency that was chosen."""
        config = self.source.config
        return config if self.rotation is None else replace(config, residency=self.rotation.residency)

    def load(self, iteration: int = 0) -> Any:
        """Return the environment's data in an iteration, given the number of finished ones."""
        if self.rotation is None:
            return self._with_stage(self.source.load())
        exchanges = self.rotation.exchanges(iteration)
        blocks = np.split(self.rotation.resident(exchanges), self.rotation.blocks)
        # Block by block as in training, because batches of other sizes may round otherwise.
        bank = jax.tree.map(_join, *(jax.tree.map(np.asarray, self._load(block)) for block in blocks))
        return replace(bank, chances=jnp.asarray(self.rotation.chances(exchanges)))

    def complete(self, data: Any, iteration: int = 0) -> Any:
        """Return the data of the algorithm in an iteration, given those of the environment.

        Raises:
            UsageError: There is a curriculum, but the algorithm draws logged steps.
        """
        rotation, source = self.rotation, self.source
        if rotation is not None:
            indices = rotation.resident(rotation.exchanges(iteration))
            try:
                return source.complete(data, indices)
            except DataError:
                if source.weights is None or not iteration:
                    raise
                # All weights of the scenarios that are resident now are 0.
                return replace(source, weights=np.ones_like(source.weights)).complete(data, indices)
        result = source.complete(data)
        if self.curriculum is not None and isinstance(result, Experience):
            cure = "leave out the curriculum, or demonstrations and weights"
            raise UsageError("a curriculum does not apply to logged steps", cure=cure)
        return result

    def resume(self, program: Program, state: Any, iteration: int, rows: Sequence[LoggedValues]) -> Any:
        """Load the data of a run that begins, or continues after some iterations with these logs; return its state."""
        rotation = self.rotation
        if self.curriculum is not None and iteration:
            for row in rows:
                self.curriculum.log(row)
            program.data = program.place(self.complete(self._with_stage(environment_data(program.data))))
        if rotation is None:
            return state
        exchanges = rotation.exchanges(iteration)
        if exchanges:
            program.data = None  # so that memory holds the scenarios once
            program.data = program.place(self.complete(self.load(iteration), iteration))
            if iteration % rotation.residency.every == 0:  # the state was saved before this exchange
                state = _drop_stale(state, rotation.first_row(exchanges - 1), rotation.residency.block)
        self._next = self._thread.submit(self._load, rotation.entering(exchanges))
        return program.arrange(state)

    def follow(self, program: Program, row: LoggedValues) -> str | None:
        """Move on in the curriculum by an iteration, given its log; return a line for the log if a stage begins."""
        if not self.curriculum:
            return None
        stage, factors = self.curriculum.number, self.curriculum.factors
        self.curriculum.log(row)
        begins = self.curriculum.number > stage
        if begins:
            program.data = program.place(self.complete(self._with_stage(program.data)))
        elif self.curriculum.factors != factors:
            program.data = replace(program.data, reward_factors=program.place(self._reward_factors()))
        return self.curriculum.text() if begins else None

    def note(self) -> dict[str, float]:
        """Return values to log about the present stage: its number, from 1 on."""
        return {"curriculum/stage": self.curriculum.number + 1.0} if self.curriculum else {}

    def _with_stage(self, bank: Any) -> Any:
        """Return the bank with the scenarios and reward factors of the present stage, if there is a curriculum."""
        if not self.curriculum:
            return bank
        chances = jnp.asarray(cumulative_probability(self.curriculum.scenarios))
        return replace(bank, chances=chances, reward_factors=self._reward_factors())

    def _reward_factors(self) -> dict[str, Array]:
        factors = {} if self.curriculum is None else self.curriculum.factors
        return {name: jnp.asarray(value, jnp.float32) for name, value in factors.items()}

    def exchange(self, program: Program, state: Any, iteration: int) -> tuple[Any, dict[str, float]]:
        """Exchange a block if one is due after an iteration; return the state, and values to log.

        Raises:
            DataError: A scenario is damaged, or its file has vanished.
        """
        rotation = self.rotation
        if rotation is None or iteration % rotation.residency.every:
            return state, {}
        if self._next is None:
            raise RuntimeError("call resume first")
        started = time.perf_counter()
        exchanges = rotation.exchanges(iteration)
        block, first = self._next.result(), rotation.first_row(exchanges - 1)
        waited = time.perf_counter() - started
        self._next = self._thread.submit(self._load, rotation.entering(exchanges))
        bank = replace(environment_data(program.data), chances=None)
        program.data = None  # its arrays are donated
        bank = _replace_rows(bank, program.place(block), first, rotation.residency)
        bank = replace(bank, chances=program.place(jnp.asarray(rotation.chances(exchanges))))
        program.data = program.place(self.complete(bank, iteration))
        state = program.arrange(_drop_stale(state, first, rotation.residency.block))
        taken = time.perf_counter() - started
        return state, {"residency/waited_s": waited, "residency/exchange_s": taken}

    def notices(self, data: Any) -> list[str]:
        """Return lines for the log about residency and weights of scenarios, given the data of the algorithm."""
        lines, rotation, weights = [], self.rotation, self.source.weights
        if self.curriculum:
            lines.append(self.curriculum.text())
        if rotation is not None:
            residency, iterations = rotation.residency, self.config.iterations
            size = format_bytes(sum(leaf.nbytes for leaf in jax.tree.leaves(environment_data(data))))
            entering = iterations // residency.every * residency.block
            times = (residency.scenarios + entering) / rotation.total
            lines.append(
                f"residency: {residency.scenarios:,} of {rotation.total:,} scenarios ({size} per device), "
                f"{residency.block} exchanged every {residency.every} iterations: {entering:,} enter in the run, so "
                f"that each is resident {times:.1f} times"
            )
        if weights is not None and not isinstance(data, Experience):
            total = len(self.source.scenarios)
            effective = effective_size(weights.reshape(total, -1).sum(axis=1))
            lines.append(
                f"episodes begin by weight: effective sample of {effective:,.0f} of {total:,} scenarios"
            )
        return lines

    def _load(self, scenarios: Indices) -> ScenarioBank:
        return _load(self.source, self._replays_log, scenarios)

    def close(self) -> None:
        """Stop the thread."""
        self._thread.shutdown(cancel_futures=True)


def _load(source: Source, replays_log: bool, rows: Indices) -> ScenarioBank:
    """Return the bank of some scenarios, with the expert's steps if the algorithm learns from them."""
    bank = source.bank(source.scenarios.take(rows.tolist()), source.scenarios.sizes)
    source.scenarios.release()
    return with_expert_steps(source.environment, bank) if replays_log else bank


def _join(*blocks: np.ndarray[Any, Any]) -> Array:
    return jax.device_put(np.concatenate(blocks))


@partial(jax.jit, static_argnums=3, donate_argnums=0)
def _replace_rows(bank: Any, block: Any, first: Int[Array, ""], residency: Residency) -> Any:
    """Return the bank with a block of scenarios replaced from row ``first`` on."""

    def update(rows: Array, new: Array) -> Array:
        per_scenario = rows.shape[0] // residency.scenarios
        return jax.lax.dynamic_update_slice_in_dim(rows, new, first * per_scenario, 0)

    return jax.tree.map(update, bank, block)


def _drop_stale(state: Any, first: int, count: int) -> Any:
    """Return the state with episodes over, and stored states forgotten, that are in rows to be replaced."""

    def is_stale(index: Int[Array, "..."]) -> Bool[Array, "..."]:
        return (index >= first) & (index < first + count)

    def visit(node: Any) -> Any:
        if isinstance(node, Environments):
            blocks = node.state if isinstance(node.state, tuple) else (node.state,)
            index = jnp.concatenate([block.context.index for block in blocks], axis=-1)
            return replace(node, over=node.over | is_stale(index))
        if isinstance(node, Replay) and node.store == "state":
            return replace(node, alive=node.alive & ~is_stale(node.stored.index))
        return node

    return jax.tree.map(visit, state, is_leaf=_is_node)


def _nodes(state: Any) -> list[Any]:
    """Return the environments and replay buffers of a state, and its other leaves."""
    return jax.tree.leaves(state, is_leaf=_is_node)


def _is_node(node: Any) -> bool:
    return isinstance(node, Environments | Replay)
