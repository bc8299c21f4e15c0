"""Scenario sets of the built-in world, drawn in worker processes and written in order, and the benchmark's splits.

With workers, the bytes of a set depend only on its options, seed, size and audit: not on the number of workers or the
processor. This module does not import JAX, so that workers start quickly; an audit that needs it is an argument.

A map is drawn from (seed, number of the map), so sets of different seeds share no map. :func:`generate` refuses the
seeds of the benchmark's splits, so no other set has their maps.
"""

from __future__ import annotations

import dataclasses
import gc
import importlib
import os
import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from itertools import islice, pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any

from drivax.errors import UsageError
from drivax.files import inside
from drivax.scenario.build.assemble import assemble
from drivax.scenario.schema import CAPACITIES, Capacity, Scenario
from drivax.scenario.select.splits import Shares, parse_shares
from drivax.scenario.store import ScenarioWriter, check_set_space
from drivax.synthetic.world import UNSUITED, WORLD_VERSION, WorldConfig, generate_many
from drivax.tracking.workers import environment, worker_pool

#: NumPy's module with the table of CPU features, and the environment variable that disables features.
_umath = importlib.import_module("numpy._core._multiarray_umath")
_FEATURES = "NPY_DISABLE_CPU_FEATURES"
#: Scenarios per audited batch; scenarios of the first batch and task, and least number in later tasks except the last.
_BATCH, _FIRST = 64, 4
#: Largest number of scenarios per task, and number of tasks per worker that smaller sets are divided into.
_CHUNK, _TASKS = 16, 4
#: Submitted tasks per worker, and batches in the audit, whose results may be outstanding.
_AHEAD, _AHEAD_BATCHES = 3, 1
_EVENT = "event"
#: Least and largest duration of a scenario after its current step, s.
_MIN_FUTURE_S, _MAX_FUTURE_S = 8.0, 60.0
#: First seed of the benchmark's splits.
RESERVED_SEED = 1_000_000_000
#: Increased when a split changes while the world's version stays.
BENCHMARK_VERSION = 3

#: Called with (finished scenarios, all scenarios).
Progress = Callable[[int, int], None]
#: Returns the audit findings of scenarios: one dictionary per scenario.
Audit = Callable[[list[Scenario]], list[dict[str, Any]]]


@contextmanager
def portable_workers() -> Iterator[None]:
    """Context in which newly started worker processes compute the same bits on any x86-64 processor."""
    # Features that the variable already disables count as missing in the table, so list them again.
    # NumPy splits the variable at commas, too. "Prescott": OpenBLAS's kernels for the oldest x86-64 processors.
    disabled = os.environ.get(_FEATURES, "").replace(",", " ").split()
    newer = [name for name in _umath.__cpu_dispatch__ if _umath.__cpu_features__[name] or name in disabled]
    with environment(**{_FEATURES: " ".join(newer), "OPENBLAS_CORETYPE": "Prescott"}):
        yield


@dataclass(frozen=True)
class Generation:
    """Options for generating a scenario set.

    Attributes:
        workers: Number of worker processes. With 0 this process draws the scenarios, and their last bits depend on the
            processor: only workers write the same bytes on any x86-64 processor.
        capacity: Padded sizes; sets that are used together need the same.
        future_s: Seconds of a scenario after its current step, 8 to 60; 15 in nuPlan's challenges.
        egos: Vehicles per scenario with a route and a goal, 1 to 8, which training with `egos: moving` drives.
        split: Write lists for train/validation/test to OUT/splits, by map: percentages, such as 80/10/10.
        overwrite: Replace OUT if it is a scenario set.
        world: Settings of the world.
    """

    workers: int = 0
    capacity: str = "default"
    future_s: float = _MIN_FUTURE_S
    egos: int = 1
    split: str | None = None
    overwrite: bool = False
    world: WorldConfig = field(default_factory=WorldConfig)

    def check(self) -> None:
        """Check the options.

        Raises:
            UsageError: An option is invalid.
        """
        if self.workers < 0:
            raise UsageError(f"workers is {self.workers}", cure="use 0 or more")
        if self.capacity not in CAPACITIES:
            raise UsageError(
                f"unknown capacity {self.capacity!r}", cure=f"use one of {', '.join(CAPACITIES)}"
            )
        if not _MIN_FUTURE_S <= self.future_s <= _MAX_FUTURE_S:
            raise UsageError(f"future_s is {self.future_s:g}", cure="use 8 to 60 seconds")
        _ = self.shares, self.sizes  # refuse invalid splits and numbers of egos
        self.world.check()

    @property
    def sizes(self) -> Capacity:
        """Padded sizes of a scenario with these options."""
        return CAPACITIES[self.capacity].with_future(self.future_s).with_egos(self.egos)

    @property
    def shares(self) -> Shares | None:
        """The percentages of ``split``."""
        return None if self.split is None else parse_shares(self.split)


@dataclass(frozen=True)
class FamilyCount:
    """Counts of one road family.

    Attributes:
        kept: Number of scenarios.
        rejected: Number of rejected draws by cause, without the unsuited ones.
        unsuited: Number of draws in which the requested event could not happen or did not endanger ego.
        events: Number of scenarios with each labelled event.
    """

    kept: int
    rejected: dict[str, int]
    unsuited: int = 0
    events: dict[str, int] = field(default_factory=dict)

    @property
    def rejection_rate(self) -> float:
        """Share of rejected draws among all but the unsuited ones; 0 without draws."""
        rejected = sum(self.rejected.values())
        return rejected / max(rejected + self.kept, 1)


@dataclass(frozen=True)
class GeneratedSet:
    """A generated set: its path, size, wall time in seconds, and counts per family."""

    path: Path
    scenarios: int
    seconds: float
    families: dict[str, FamilyCount]


@dataclass(frozen=True)
class _Draw:
    scenario: Scenario
    family: str
    rejected: dict[tuple[str, str], int]


class _Counts:
    """Counter of draws by family."""

    def __init__(self) -> None:
        self._kept: Counter[str] = Counter()
        self._unsuited: Counter[str] = Counter()
        self._rejected: defaultdict[str, Counter[str]] = defaultdict(Counter)
        self._events: defaultdict[str, Counter[str]] = defaultdict(Counter)

    def add(self, draw: _Draw) -> None:
        self._kept[draw.family] += 1
        for (family, cause), count in draw.rejected.items():
            if cause in UNSUITED:
                self._unsuited[family] += count
            else:
                self._rejected[family][cause] += count
        if _EVENT in draw.scenario.tags:
            self._events[draw.family][draw.scenario.tags[_EVENT]] += 1

    def families(self) -> dict[str, FamilyCount]:
        """Counts sorted by family, including families without a kept draw."""
        return {
            name: FamilyCount(
                self._kept[name], dict(self._rejected[name]), self._unsuited[name], dict(self._events[name])
            )
            for name in sorted({*self._kept, *self._rejected, *self._unsuited})
        }


def generate(
    out: str | Path, scenarios: int, seed: int = 0, options: Generation | None = None,
    progress: Progress | None = None, audit: Audit | None = None,
) -> GeneratedSet:  # fmt: skip
    """Generate a scenario set.

    Args:
        out: The scenario set to write; it appears when it is complete.
        scenarios: Number of scenarios.
        seed: Scenario ``i`` of a seed is the same in every set with the same options; sets of different seeds have no
            map in common.
        options: Options.
        progress: Called after every scenario.
        audit: Called in a thread of this process with batches of scenarios; its results are stored with them.

    Raises:
        UsageError: Invalid arguments, ``out`` exists and is not to be overwritten, or a scenario has no clean expert.
        DataError: The disk has too little space, or a worker died.
    """
    options = options or Generation()
    options.check()
    if scenarios < 1:
        raise UsageError(f"scenarios is {scenarios}", cure="use 1 or more")
    if not 0 <= seed < RESERVED_SEED:
        raise UsageError(f"seed is {seed}", cure=f"use 0 to {RESERVED_SEED - 1}")
    return write_set(out, scenarios, seed, options, {}, progress, audit)


def write_set(
    out: str | Path, scenarios: int, seed: int, options: Generation, notes: Mapping[str, Any],
    progress: Progress | None, audit: Audit | None,
) -> GeneratedSet:  # fmt: skip
    """Generate a set without checking the arguments; ``notes`` go into the manifest's source."""
    begin = time.monotonic()
    source = {"command": "generate", "world": WORLD_VERSION, "seed": seed, "scenarios": scenarios, **notes}
    source["config"] = dataclasses.asdict(options.world)
    counts = _Counts()
    check_set_space(out, options.sizes, scenarios)
    with (
        ScenarioWriter(
            out, options.sizes, source, overwrite=options.overwrite, shares=options.shares
        ) as writer,
        closing(_draws(scenarios, seed, options)) as draws,
        closing(_audit_batches(_count_draws(draws, counts, scenarios, progress), audit)) as pairs,
    ):
        for scenario, finding in pairs:
            writer.add(dataclasses.replace(scenario, audit={**scenario.audit, **finding}))
    return GeneratedSet(Path(out), scenarios, time.monotonic() - begin, counts.families())


def _count_draws(
    draws: Iterable[_Draw], counts: _Counts, scenarios: int, progress: Progress | None
) -> Iterator[Scenario]:
    """Count draws and report progress."""
    for done, draw in enumerate(draws, start=1):
        counts.add(draw)
        if progress is not None:
            progress(done, scenarios)
        yield draw.scenario


def _audit_batches(
    scenarios: Iterator[Scenario], audit: Audit | None
) -> Generator[tuple[Scenario, dict[str, Any]], None, None]:
    """Yield scenarios with their audits, computed in batches by a thread while further scenarios are drawn.

    The first batch is as small as the first task of a worker, so that the audit is compiled early. Without an audit,
    scenarios are passed on one by one.
    """
    if audit is None:
        yield from ((scenario, {}) for scenario in scenarios)
        return
    auditor = ThreadPoolExecutor(1)
    waiting: deque[tuple[list[Scenario], Future[list[dict[str, Any]]]]] = deque()
    try:
        size = _FIRST
        while batch := list(islice(scenarios, size)):
            waiting.append((batch, auditor.submit(audit, batch)))
            size = _BATCH
            if len(waiting) > _AHEAD_BATCHES:
                yield from _pairs(*waiting.popleft())
        while waiting:
            yield from _pairs(*waiting.popleft())
    finally:
        auditor.shutdown(wait=True, cancel_futures=True)


def _pairs(
    batch: list[Scenario], findings: Future[list[dict[str, Any]]]
) -> Iterator[tuple[Scenario, dict[str, Any]]]:
    return zip(batch, findings.result(), strict=True)


def _draw_chunk(first: int, end: int, seed: int, options: Generation) -> Iterator[_Draw]:
    """Draw scenarios ``first`` to ``end - 1``."""
    capacity = options.sizes
    for draw in generate_many(seed, range(first, end), options.world, capacity.steps):
        yield _Draw(assemble(draw.recording, capacity), draw.family, draw.rejected)


def _draw_in_worker(first: int, end: int, seed: int, options: Generation) -> list[_Draw]:
    """Draw a chunk in a worker; the garbage collector ignores imported objects, which saves time."""
    if not gc.get_freeze_count():
        gc.freeze()
    return list(_draw_chunk(first, end, seed, options))


def _spans(scenarios: int, workers: int) -> list[tuple[int, int]]:
    """Return first and end of each task's scenarios; the first task is short, so that the audit begins early."""
    size = min(max(scenarios // (_TASKS * workers), _FIRST), _CHUNK)
    return list(pairwise([0, *range(_FIRST, scenarios, size), scenarios]))


def _draws(scenarios: int, seed: int, options: Generation) -> Generator[_Draw, None, None]:
    """Draw all scenarios in order."""
    if options.workers == 0:
        yield from _draw_chunk(0, scenarios, seed, options)
        return
    spans = _spans(scenarios, options.workers)
    waiting: deque[Future[list[_Draw]]] = deque()
    with worker_pool(min(options.workers, len(spans))) as pool:
        for first, end in spans:
            with portable_workers():  # the pool starts processes when a task is submitted
                waiting.append(pool.submit(_draw_in_worker, first, end, seed, options))
            if len(waiting) > _AHEAD * options.workers:
                yield from waiting.popleft().result()
        while waiting:
            yield from waiting.popleft().result()


@dataclass(frozen=True)
class BenchmarkSplit:
    """One of the benchmark's sets; without a ``rare_rate`` it has the configuration's share of events."""

    scenarios: int
    seed: int
    rare_rate: float | None = None


SPLITS: Mapping[str, BenchmarkSplit] = MappingProxyType(
    {
        "train": BenchmarkSplit(4096, RESERVED_SEED),
        "validation": BenchmarkSplit(512, RESERVED_SEED + 1),
        "test": BenchmarkSplit(1024, RESERVED_SEED + 2),
        "test-rare": BenchmarkSplit(512, RESERVED_SEED + 3, rare_rate=1.0),
    }
)


def sizes(train: int | None = None) -> dict[str, int]:
    """Sizes of the splits, scaled to a size of the training set if it is given.

    Raises:
        UsageError: ``train`` is not positive.
    """
    full = SPLITS["train"].scenarios
    train = full if train is None else train
    if train < 1:
        raise UsageError(f"the size of the training set is {train}", cure="use 1 or more scenarios")
    return {name: max(round(split.scenarios * train / full), 1) for name, split in SPLITS.items()}


def generate_benchmark(
    out: str | Path, options: Generation | None = None, train: int | None = None,
    progress: Progress | None = None, audit: Audit | None = None,
) -> dict[str, GeneratedSet]:  # fmt: skip
    """Write ``OUT/train``, ``OUT/validation``, ``OUT/test`` and ``OUT/test-rare``.

    Args:
        out: Folder of the sets.
        options: Options with the default ``future_s``; of the world only the domain may differ from the default.
        train: Size of the training set, for tests and trials; the other sets are scaled with it, to at least 1. Smaller
            sets are prefixes of the full ones.
        progress: Called after every scenario, with counts over all splits.
        audit: See :func:`generate`.

    Raises:
        UsageError: Invalid arguments, or one of the sets exists and is not to be overwritten.
        DataError: The disk has too little space, a set's name is a symbolic link, or a worker died.
    """
    options = options or Generation()
    options.check()
    if options.world != WorldConfig(domain=options.world.domain) or options.future_s != _MIN_FUTURE_S:
        raise UsageError(
            "the benchmark's future_s is 8, and its world is fixed but for its domain",
            cure="leave out other settings, or generate a set that is not the benchmark",
        )
    counts, sets = sizes(train), dict[str, GeneratedSet]()
    check_set_space(out, options.sizes, sum(counts.values()))
    for name in SPLITS:
        # Refuse existing sets before any is generated.
        ScenarioWriter(inside(Path(out), name), options.sizes, overwrite=options.overwrite)
    for name, split in SPLITS.items():
        world = options.world
        if split.rare_rate is not None:
            world = dataclasses.replace(world, rare_rate=split.rare_rate)
        notes = {"benchmark": BENCHMARK_VERSION, "split": name}
        done = sum(counts[earlier] for earlier in sets)

        def report(current: int, _: int, done: int = done) -> None:
            if progress is not None:
                progress(done + current, sum(counts.values()))

        split_options = dataclasses.replace(options, world=world)
        sets[name] = write_set(
            inside(Path(out), name), counts[name], split.seed, split_options, notes, report, audit
        )
    return sets
