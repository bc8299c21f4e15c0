"""Training on more scenarios than memory holds: some are resident, and blocks of them are exchanged in training.

Scenarios enter in shuffled passes through the set. Which of them are resident depends only on the number of finished
iterations, so a resumed run goes on with the same ones. No new episode begins in a block that is about to leave. Should
one be under way all the same, as in a warm start, whose environments rest during behaviour cloning, it is abandoned.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, UInt

from drivax.errors import UsageError
from drivax.files import format_bytes
from drivax.learning.config import Residency, TrainConfig
from drivax.learning.driving import with_expert_steps
from drivax.learning.environment import Environments
from drivax.learning.experience import Experience, cumulative_probability, environment_data
from drivax.learning.program import Program
from drivax.learning.replay import Replay
from drivax.learning.training_set import Rows, Source
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.bank.sizes import Sizes

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

    def text(self, scenario_bytes: float, config: TrainConfig) -> str:
        """Return a line for the log of a run, given the bytes of a scenario."""
        residency, iterations = self.residency, config.iterations
        size = format_bytes(int(residency.scenarios * scenario_bytes))
        of_pass = math.ceil(self.total * residency.every / residency.block)
        passes = (residency.scenarios + iterations // residency.every * residency.block) / self.total
        return (
            f"residency: {residency.scenarios:,} of {self.total:,} scenarios ({size} per device); "
            f"{residency.block} are exchanged every {residency.every} iterations, all in {of_pass:,} of "
            f"{iterations:,}: a scenario is resident {passes:.1f} times"
        )


@lru_cache(maxsize=2)
def _shuffled(total: int, seed: int, number: int) -> Int[np.ndarray, " total"]:
    """Return the order of scenarios in a pass."""
    return np.random.default_rng([seed, number]).permutation(total)


def _within(scenarios: int, steps_per_iteration: int, lead: int) -> Residency:
    """Return the exchange of this many resident scenarios or a few less, given the iterations of an episode.

    A scenario stays for about eight episodes, or longer if more than an eighth would be about to leave.
    """
    rate = steps_per_iteration / (_EPISODES * _EPISODE_STEPS)
    block = max(1, min(_MOST_BLOCK, scenarios // 64))
    most = max(_MOST_LEAVING * scenarios - 2 * block, block / 2) / max(lead, 1)
    every = max(1, math.ceil(block / min(rate, most)))
    return Residency(max(scenarios // block, 2) * block, block, every)


class Residents:
    """The resident scenarios of a training run; a thread prepares the block that enters next."""

    def __init__(
        self, rotation: Rotation, load: Callable[[Rows], Any], source: Source, note: str = ""
    ) -> None:
        self.rotation, self.note = rotation, note
        self._load, self._source = load, source
        self._thread = ThreadPoolExecutor(1, "residents")
        self._next: Future[Any] | None = None
        self._update = jax.jit(partial(_replace_rows, rotation.residency), donate_argnums=0)

    @classmethod
    def of(cls, source: Source, memory: int | None) -> Residents | None:
        """Return the residents of a run, as configured or as many as fit in ``memory`` bytes; None: all are resident.

        Raises:
            UsageError: There are recorded episodes, or too few scenarios are resident for the length of episodes.
        """
        config, total = source.config, len(source.scenarios)
        if memory is None and config.residency is None:
            return None
        if source.episodes:
            cure = "leave out --memory and residency, or the episodes"
            raise UsageError("recorded episodes need all of their scenarios on the device", cure=cure)
        load = partial(_load, source, Sizes.used(source.scenarios), False)
        rows = np.arange(min(total, _SAMPLE))
        sample = load(rows)
        learner = config.algorithm.build(source.environment, sample, config.iterations)
        experience = source.complete(sample, rows)
        if isinstance(experience, Experience):
            load = partial(_load, source, Sizes.used(source.scenarios), True)
            sample = load(rows)
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
                return None
            residency = _within(scenarios, steps, lead)
        rotation = Rotation(residency, total, config.seed, lead)
        return cls(rotation, load, source, rotation.text(scenario_bytes, config))

    def load(self, iteration: int) -> ScenarioBank:
        """Return the bank for an iteration, given the number of finished ones, and begin to load the next block."""
        exchanges = self._exchanges(iteration)
        blocks = np.split(self.rotation.resident(exchanges), self.rotation.blocks)
        # Block by block as in training, because batches of other sizes may round otherwise.
        bank = jax.tree.map(_join, *(jax.tree.map(np.asarray, self._load(rows)) for rows in blocks))
        if self._next is not None:
            self._next.cancel()
        self._next = self._thread.submit(self._load, self.rotation.entering(exchanges))
        return replace(bank, chances=jnp.asarray(self.rotation.chances(exchanges)))

    def complete(self, bank: ScenarioBank, iteration: int) -> Any:
        """Return the data of the iteration after a number of finished ones, given its bank."""
        return self._source.complete(bank, self.rotation.resident(self._exchanges(iteration)))

    def exchange(self, program: Program, state: Any, iteration: int) -> tuple[Any, dict[str, float]]:
        """Exchange a block if one is due after an iteration; return the state, and values to log.

        Raises:
            DataError: A scenario is damaged, or its file has vanished.
        """
        rotation = self.rotation
        if iteration % rotation.residency.every or self._next is None:
            return state, {}
        started = time.perf_counter()
        exchanges = self._exchanges(iteration)
        block, first = self._next.result(), rotation.first_row(exchanges - 1)
        waited = time.perf_counter() - started
        self._next = self._thread.submit(self._load, rotation.entering(exchanges))
        bank = replace(environment_data(program.data), chances=None)
        program.data = None  # its arrays are donated
        bank = self._update(bank, program.place(block), first)
        bank = replace(bank, chances=program.place(jnp.asarray(rotation.chances(exchanges))))
        program.data = program.place(self.complete(bank, iteration))
        state = _leave(state, first, rotation.residency.block)
        taken = time.perf_counter() - started
        return state, {"residency/waited_s": waited, "residency/exchange_s": taken}

    def _exchanges(self, iteration: int) -> int:
        return iteration // self.rotation.residency.every

    def close(self) -> None:
        """Stop the thread."""
        self._thread.shutdown(cancel_futures=True)


def _load(source: Source, sizes: Sizes, replays_log: bool, rows: Rows) -> ScenarioBank:
    """Return the bank of some scenarios, with the expert's steps if the algorithm learns from them."""
    bank = source.bank(source.scenarios.take(rows.tolist()), sizes)
    source.scenarios.release()
    return with_expert_steps(source.environment, bank) if replays_log else bank


def _join(*blocks: np.ndarray[Any, Any]) -> Array:
    return jax.device_put(np.concatenate(blocks))


def _replace_rows(residency: Residency, data: Any, part: Any, first: Int[Array, ""]) -> Any:
    """Return the data with a block of scenarios replaced from row ``first`` on."""

    def update(rows: Array, new: Array) -> Array:
        per_scenario = rows.shape[0] // residency.scenarios
        return jax.lax.dynamic_update_slice_in_dim(rows, new, first * per_scenario, 0)

    return jax.tree.map(update, data, part)


def _leave(state: Any, first: int, count: int) -> Any:
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
