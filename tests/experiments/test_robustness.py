"""The script that stops commands: on a small program that behaves well, or badly in a known way."""

from __future__ import annotations

import json
import random
import sys
from dataclasses import replace
from types import SimpleNamespace

import pytest

from experiment_scripts import load_script

robustness = load_script("robustness")

#: Writes a folder in one step, unless the second argument names a fault.
PROGRAM = """
import contextlib, json, os, sys, time
from pathlib import Path
from drivax.files import atomic_write, replace_folder

out, fault = Path(sys.argv[1]), sys.argv[2]
if fault == "files":
    out.mkdir(exist_ok=True)
    for name in ("first", "second"):
        with atomic_write(out / name) as file:
            for number in range(20):
                file.write(b"x")
                time.sleep(0.01)
    sys.exit()
if fault == "direct":
    out.mkdir(exist_ok=True)
with contextlib.nullcontext(out) if fault == "direct" else replace_folder(out) as folder:
    for number in range(20):
        (folder / "data").write_bytes(os.urandom(10) if fault == "random" else b"x" * 10 * number)
        time.sleep(0.01)
    (folder / "run.json").write_text(json.dumps({"started": time.time(), "kind": "training"}))
if fault == "litter":
    out.with_name(".left").touch()
"""


@pytest.fixture
def bench(tmp_path, monkeypatch):
    (tmp_path / "program.py").write_text(PROGRAM)
    monkeypatch.setattr(robustness, "PROGRAM", (sys.executable, str(tmp_path / "program.py")))

    def make(fault, faults=("kill",)):
        command = robustness.Command(("out", fault), ("out",), overwrite=True)
        (tmp_path / "disk").mkdir()
        return robustness.Bench(tmp_path / "disk", {"write": command}, ["write"], faults, random.Random(0))

    return make


def test_atomic_program_is_identical_after_kills(bench):
    bench = bench("none")
    bench.measure()
    assert robustness.run_kills(bench, 4) == {"moments": 4}
    assert bench.problems == []
    assert sum(bench.counts.values()) == 4 and bench.counts["write", "kill", "stopped"] >= 1


def test_files_that_are_replaced_one_by_one_stay_whole(bench):
    """An incomplete hidden file may lie next to them until the next run."""
    bench = bench("files")
    bench.measure()
    robustness.run_kills(bench, 4)
    assert bench.problems == [] and bench.counts["write", "kill", "stopped"] >= 1


def test_output_that_was_incomplete_before_may_stay_so(bench, monkeypatch):
    bench = bench("files")
    bench.measure()
    (bench.work / "out" / "second").unlink()
    monkeypatch.setattr(bench.rng, "random", lambda: 0.0)  # replaces the output, and stops at once
    bench.disturb("write", "kill")
    assert bench.problems == [] and not (bench.work / "out" / "second").exists()


def test_soak_ends_with_the_digest_of_undisturbed_runs(bench):
    bench = bench("none")
    bench.measure()
    result = robustness.run_soak(bench, 0.01)
    assert bench.problems == [] and result["cycles"] >= 1 and result["digest"] == result["undisturbed"]


def test_random_output_is_no_reference(bench):
    with pytest.raises(SystemExit, match="out/data: differs"):
        bench("random").measure()


def test_litter_is_found(bench):
    with pytest.raises(SystemExit, match=r"leaves \.left"):
        bench("litter").measure()


@pytest.mark.parametrize("not_atomic", [(), ("out",)])
def test_incomplete_replacement_is_found_where_it_should_be_atomic(bench, not_atomic):
    bench = bench("direct")
    bench.commands["write"] = replace(bench.commands["write"], not_atomic=not_atomic)
    bench.measure()
    bench.rng = random.Random(1)
    for _ in range(6):
        bench.finish("write")
        bench.disturb("write", "kill")
    assert any("replaced out/data" in problem for problem in bench.problems) == (not_atomic == ())


@pytest.mark.parametrize(("seed", "rest"), [(1, 0), (5, 133_926)])
def test_disk_is_filled_although_the_command_writes_meanwhile(bench, monkeypatch, seed, rest):
    """As on tmpfs: an allocation that does not fit is undone, and takes whole pages."""
    free = [40 << 20]

    def allocate(number, offset, size):
        free[0] -= 3 * 4096 * (free[0] > 39 << 20)  # the command writes, once
        if size > free[0]:
            raise OSError(28, "No space left on device")
        free[0] -= -(-size // 4096) * 4096

    monkeypatch.setattr(robustness.shutil, "disk_usage", lambda path: SimpleNamespace(free=free[0]))
    monkeypatch.setattr(robustness.os, "posix_fallocate", allocate)
    bench = bench("none")
    bench.rng = random.Random(seed)
    bench._fill()
    assert max(rest - 4 * 4096, 0) <= free[0] < rest + 4096


def test_volatile_values_are_not_compared(tmp_path):
    for name, time, kind in (("a", 1, "training"), ("b", 2, "training"), ("c", 1, "evaluation")):
        (tmp_path / name / "tensorboard").mkdir(parents=True)
        (tmp_path / name / "tensorboard" / f"events.{time}").touch()
        (tmp_path / name / "run.json").write_text(json.dumps({"started": time, "kind": kind}))
    first, second, third = (robustness.digests(tmp_path / name) for name in "abc")
    assert first == second and robustness.differences(first, third) == ["run.json: differs"]


def test_differences_name_each_file():
    lines = robustness.differences({"a": "1", "b": "1", "c": "1"}, {"b": "2", "c": "1", "d": "1"})
    assert lines == ["a: missing", "b: differs", "d: additional"]


def test_an_interrupt_of_python_itself_is_no_problem():
    trace = (
        'Traceback (most recent call last):\n  File "<frozen site>", line 1, in <module>\nKeyboardInterrupt\n'
    )
    assert robustness._interrupts_python(trace)
    assert not robustness._interrupts_python(trace.replace("<frozen site>", "src/drivax/__main__.py"))
    assert not robustness._interrupts_python("")
