"""Time the commands that write files against those of another checkout; the ratios go into the page on speed.

    git worktree add ../before COMMIT
    python -m experiments.speed.commands --against ../before [--only NAME ...] [--repeats 9] [--write]
    python -m experiments.speed.commands --table

The commands are those that ``experiments.robustness`` stops, on larger sets. Each checkout has a work folder of its
own, in which all commands run once, which compiles their programs. Then both run each command alternately, in new
processes; the outputs of the run before are removed first. Both run without native kernels. Nothing else may run on the
machine.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from scipy.stats import binom

from drivax.files import write_json
from drivax.tracking.run_folder import versions
from experiments.repository import DOCS, RESULTS, ROOT
from experiments.robustness import CONFIGS, commands, remove_outputs
from experiments.speed.machine import HEADINGS, cells, conditions
from experiments.speed.ratios import Side, commit_of, environment

RESULT = RESULTS / "command_times.json"
PAGE = DOCS / "results" / "speed.md"
BEGIN, END = "<!-- commands.py: begin -->", "<!-- commands.py: end -->"
#: By name, on 128 scenarios and a part of 64, without those that earlier checkouts lack.
COMMANDS = {name: command for name, command in commands(128, 64).items() if name != "record"}


def run(name: str, side: Side, work: Path) -> float:
    """Run a command in a work folder, without its former outputs, and return its seconds.

    Raises:
        SystemExit: It failed.
    """
    command = COMMANDS[name]
    remove_outputs(command, work)
    variables = environment(side, str(work / "cache")) | {
        "XLA_FLAGS": f"--xla_force_host_platform_device_count={command.devices}",
        "PYTHONPYCACHEPREFIX": str(work / "bytecode"),
    }
    variables.pop("PYTHONDONTWRITEBYTECODE", None)  # an installed package has compiled bytecode
    call = [sys.executable, "-m", "drivax", *command.arguments]
    begin = time.perf_counter()
    result = subprocess.run(call, cwd=work, env=variables, capture_output=True, text=True)
    seconds = time.perf_counter() - begin
    if result.returncode:
        raise SystemExit(f"failed in {side.tree}: {' '.join(call[2:])}: {result.stderr[-600:]}")
    return seconds


def measure(
    names: Sequence[str], sides: Sequence[Side], repeats: int
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the name and the row of each command."""
    commits = {key: commit_of(side.tree) for key, side in zip(("before", "after"), sides, strict=True)}
    last = max(list(COMMANDS).index(name) for name in names)
    with tempfile.TemporaryDirectory() as top:
        works = [Path(top, key) for key in commits]
        for work, side in zip(works, sides, strict=True):
            work.mkdir()
            for file, text in CONFIGS.items():
                (work / file).write_text(text)
            for name in list(COMMANDS)[: last + 1]:
                run(name, side, work)
        for name in names:
            pairs = []
            with conditions() as record:
                for turn in range(repeats):
                    order = (0, 1) if turn % 2 == 0 else (1, 0)
                    seconds = {k: run(name, sides[k], works[k]) for k in order}
                    pairs.append((seconds[0], seconds[1]))
            yield name, row(pairs) | record | {"commits": commits}


def row(pairs: Sequence[tuple[float, float]]) -> dict[str, float]:
    """Return median seconds before and after, and the median of their ratios with an interval of 95 % (sign test)."""
    before, after = (statistics.median(side) for side in zip(*pairs, strict=True))
    ratios = sorted(after / before for before, after in pairs)
    # The median lies outside with a probability of at most 5 %; few pairs have no such interval.
    outside = max(int(binom.ppf(0.025, len(ratios), 0.5)), 1) - 1
    return {
        "before_s": round(before, 2),
        "after_s": round(after, 2),
        "time_ratio": round(statistics.median(ratios), 3),
        "low": round(ratios[outside], 3),
        "high": round(ratios[-1 - outside], 3),
    }


def table(rows: Mapping[str, Any]) -> str:
    """Return the Markdown table of stored rows."""
    lines = [
        f"| command | time after / before | before (s) | after (s) | {HEADINGS} |",
        "|---|---:|---:|---:|---|---|",
    ]
    for name, values in rows.items():
        ratio = f"{values['time_ratio']:.3f} [{values['low']:.3f}, {values['high']:.3f}]"
        lines.append(
            f"| `{' '.join(COMMANDS[name].arguments)}` | {ratio} | {values['before_s']} | {values['after_s']} "
            f"| {cells(values)} |"
        )
    return "\n".join(lines)


def write_table(rows: Mapping[str, Any]) -> None:
    """Put the table into the page."""
    before, rest = PAGE.read_text().split(BEGIN)
    PAGE.write_text(f"{before}{BEGIN}\n\n{table(rows)}\n\n{END}{rest.split(END)[1]}")


def main() -> None:
    """Measure, print, and with ``--write`` store the rows and the table of the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--against", type=Path, help="root of the other checkout")
    parser.add_argument("--only", nargs="+", choices=COMMANDS, default=tuple(COMMANDS))
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--write", action="store_true", help="store each row; others stay")
    parser.add_argument("--table", action="store_true", help="write the stored rows into the page")
    args = parser.parse_args()
    rows = json.loads(RESULT.read_text())["rows"] if RESULT.exists() else {}
    if not args.table:
        if args.against is None:
            parser.error("needs --against TREE")
        sides = [Side(tree, {"DRIVAX_NATIVE": "0"}) for tree in (args.against.resolve(), ROOT)]
        for name, values in measure(args.only, sides, args.repeats):
            print(f"{name}: {json.dumps(values)}", flush=True)
            rows[name] = values
            if args.write:
                command = "python -m experiments.speed.commands --against TREE --write"
                stored = {name: rows[name] for name in COMMANDS if name in rows}
                write_json(RESULT, {"command": command, "rows": stored, "versions": versions()})
    if args.write or args.table:
        write_table(rows)


if __name__ == "__main__":
    main()
