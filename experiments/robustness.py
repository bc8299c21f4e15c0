"""Stop commands at random moments, run them again, and compare all output with that of undisturbed runs.

    python -m experiments.robustness kills --moments 200 [--seed 0] [--only NAME ...] [--write]
    python -m experiments.robustness soak --minutes 60 [--seed 0] [--only NAME ...] [--write]
    python -m experiments.robustness page

``kills`` stops one command at each moment; ``soak`` runs all commands in turn, again and again, most of them after one
or two faults. Both begin with two undisturbed runs of all commands, whose output is the reference. ``--write`` stores
the summary in ``experiments/results``; ``page`` puts what is stored there into ``docs/results/robustness.md``.

The work folder is a small tmpfs in a user namespace (``unshare``, no privileges), so that it can be filled; a system
without user namespaces skips the fault ``full``. Half of the moments are uniform in the run, half after the first file
is written. Half of the runs of a command with ``--overwrite`` replace an output, which must stay complete, except where
it is not replaced atomically.

Files are compared byte for byte except for: TensorBoard files and Orbax arrays, whose names are random (``about.json``
has the checksum of each array, and later commands read them), and the values in ``VOLATILE``.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from experiments.repository import DOCS, RESULTS, ROOT

PAGE = DOCS / "results" / "robustness.md"
BEGIN, END = "<!-- robustness.py: begin -->", "<!-- robustness.py: end -->"
PROGRAM = (sys.executable, "-m", "drivax")
#: Exit statuses by fault; a negative one is a signal that the command does not handle, or not yet.
STATUSES = {
    "kill": (-9,), "worker": (1,), "term": (143, -15), "int": (130, -2), "hup": (129, -1), "full": (1,),
}  # fmt: skip
#: The faults in tables.
FAULTS = {
    "kill": "SIGKILL", "worker": "SIGKILL of a worker process", "term": "SIGTERM", "int": "Ctrl-C",
    "hup": "closed terminal (SIGHUP)", "full": "full disk",
}  # fmt: skip
#: Values that differ between equal runs, by file name: times, speeds, command lines, the state of the
#: repository, random file names.
VOLATILE = {
    "run.json": {"started", "command", "git"},
    "metrics.jsonl": {"steps_per_second"},
    "about.json": {"files", "crc"},
    "seal.json": {"run.json", "metrics.jsonl"},
    "demo.json": {"started", "command", "git", "stages_s"},
}
#: The same in pages: times, command lines, and the curve of the training's speed.
_VOLATILE_HTML = re.compile(
    rb"\d{4}-\d\d-\d\dT[\d:.+]+|(?:<td>|&quot;)__main__\.py .*?(?:</td>|&quot;)"
    rb"|<figcaption>steps_per_second</figcaption>.*?</figure>",
    re.DOTALL,
)
_IGNORED_FOLDERS = {"tensorboard", "arrays"}
#: Size of the disk, the most free space that may remain on a full one, and the least that tmpfs allocates (bytes).
_DISK, _REST, _PAGE = 512 << 20, 1 << 18, 4096
#: A stopped command, and a whole one, end within these times (s).
_STOP_S, _RUN_S = 120.0, 900.0
_POLL_S = 0.01
#: Shares of a command's time within which its moment is drawn; a command that ends earlier takes the next share.
_SHARES = (1.0, 0.6, 0.4, 0.2)

_TRAIN = """
total_steps: 96
task: {observation: {agents: 2, steps: 1, road: 0, lights: 1, route: 2}, metrics: none}
algorithm:
  kind: ppo
  network: {encoder: {rows: [4], hidden: [8]}, head: [4]}
  environments: 4
  unroll: 4
  minibatches: 1
checkpoint_every: 1
evaluate_every: 3
"""
_STUDY = """
title: Two arms
baselines: [baseline, bc]
planners: [idm]
metrics: [collision, accuracy]
checkpoints_by: validation/mean_q
groups: {baseline: "Better than the baseline?"}
arms:
  baseline: {}
  bc: {preset: offline/bc}
  heuristic: {method: kinematic}
claims:
  - {words: heuristic collides less, arm: heuristic, reference: baseline, group: baseline}
"""
_STUDY_SETTINGS = """
seeds: 2
total_steps: 64
validations: 4
training: [--algorithm.batch, "8", --algorithm.updates, "1", --algorithm.network.head, "[4]"]
"""
CONFIGS = {
    "train.yaml": _TRAIN + "devices: 1\n",
    "devices.yaml": _TRAIN + "devices: 2\n",
    "study.yaml": _STUDY,
    "settings.yaml": _STUDY_SETTINGS,
}


@dataclass(frozen=True)
class Command:
    """A command at a tiny size.

    Attributes:
        arguments: Its arguments.
        outputs: Files and folders that it writes.
        overwrite: Whether it has ``--overwrite``, which is passed where output exists.
        not_atomic: Folders that it does not replace atomically: a training removes the former run first.
        resume: Whether ``--resume`` continues its run folder.
        workers: Whether it starts processes.
        devices: Number of CPU devices.
    """

    arguments: tuple[str, ...]
    outputs: tuple[str, ...]
    overwrite: bool = True
    not_atomic: tuple[str, ...] = ()
    resume: bool = False
    workers: bool = False
    devices: int = 1


def _command(text: str, *outputs: str, **options: Any) -> Command:
    return Command(tuple(text.split()), outputs, **options)


def commands(scenarios: int, part: int) -> dict[str, Command]:
    """Return all commands that write files, on a set and a part of it, in the order in which they need each other."""
    return {
        "demo": _command(
            f"demo --training {scenarios} --held-out {part} --workers 2 --preset ./train.yaml --out demo",
            "demo", not_atomic=("demo/training",), workers=True,
        ),
        "generate": _command(f"generate set --scenarios {scenarios} --workers 2 --split 50/25/25", "set", workers=True),
        "export": _command("export set recordings --format gpudrive", "recordings"),
        "export-set": _command(f"export set part --limit {part}", "part"),
        "export-tfexample": _command("export part tfexample --format tfexample --shard-size 2", "tfexample"),
        "convert": _command(
            "convert recordings converted --workers 2 --shard-size 3 --split 50/25/25", "converted", workers=True
        ),
        "view": _command("view part --out view.html", "view.html"),
        "inspect": _command("inspect set part --html sets.html", "sets.html"),
        "draw": _command("inspect part --observations --planner idm --draw observation.png", "observation.png"),
        "curate": _command("curate kinematic --data set --out scores.npz --export top 4", "scores.npz", "top"),
        "curate-ensemble": _command(
            "curate ensemble --data set --out ensemble.npz --folds 2 --total_steps 256 --cloning.batch 16 "
            "--cloning.network.head [4]",
            "ensemble.npz",
        ),
        "train": _command(
            "train train.yaml --data set --validation none --out run", "run", overwrite=False, resume=True
        ),
        "train-again": _command(
            "train train.yaml --data part --validation none --out again", "again", not_atomic=("again",)
        ),
        "train-seeds": _command(
            "train train.yaml --data converted --validation part --seeds 2 --out seeds",
            "seeds", overwrite=False, resume=True,
        ),
        "train-devices": _command(
            "train devices.yaml --data set --validation none --out run2",
            "run2", overwrite=False, resume=True, devices=2,
        ),
        "evaluate": _command("evaluate --planner run --data part --out policy", "policy"),
        "evaluate-idm": _command("evaluate --planner idm --data part --out idm", "idm"),
        "judge": _command("judge idm", "idm/devkit.csv"),
        "compare": _command("compare policy idm --html comparison.html", "comparison.html"),
        "report": _command("report idm policy run --episodes 2 --out report.html", "report.html"),
        "video": _command("report policy --video worst:1 --out videos", "videos"),
        "tables": _command("report idm policy --tables --out tables", "tables"),
        "study": _command(
            "study study.yaml --config settings.yaml --data set --validation part --test part --cores 2 --anyway "
            "--out study",
            "study", overwrite=False, workers=True,
        ),
        "record": _command("record idm constant_speed --noise 0 0.3 --data part --out episodes", "episodes"),
    }  # fmt: skip


COMMANDS = commands(12, 4)


@dataclass
class Bench:
    """A disk with the work folder, and the reference output and times of the undisturbed runs."""

    disk: Path
    commands: dict[str, Command]
    #: Names of the commands that are stopped.
    stopped: Sequence[str]
    faults: tuple[str, ...]
    rng: random.Random

    def __post_init__(self) -> None:
        self.work, self.temporary, self.ballast = (self.disk / name for name in ("work", "tmp", "ballast"))
        self.reference: dict[str, str] = {}
        #: By command: seconds until the first file, and in all.
        self.seconds: dict[str, tuple[float, float]] = {}
        self.process: subprocess.Popen[str] | None = None
        self.problems: list[str] = []
        self.counts: Counter[tuple[str, str, str]] = Counter()
        self.clear()

    def faults_of(self, name: str) -> list[str]:
        """Return the faults that can meet a command."""
        return [fault for fault in self.faults if self.commands[name].workers or fault != "worker"]

    def clear(self) -> None:
        """Empty the work folder."""
        for folder in (self.work, self.temporary):
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
        for name, text in CONFIGS.items():
            (self.work / name).write_text(text)

    def measure(self) -> None:
        """Run all commands twice undisturbed, and keep digests and times of the second time."""
        for repeat in range(2):
            self.clear()
            for name, command in self.commands.items():
                started, before = time.monotonic(), _paths(self.work)
                process = self._start(command)
                self._wait_for_file(process, before)
                first = time.monotonic() - started
                self._end(name, process)
                self.seconds[name] = (first, time.monotonic() - started)
                print(f"{name}: {self.seconds[name][1]:.1f} s", flush=True)
            previous, self.reference = self.reference, digests(self.work)
            if repeat and (lines := differences(previous, self.reference)):
                raise SystemExit("undisturbed runs differ:\n" + "\n".join(lines))
        self.problems += self._leftovers()
        if self.problems:
            raise SystemExit("undisturbed runs fail:\n" + "\n".join(self.problems))

    def disturb(self, name: str, fault: str) -> None:
        """Stop a command by a fault at a random moment, and check what it leaves."""
        command = self.commands[name]
        replaces = command.overwrite and self._exists(command) and self.rng.random() < 0.5
        complete = replaces and not self._differences(name, without=command.not_atomic)
        shares = iter(_SHARES)
        process = self._run_until(name, next(shares), replaces)
        while process.poll() is not None and (share := next(shares, None)):
            process.communicate()  # closes its pipe
            process = self._run_until(name, share, replaces)
        self._apply(fault, process)
        try:
            error = process.communicate(timeout=_RUN_S if fault in ("full", "worker") else _STOP_S)[1]
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            error = process.communicate()[1]
            self.problems.append(f"{name}, {fault}: hangs: {error[-300:]}")
        self.ballast.unlink(missing_ok=True)
        status = process.returncode
        self.counts[name, fault, "finished" if status == 0 else "stopped"] += 1
        self._check_end(name, fault, process, error)
        if complete:
            lines = self._differences(name, without=command.not_atomic)
            self.problems += [f"{name}, {fault}: replaced {line}" for line in lines]

    def _run_until(self, name: str, share: float, replaces: bool) -> subprocess.Popen[str]:
        """Start a command and wait until a random moment in this share of its time, after its first file or not."""
        command = self.commands[name]
        # An unfinished run or study is continued.
        if not replaces and (command.overwrite or not self._differences(name)):
            remove_outputs(command, self.work)
        first, whole = self.rng.choice(((0.0, self.seconds[name][1]), self.seconds[name]))
        before = _paths(self.work)
        process = self._start(command)
        if first:
            self._wait_for_file(process, before)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.communicate(timeout=self.rng.uniform(0.0, share * (whole - first)))
        return process

    def finish(self, name: str) -> None:
        """Run a command as a user does after a fault: with ``--resume`` or ``--overwrite`` where output exists."""
        self._end(name, self._start(self.commands[name]))
        for other in self._writers_into(name):
            self.finish(other)

    def check(self, name: str) -> None:
        """Compare all output with the reference, and look for files that should not exist."""
        lines = differences(self.reference, digests(self.work))
        self.problems += [f"{name}: {line}" for line in (*lines, *self._leftovers())]

    def _exists(self, command: Command) -> bool:
        return any((self.work / output).exists() for output in command.outputs)

    def _differences(self, name: str, without: Sequence[str] = ()) -> list[str]:
        """Return how the outputs of a command differ from the reference, except those in the folders ``without``."""
        outputs = (self._select_outputs(name, paths) for paths in (self.reference, digests(self.work)))
        expected, actual = (
            {path: digest for path, digest in paths.items() if not _is_below(path, without)}
            for paths in outputs
        )
        return differences(expected, actual)

    def _select_outputs(self, name: str, paths: dict[str, str]) -> dict[str, str]:
        """Select what a command writes, without hidden files, and without what others write into its folders."""
        folders = self.commands[name].outputs
        nested = [output for other in self._writers_into(name) for output in self.commands[other].outputs]
        outputs = (path for path in paths if _is_below(path, folders) and path not in nested)
        return {path: paths[path] for path in outputs if not _is_hidden(path)}

    def _writers_into(self, name: str) -> list[str]:
        folders = self.commands[name].outputs
        return [
            other for other, command in self.commands.items()
            if other != name and all(_is_below(output, folders) for output in command.outputs)
        ]  # fmt: skip

    def _start(self, command: Command) -> subprocess.Popen[str]:
        flags = []
        if command.resume and any((self.work / output / "run.json").is_file() for output in command.outputs):
            flags = ["--resume"]
        elif (command.resume or command.overwrite) and self._exists(command):
            flags = ["--overwrite"]
        devices = f"--xla_force_host_platform_device_count={command.devices}"
        environment = os.environ | {"TMPDIR": str(self.temporary), "XLA_FLAGS": devices}
        self.process = subprocess.Popen(
            (*PROGRAM, *command.arguments, *flags), cwd=self.work, env=environment, text=True,
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True,
        )  # fmt: skip
        return self.process

    def close(self) -> None:
        """Kill the command that runs, which has a session of its own."""
        if self.process is not None and self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGKILL)

    def _end(self, name: str, process: subprocess.Popen[str]) -> None:
        error = process.communicate(timeout=_RUN_S)[1]
        if process.returncode != 0:
            self.problems.append(f"{name}: undisturbed, status {process.returncode}: {error[-600:]}")

    def _wait_for_file(self, process: subprocess.Popen[str], before: set[str]) -> None:
        while process.poll() is None and _paths(self.work) <= before:
            time.sleep(_POLL_S)

    def _apply(self, fault: str, process: subprocess.Popen[str]) -> None:
        with contextlib.suppress(ProcessLookupError):
            if fault == "full":
                self._fill()
            elif fault == "worker":
                self._kill_worker(process)
            elif fault in ("int", "hup"):  # as from a terminal
                os.killpg(process.pid, getattr(signal, f"SIG{fault.upper()}"))
            else:
                process.send_signal(getattr(signal, f"SIG{fault.upper()}"))

    def _fill(self) -> None:
        """Fill the disk: completely half of the time, otherwise up to a random rest."""
        rest, filled, piece = self.rng.choice((0, self.rng.randrange(_REST))), 0, _DISK
        with self.ballast.open("wb") as file:
            while piece >= _PAGE and (free := shutil.disk_usage(self.disk).free) >= rest + _PAGE:
                piece = min(piece, free - rest)
                try:
                    os.posix_fallocate(file.fileno(), filled, piece)
                    filled += piece
                except OSError:  # The command wrote meanwhile: tmpfs undoes an allocation that does not fit.
                    piece //= 2

    def _kill_worker(self, process: subprocess.Popen[str]) -> None:
        workers = list(_children(process.pid))
        while process.poll() is None and not workers:
            time.sleep(_POLL_S)
            workers = list(_children(process.pid))
        if workers:
            os.kill(self.rng.choice(workers), signal.SIGKILL)

    def _check_end(self, name: str, fault: str, process: subprocess.Popen[str], error: str) -> None:
        status, place = process.returncode, f"{name}, {fault}"
        if fault != "int" or not _interrupts_python(error):
            if status not in (0, *STATUSES[fault]):
                self.problems.append(f"{place}: status {status}: {error[-600:]}")
            if status >= 0 and "Traceback" in error:
                self.problems.append(f"{place}: traceback: {error[-1200:]}")
            if status > 0 and not error.strip().rpartition("\n")[2].startswith("drivax: "):
                self.problems.append(f"{place}: the last line is not a message: {error[-600:]}")
        if not _wait(lambda: not _group_exists(process.pid), 20.0):
            os.killpg(process.pid, signal.SIGKILL)
            self.problems.append(f"{place}: processes remain")
        if fault in ("term", "int", "hup", "full") and status >= 0:
            self.problems += [f"{place}: leaves {path}" for path in sorted(_paths(self.temporary))]
        shutil.rmtree(
            self.temporary, ignore_errors=True
        )  # A killed process cannot remove its temporary files.
        self.temporary.mkdir()

    def _leftovers(self) -> list[str]:
        """Return hidden files, and temporary files."""
        hidden = [f"leaves {path}" for path in sorted(filter(_is_hidden, _paths(self.work)))]
        return hidden + [f"leaves tmp/{path}" for path in sorted(_paths(self.temporary))]


def remove_outputs(command: Command, work: Path) -> None:
    """Remove the outputs of a command from a work folder."""
    for output in command.outputs:
        path = work / output
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def digests(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of each file without its volatile values, by relative path."""
    files = ((path, path.relative_to(folder)) for path in sorted(folder.rglob("*")) if path.is_file())
    return {
        relative.as_posix(): hashlib.sha256(_stable(path)).hexdigest()
        for path, relative in files
        if not _IGNORED_FOLDERS.intersection(relative.parts)
    }


def differences(expected: dict[str, str], actual: dict[str, str]) -> list[str]:
    """Return a line for each file that is missing, additional, or different."""
    lines = [f"{path}: missing" for path in expected.keys() - actual.keys()]
    lines += [f"{path}: additional" for path in actual.keys() - expected.keys()]
    lines += [f"{path}: differs" for path in expected.keys() & actual if expected[path] != actual[path]]
    return sorted(lines)


def _stable(path: Path) -> bytes:
    """Return the content of a file without the values in ``VOLATILE``."""
    content, names = path.read_bytes(), VOLATILE.get(path.name)
    if path.suffix == ".html":
        return _VOLATILE_HTML.sub(b"", content)
    if names is None:
        return content
    records = content.splitlines() if path.suffix == ".jsonl" else [content]
    stable = ({key: value for key, value in json.loads(line).items() if key not in names} for line in records)
    return json.dumps(list(stable), sort_keys=True).encode()


def _interrupts_python(error: str) -> bool:
    """Return whether Ctrl-C stopped Python while it started, by its traceback, before any code of drivax ran."""
    return error.rstrip().endswith("KeyboardInterrupt") and "drivax" not in error


def _is_hidden(path: str) -> bool:
    """Return whether a relative path is that of an incomplete or temporary file."""
    return "/." in f"/{path}" or ".partial" in path


def _is_below(path: str, folders: Sequence[str]) -> bool:
    return any(path == folder or path.startswith(f"{folder}/") for folder in folders)


def _paths(folder: Path) -> set[str]:
    # Not rglob, which fails if a folder is removed meanwhile.
    walk = ((Path(root), (*folders, *files)) for root, folders, files in os.walk(folder))
    return {(root / name).relative_to(folder).as_posix() for root, names in walk for name in names}


def _children(parent: int) -> Iterator[int]:
    """Yield the worker processes below a process."""
    for entry in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if int((entry / "stat").read_text().rpartition(")")[2].split()[1]) == parent:
                yield from _children(int(entry.name))
                if b"resource_tracker" not in (entry / "cmdline").read_bytes():
                    yield int(entry.name)


def _group_exists(leader: int) -> bool:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(leader, 0)
        return True
    return False


def _wait(condition: Callable[[], bool], seconds: float) -> bool:
    deadline = time.monotonic() + seconds
    while not condition() and time.monotonic() < deadline:
        time.sleep(_POLL_S)
    return condition()


def run_kills(bench: Bench, moments: int) -> dict[str, Any]:
    """Stop single commands, each pair of command and fault in turn, in random order."""
    pairs = [(name, fault) for name in bench.stopped for fault in bench.faults_of(name)]
    bench.rng.shuffle(pairs)
    for number in range(moments):
        name, fault = pairs[number % len(pairs)]
        known = len(bench.problems)
        if not bench.commands[name].overwrite:
            remove_outputs(bench.commands[name], bench.work)
        bench.disturb(name, fault)
        bench.finish(name)
        bench.check(f"{name} after {fault}")
        print(f"{number + 1}/{moments} {name}, {fault}: {bench.problems[known:] or 'identical'}", flush=True)
        if differences(bench.reference, digests(bench.work)):  # The next moment needs intact inputs.
            _repair(bench)
    return {"moments": moments}


def _repair(bench: Bench) -> None:
    bench.clear()
    for name in bench.commands:
        bench.finish(name)


def run_soak(bench: Bench, minutes: float) -> dict[str, Any]:
    """Repeat all commands, most of them after one or two faults, until the time is over."""
    deadline, cycles = time.monotonic() + 60.0 * minutes, 0
    while not cycles or time.monotonic() < deadline:
        bench.clear()
        known = len(bench.problems)
        for name in bench.commands:
            number = bench.rng.choice((0, 1, 1, 2)) if name in bench.stopped else 0
            for fault in bench.rng.choices(bench.faults_of(name), k=number):
                bench.disturb(name, fault)
            bench.finish(name)
        cycles += 1
        bench.check(f"cycle {cycles}")
        print(f"cycle {cycles}: {bench.problems[known:] or 'identical'}", flush=True)
    digest, reference = (
        hashlib.sha256(json.dumps(paths, sort_keys=True).encode()).hexdigest()
        for paths in (digests(bench.work), bench.reference)
    )
    print(f"digest {digest}, undisturbed {reference}", flush=True)
    return {"minutes": minutes, "cycles": cycles, "digest": digest, "undisturbed": reference}


def _summary(bench: Bench, args: argparse.Namespace, counts: dict[str, Any]) -> dict[str, Any]:
    table: dict[str, dict[str, Any]] = {}
    for (name, fault, outcome), number in sorted(bench.counts.items()):
        table.setdefault(name, {}).setdefault(fault, {})[outcome] = number
    return {
        "command": f"python -m experiments.robustness {args.mode} --seed {args.seed}",
        "when": datetime.now(UTC).isoformat(timespec="minutes"),
        "commit": subprocess.run(
            ("git", "rev-parse", "--short", "HEAD"), cwd=ROOT, check=True, capture_output=True, text=True
        ).stdout.strip(),
        "faults": list(bench.faults),
        "skipped": [] if "full" in bench.faults else ["full: the system has no user namespaces"],
        **counts,
        "runs": table,
        "stopped": sum(number for (_, _, outcome), number in bench.counts.items() if outcome == "stopped"),
        "finished": sum(number for (_, _, outcome), number in bench.counts.items() if outcome == "finished"),
        "problems": bench.problems,
    }


def table(kills: dict[str, Any], soak: dict[str, Any]) -> str:
    """Return the outcomes of each fault as a Markdown table, and two sentences about the soak."""
    lines = [
        "| fault | single commands: stopped | ended before | soak: stopped | ended before |",
        "|---|---:|---:|---:|---:|",
    ]
    for fault, words in FAULTS.items():
        cells = [
            sum(outcomes.get(fault, {}).get(outcome, 0) for outcomes in result["runs"].values())
            for result in (kills, soak)
            for outcome in ("stopped", "finished")
        ]
        lines.append(f"| {words} | {' | '.join(map(str, cells))} |")
    equal = "equals" if soak["digest"] == soak["undisturbed"] else "differs from"
    stopped = ", ".join(f"`{name}`" for name in COMMANDS if name in kills["runs"])
    return "\n".join([
        f"Single commands: {stopped}.", "", *lines, "",
        f"Problems: {len(kills['problems'])} in {kills['moments']} moments, {len(soak['problems'])} in the soak of "
        f"{soak['minutes']:.0f} minutes ({soak['cycles']} cycles through all commands). The digest of its last cycle "
        f"{equal} that of the undisturbed runs.",
    ])  # fmt: skip


def _write_page() -> None:
    """Put the stored results into the page."""
    results = (json.loads((RESULTS / f"{name}.json").read_text()) for name in ("kills", "soak"))
    before, rest = PAGE.read_text().split(BEGIN)
    PAGE.write_text(f"{before}{BEGIN}\n\n{table(*results)}\n\n{END}{rest.split(END)[1]}")


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("mode", choices=("kills", "soak", "page"))
    parser.add_argument("--moments", type=int, default=200)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", choices=COMMANDS, default=tuple(COMMANDS))
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--disk", type=Path, help=argparse.SUPPRESS)
    return parser.parse_args()


def _call_on_disk() -> int:
    """Call this script again on a disk of its own, or with a plain folder if the system refuses one."""
    script = (sys.executable, "-m", "experiments.robustness", *sys.argv[1:], "--disk")
    with tempfile.TemporaryDirectory() as disk:
        namespace = ("unshare", "--user", "--map-root-user", "--mount")
        mount = ("sh", "-c", f'mount -t tmpfs -o size={_DISK} tmpfs "$0" && exec "$@"', disk)
        with contextlib.suppress(OSError):
            if subprocess.run((*namespace, *mount, "true"), capture_output=True).returncode == 0:
                return subprocess.run((*namespace, *mount, *script, disk), cwd=ROOT).returncode
        return subprocess.run((*script, disk), cwd=ROOT).returncode


def main() -> int:
    """Return 1 if an output differed, a command hung or failed, or a file was left."""
    args = _parse()
    # A job in the background ignores Ctrl-C, one of nohup SIGHUP, and so would the commands.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    if args.mode == "page":
        _write_page()
        return 0
    if args.disk is None:
        return _call_on_disk()
    last = max(list(COMMANDS).index(name) for name in args.only)
    needed = dict(list(COMMANDS.items())[: last + 1])
    faults = (
        tuple(STATUSES) if args.disk.is_mount() else tuple(fault for fault in STATUSES if fault != "full")
    )
    bench = Bench(args.disk, needed, args.only, faults, random.Random(args.seed))
    with contextlib.closing(bench):
        bench.measure()
        counts = run_kills(bench, args.moments) if args.mode == "kills" else run_soak(bench, args.minutes)
    summary = json.dumps(_summary(bench, args, counts), indent=1)
    print(re.sub(r"\n {3,}", " ", summary))
    if args.write:
        (RESULTS / f"{args.mode}.json").write_text(f"{summary}\n")
    return bool(bench.problems)


if __name__ == "__main__":
    sys.exit(main())
