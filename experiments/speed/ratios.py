"""Time this tree against another, alternately, in one run; the ratios go into the page on speed.

    git worktree add ../before COMMIT
    python -m experiments.speed.ratios --data SET --against ../before [--only NAME ...] [--write]
    python -m experiments.speed.ratios --data SET --kernels [--only NAME ...] [--write]
    python -m experiments.speed.ratios --data SET --cores [--only NAME ...] [--write]

``--against`` times two trees without native kernels, ``--kernels`` this tree without native kernels and with them, and
``--cores`` this tree with native kernels on one core and on all cores. Both sides train with the presets of the first
side.

SET has at least 1,024 scenarios, and both trees can open it. Each tree runs in processes of its own. A repeated
measurement keeps one process per side alive, runs both alternately, and reports the median of the ratios of adjacent
runs; the first runs of each, which compile, do not count. A command starts in a new process, with an empty compilation
cache (``first``) or with that of an earlier run (``again``). Nothing else may run on the machine. Each row has the time
of a fixed program and the load before and after it.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from drivax.files import write_json
from drivax.tracking.run_folder import versions
from experiments.repository import DOCS, RESULTS, ROOT
from experiments.speed.machine import HEADINGS, cells, conditions

RESULT = RESULTS / "speed_ratios.json"
PAGE = DOCS / "results" / "speed.md"


@dataclass(frozen=True)
class Comparison:
    """Kind of comparison: key of its rows in the result, markers around its table, and headings of the two sides."""

    key: str
    begin: str
    end: str
    sides: tuple[str, str]


TREES = Comparison("rows", "<!-- ratios.py: begin -->", "<!-- ratios.py: end -->", ("before", "after"))
KERNELS = Comparison(
    "kernel_rows", "<!-- ratios.py kernels: begin -->", "<!-- ratios.py kernels: end -->", ("without", "with")
)
CORES = Comparison(
    "core_rows", "<!-- ratios.py cores: begin -->", "<!-- ratios.py cores: end -->", ("one core", "all cores")
)
COMPARISONS = (TREES, KERNELS, CORES)

#: Pins a program to one core; it comes before anything that starts JAX.
_ONE_CORE = "import os; os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})\n"
#: Setup that several programs share: the first scenarios of the set, as a bank.
_BANK = """
import jax
from drivax.evaluation.audit import scenario_names
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.store import ScenarioSet
stored = ScenarioSet.open(DATA)
def first(count):
    return [stored[row] for row in range(count)]
"""
_TRAINING = (
    """
from drivax import cli
if hasattr(cli, "use_huge_pages"):  # as the command `train` of this tree does
    cli.use_huge_pages()
"""
    + _BANK
    + """
from drivax import settings
from drivax.learning.config import TrainConfig
from drivax.learning import program
from drivax.simulator.traffic.log import LogTraffic
if hasattr(program, "use_all_cores"):  # as the command `train` of this tree does
    program.use_all_cores()
def trainer(preset, *overrides, prepare=lambda algorithm, environment, bank: bank):
    config = settings.load(TrainConfig, f"{PRESETS}/{preset}.yaml", list(overrides))
    bank = ScenarioBank.from_scenarios(first(1024))
    environment = config.environment(LogTraffic())
    learner = config.algorithm.build(environment, bank, config.iterations)
    data = prepare(config.algorithm, environment, bank)
    compiled = program.Program(program.Seeds(learner, (0,)), data, config.devices)
    state = [compiled.initial_state()]
    def call():
        state[0], logs = compiled.step(state[0])
        jax.block_until_ready((state[0], logs))
        return config.algorithm.steps_per_iteration
    return call
"""
)


@dataclass(frozen=True)
class Side:
    """One of the two sides that are compared: a tree, with variables of the environment, on all cores or on one."""

    tree: Path
    variables: Mapping[str, str] = field(default_factory=dict)
    one_core: bool = False


@dataclass(frozen=True)
class Repeated:
    """A program that defines ``call()``, which returns the amount of work that it did."""

    unit: str
    program: str
    #: By comparison; those without a goal are measured only when they are named.
    goals: Mapping[Comparison, str] = field(default_factory=dict)
    warm_up: int = 1


@dataclass(frozen=True)
class Command:
    """A command of the command line, timed to its end, or to the first line of a file."""

    words: Sequence[str]
    until: str | None
    goals: Mapping[Comparison, str] = field(default_factory=dict)


_EVALUATE = ("evaluate", "--planner", "idm", "--data", "DATA", "--limit", "4", "--out", "OUT")
_TRAIN = ("train", "ppo", "--data", "DATA", "--out", "OUT")
#: What is timed, with the goal: what must be reached, and the aim in parentheses.
MEASUREMENTS: dict[str, Repeated | Command] = {
    "PPO training": Repeated(
        "steps/s",
        _TRAINING + "call = trainer('ppo')",
        {TREES: "1.4 x (1.8 x)", KERNELS: "1.8 x (3 x)", CORES: "1.8 x"},
    ),
    "PPO training, one core": Repeated(
        "steps/s",
        _ONE_CORE + _TRAINING + "call = trainer('ppo', '--devices', '1')",
        {KERNELS: "2.0 x (3 x)"},
    ),
    # Updates begin after 512 steps instead of 10,000.
    "SAC training": Repeated(
        "steps/s",
        _TRAINING + "call = trainer('sac', '--algorithm.warm_up', '512')",
        {TREES: "1.2 x (1.5 x)", KERNELS: "2.0 x (3 x)"},
        warm_up=3,
    ),
    "offline training (CQL)": Repeated(
        "steps/s",
        _TRAINING
        + """
from drivax.learning.algorithm import training_data
call = trainer('offline/cql', prepare=training_data)
""",
        {KERNELS: "2.0 x (3 x)"},
    ),
    "simulator, full, log": Repeated(
        "steps/s",
        """
import jax, os
jax.config.update('jax_num_cpu_devices', len(os.sched_getaffinity(0)))
"""
        + _BANK
        + """
from drivax.studies import bench
program = bench.compile_program(ScenarioBank.from_scenarios(first(1024)), bench.BenchConfig())
def call():
    jax.block_until_ready(program.run())
    return program.steps
""",
        {TREES: "1.1 x (1.3 x)", KERNELS: "1.3 x (3 x)"},
    ),
    "PDM-Closed evaluation": Repeated(
        "scenarios/s",
        _BANK
        + """
from drivax.evaluation.runner import evaluate
from drivax.planners.catalogue import make_planner
scenarios = first(64)
bank, names = ScenarioBank.from_scenarios(scenarios), scenario_names(scenarios)
planner = make_planner("pdm", None)
def call():
    return len(evaluate(planner, bank, names))
""",
        {TREES: "3 x (10 x)", KERNELS: "1.3 x (3 x)"},
    ),
    "generation, one core": Repeated(
        "scenarios/s",
        """
import tempfile
from drivax.synthetic.generate import generate
seed = [0]
def call():
    with tempfile.TemporaryDirectory() as folder:
        generate(folder + "/set", 128, seed[0])
    seed[0] += 1
    return 128
""",
        {TREES: "2 x (4 x)"},
    ),
    "bank building": Repeated(
        "scenarios/s",
        _BANK
        + """
scenarios = first(1024)
def call():
    jax.block_until_ready(ScenarioBank.from_scenarios(scenarios))
    return len(scenarios)
""",
        {TREES: "2,000/s (5,000/s)"},
    ),
    "evaluate, 4 scenarios, first": Command(_EVALUATE, None, {TREES: "12 s (8 s)"}),
    "evaluate, 4 scenarios, again": Command(_EVALUATE, None, {TREES: "5 s (3 s)"}),
    "train to its first iteration, first": Command(_TRAIN, "metrics.jsonl"),
    "train to its first iteration, again": Command(_TRAIN, "metrics.jsonl", {TREES: "15 s (8 s)"}),
}
#: Program that calls ``call`` for each line of input, and prints the work done and the seconds.
_LOOP = """
import sys, time
for line in sys.stdin:
    begin = time.perf_counter()
    work = call()
    print("done", work, time.perf_counter() - begin, flush=True)
"""


def environment(side: Side, cache: str) -> dict[str, str]:
    """Return the environment of a process of one side, with its compilation cache."""
    variables = {
        "PYTHONPATH": str(side.tree / "src"),
        "JAX_PLATFORMS": "cpu",
        "JAX_COMPILATION_CACHE_DIR": cache,
    }
    return {**os.environ, **variables, **side.variables}


def check_kernels(sides: Sequence[Side]) -> None:
    """Check that native kernels are in use on every side that does not switch them off.

    Raises:
        SystemExit: They are not, or are in use on another side.
    """
    program = "from drivax import kernels; print(kernels.in_use(), kernels.state())"
    for side in sides:
        command = [sys.executable, "-c", program]
        output = subprocess.check_output(command, env=environment(side, ""), text=True)
        in_use, _, state = output.strip().partition(" ")
        expected = side.variables.get("DRIVAX_NATIVE") != "0"
        if in_use != str(expected):
            raise SystemExit(f"nothing to compare {'with' if expected else 'without'} kernels: {state}")


class Worker:
    """A process of one side that runs a program again and again."""

    def __init__(self, side: Side, program: str, data: Path, presets: Path, cache: str) -> None:
        constants = f"DATA, PRESETS = {str(data)!r}, {str(presets)!r}"
        pinned = _ONE_CORE if side.one_core else ""
        command = [sys.executable, "-c", f"{constants}\n{pinned}{program}\n{_LOOP}"]
        self._process = subprocess.Popen(
            command,
            env=environment(side, cache),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def run(self) -> float:
        """Run once and return work per second.

        Raises:
            SystemExit: The program failed.
        """
        source, target = self._process.stdout, self._process.stdin
        assert source is not None and target is not None
        print("run", file=target, flush=True)
        for line in source:
            if line.startswith("done "):
                _, work, seconds = line.split()
                return float(work) / float(seconds)
        self.close()
        raise SystemExit("the timed program failed")

    def close(self) -> None:
        """End the process."""
        self._process.communicate()


def repeated(measurement: Repeated, sides: Sequence[Side], data: Path, repeats: int) -> dict[str, Any]:
    """Return medians of work per second of both sides, measured alternately."""
    with tempfile.TemporaryDirectory() as cache:
        presets = sides[0].tree / "configs"
        workers = [
            Worker(side, measurement.program, data, presets, f"{cache}/{k}") for k, side in enumerate(sides)
        ]
        for worker in workers:
            for _ in range(measurement.warm_up):
                worker.run()
        pairs = []
        for turn in range(repeats):
            order = (0, 1) if turn % 2 == 0 else (1, 0)
            speeds = {k: workers[k].run() for k in order}
            pairs.append((speeds[0], speeds[1]))
        for worker in workers:
            worker.close()
    before, after = (statistics.median(side) for side in zip(*pairs, strict=True))
    ratios = [after / before for before, after in pairs]
    return {
        "unit": measurement.unit,
        "before": round(before, 3) if before < 100 else round(before),
        "after": round(after, 3) if after < 100 else round(after),
        "ratio": round(statistics.median(ratios), 2),
        "smallest": round(min(ratios), 2),
        "largest": round(max(ratios), 2),
    }


def command_seconds(command: Command, side: Side, data: Path, folder: Path, cache: Path) -> float:
    """Seconds to the end of a command, or to the first line of its file ``until``."""
    out = Path(tempfile.mkdtemp(dir=folder)) / "out"
    words = [{"DATA": str(data), "OUT": str(out)}.get(word, word) for word in command.words]
    begin = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "drivax", *words],
        env=environment(side, str(cache)),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    while process.poll() is None:
        log = out / (command.until or "")
        if command.until and log.is_file() and log.stat().st_size:
            break
        time.sleep(0.02)
    seconds = time.perf_counter() - begin
    if process.poll() is None:
        process.kill()
        process.wait()
    elif process.returncode:
        raise SystemExit(f"failed: drivax {' '.join(words)}")
    return seconds


def timed_command(
    name: str, command: Command, sides: Sequence[Side], data: Path, repeats: int
) -> dict[str, Any]:
    """Return medians of the seconds of a command on both sides, measured alternately."""
    pairs = []
    with tempfile.TemporaryDirectory() as top:
        folder = Path(top)
        for turn in range(repeats + 1):
            keeps_cache = not name.endswith("first")
            caches = [folder / f"cache-{k}{'' if keeps_cache else f'-{turn}'}" for k in (0, 1)]
            seconds = [
                command_seconds(command, side, data, folder, cache)
                for side, cache in zip(sides, caches, strict=True)
            ]
            # The first turn fills the caches, and the page cache.
            if turn or not keeps_cache:
                pairs.append((seconds[0], seconds[1]))
    before, after = (statistics.median(side) for side in zip(*pairs, strict=True))
    return {
        "unit": "s",
        "before": round(before, 1),
        "after": round(after, 1),
        "ratio": round(statistics.median([before / after for before, after in pairs]), 2),
    }


def commit_of(tree: Path) -> str:
    """Return the short hash of the commit that is checked out in a tree."""
    command = ["git", "-C", str(tree), "rev-parse", "--short=7", "HEAD"]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def measure(names: Sequence[str], sides: Sequence[Side], data: Path, repeats: int) -> dict[str, Any]:
    """Return a row for each measurement, with the commits, the machine's speed and the load."""
    rows = {}
    commits = {name: commit_of(side.tree) for name, side in zip(("before", "after"), sides, strict=True)}
    for name in names:
        measurement = MEASUREMENTS[name]
        with conditions() as record:
            if isinstance(measurement, Repeated):
                row = repeated(measurement, sides, data, repeats)
            else:
                row = timed_command(name, measurement, sides, data, max(1, repeats // 3))
        rows[name] = row = row | record | {"commits": commits}
        print(f"{name}: {json.dumps(row)}", flush=True)
    return rows


def table(rows: Mapping[str, Any], comparison: Comparison = TREES) -> str:
    """Return the Markdown table of stored ratios."""
    first, second = comparison.sides
    lines = [
        f"| what | ratio | goal (aim) | {first} | {second} | unit | {HEADINGS} |",
        "|---|---:|---|---:|---:|---|---|---|",
    ]
    for name, row in rows.items():
        goal = MEASUREMENTS[name].goals.get(comparison, "")
        lines.append(
            f"| {name} | {row['ratio']} | {goal} | {row['before']:,} "
            f"| {row['after']:,} | {row['unit']} | {cells(row)} |"
        )
    return "\n".join(lines)


def write_tables(result: Mapping[str, Any]) -> None:
    """Put all tables into the page."""
    for comparison in COMPARISONS:
        before, rest = PAGE.read_text().split(comparison.begin)
        rows = table(result.get(comparison.key, {}), comparison)
        PAGE.write_text(
            f"{before}{comparison.begin}\n\n{rows}\n\n{comparison.end}{rest.split(comparison.end)[1]}"
        )


def main() -> None:
    """Measure, print, and with ``--write`` store the result and the tables of the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path)
    parser.add_argument("--against", type=Path, help="root of the other tree")
    parser.add_argument("--kernels", action="store_true", help="this tree without and with native kernels")
    parser.add_argument(
        "--cores", action="store_true", help="this tree with native kernels, on one core and on all"
    )
    parser.add_argument("--only", nargs="+", choices=MEASUREMENTS)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--write", action="store_true", help="store the rows; others stay")
    parser.add_argument("--table", action="store_true", help="write the stored rows into the page")
    args = parser.parse_args()
    if not args.table:
        if args.data is None or (args.against is not None) + args.kernels + args.cores != 1:
            parser.error("needs --data, and one of --against, --kernels and --cores")
        without = Side(ROOT, {"DRIVAX_NATIVE": "0"})
        if args.kernels:
            comparison, sides = KERNELS, (without, Side(ROOT))
            check_kernels(sides)
        elif args.cores:
            comparison, sides = CORES, (Side(ROOT, one_core=True), Side(ROOT))
            check_kernels(sides)
        else:
            comparison, sides = TREES, (Side(args.against.resolve()), without)
        names = args.only or [name for name, row in MEASUREMENTS.items() if comparison in row.goals]
        rows = measure(names, sides, args.data.resolve(), args.repeats)
        if args.write:
            result = json.loads(RESULT.read_text()) if RESULT.exists() else {}
            stored = result.get(comparison.key, {}) | rows
            result[comparison.key] = {name: stored[name] for name in MEASUREMENTS if name in stored}
            result["command"] = (
                "python -m experiments.speed.ratios --data SET [--against TREE | --kernels | --cores] --write"
            )
            write_json(RESULT, result | {"versions": versions()})
    if args.write or args.table:
        write_tables(json.loads(RESULT.read_text()))


if __name__ == "__main__":
    main()
