"""The fixed splits of the built-in world that tables quote, together with the world's version.

A map is drawn from (seed, number of the map), so sets of different seeds share no map. Each split has a seed of its
own, from a range that ``generate`` refuses to users: training on a benchmark's maps by accident is impossible. Both
domains have the same seeds, since the same draws make other roads there.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from drivax.errors import UsageError
from drivax.synthetic.generate import (
    RESERVED_SEED,
    Audit,
    GeneratedSet,
    Generation,
    Progress,
    write_set,
)
from drivax.synthetic.world import WorldConfig

#: Raised whenever a split becomes another one though the world's version stays.
BENCHMARK_VERSION = 3


@dataclass(frozen=True)
class Split:
    """One of the sets.

    Attributes:
        scenarios: How many.
        seed: Of its maps and of all that happens there.
        rare_rate: Share of scenarios with a labelled event; None: that of the configuration.
    """

    scenarios: int
    seed: int
    rare_rate: float | None = None


SPLITS: Mapping[str, Split] = MappingProxyType(
    {
        "train": Split(4096, RESERVED_SEED),
        "validation": Split(512, RESERVED_SEED + 1),
        "test": Split(1024, RESERVED_SEED + 2),
        "test-rare": Split(512, RESERVED_SEED + 3, rare_rate=1.0),
    }
)


def sizes(train: int | None = None) -> dict[str, int]:
    """Scenarios of each split; where ``train`` gives another size for that one, the others are scaled with it.

    Raises:
        UsageError: ``train`` is not positive.
    """
    if train is None:
        return {name: split.scenarios for name, split in SPLITS.items()}
    if train < 1:
        raise UsageError(f"scenarios is {train}", cure="use 1 or more")
    full = SPLITS["train"].scenarios
    return {name: max(round(split.scenarios * train / full), 1) for name, split in SPLITS.items()}


def generate_benchmark(
    out: str | Path,
    options: Generation | None = None,
    train: int | None = None,
    progress: Progress | None = None,
    audit: Audit | None = None,
) -> dict[str, GeneratedSet]:
    """Write ``OUT/train``, ``OUT/validation``, ``OUT/test`` and ``OUT/test-rare``.

    Args:
        out: A folder.
        options: How; of its world only the domain may be chosen.
        train: Scenarios of the training set, for tests and trials; the others are scaled with it. Smaller sets are
            the beginnings of the full ones.
        progress: Called after every scenario, with counts over all splits.
        audit: As for ``generate``.

    Raises:
        UsageError: Options that cannot be meant, or one of the sets exists.
    """
    options = options or Generation()
    options.check()
    if options.world != WorldConfig(domain=options.world.domain):
        raise UsageError(
            "the benchmark's world is fixed but for its domain", cure="use generate for other settings"
        )
    counts, done = sizes(train), 0
    total = sum(counts.values())
    sets: dict[str, GeneratedSet] = {}
    for name, split in SPLITS.items():
        world = options.world
        if split.rare_rate is not None:
            world = dataclasses.replace(world, rare_rate=split.rare_rate)
        notes = {"benchmark": BENCHMARK_VERSION, "split": name}
        before = done

        def report(here: int, _: int, before: int = before) -> None:
            if progress is not None:
                progress(before + here, total)

        sets[name] = write_set(
            Path(out) / name,
            counts[name],
            split.seed,
            dataclasses.replace(options, world=world),
            notes,
            report,
            audit,
        )
        done += counts[name]
    return sets
