from __future__ import annotations

import dataclasses
import os
import shutil
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from numpy._core import _multiarray_umath as umath

from drivax.cli.generate import Generate, run, summary
from drivax.errors import DataError, UsageError
from drivax.evaluation.audit import audit
from drivax.files import PartialFolder
from drivax.scenario.schema import Flag
from drivax.scenario.store import ScenarioSet
from drivax.synthetic import generate as generation
from drivax.synthetic.generate import (
    RESERVED_SEED,
    FamilyCount,
    GeneratedSet,
    Generation,
    generate,
    generate_benchmark,
    portable_workers,
)
from drivax.synthetic.world import WORLD_VERSION, WorldConfig, generate_many, generate_one
from drivax.tracking.workers import worker_pool

SCENARIOS = 7


@pytest.fixture(scope="module")
def one_worker(tmp_path_factory):
    path = tmp_path_factory.mktemp("sets") / "one"
    progress = []
    options = Generation(workers=1)
    result = generate(
        path, SCENARIOS, 5, options, progress=lambda done, total: progress.append((done, total))
    )
    return path, result, progress


@pytest.mark.slow
def test_worker_count_does_not_change_the_bytes(one_worker, tmp_path):
    path, result, _ = one_worker
    two = generate(tmp_path / "two", SCENARIOS, 5, Generation(workers=2))
    files = sorted(file.name for file in path.iterdir())
    assert files == sorted(file.name for file in (tmp_path / "two").iterdir())
    for name in files:
        assert (path / name).read_bytes() == (tmp_path / "two" / name).read_bytes(), name
    assert two.families == result.families


@pytest.mark.slow
def test_processors_without_newer_instructions_write_the_same_bytes(tmp_path):
    """The command runs with and without these instructions, whose routines differ in the last bits of results."""
    newer = [name for name in umath.__cpu_dispatch__ if umath.__cpu_features__[name]]
    if not newer:
        pytest.skip("this processor has none of the newer instructions that NumPy knows")
    hashes = []
    for number, more in enumerate(
        ({"NPY_DISABLE_CPU_FEATURES": " ".join(newer), "OPENBLAS_CORETYPE": "Nehalem"}, {})
    ):
        out = tmp_path / str(number)
        words = ["generate", str(out), "--scenarios", str(SCENARIOS), "--seed", "5", "--workers", "1"]
        call = [sys.executable, "-m", "drivax", *words]
        subprocess.run(call, env={**os.environ, **more}, check=True)
        hashes.append(ScenarioSet.open(out).hash)
    assert hashes[0] == hashes[1]


def test_portable_workers_use_no_newer_instructions_or_kernels(tmp_path, monkeypatch):
    """Compare sines and solutions of equations in workers of parents with different kernels of OpenBLAS."""
    script = tmp_path / "computes.py"
    script.write_text(
        "import hashlib, numpy as np\n"
        "from numpy._core import _multiarray_umath as u\n"
        "rng = np.random.default_rng(0)\n"
        "angles, square = rng.normal(size=1_000_000), rng.normal(size=(60, 60))\n"
        "found = np.concatenate([np.sin(angles), np.exp(angles), np.linalg.solve(square, angles[:60])])\n"
        "print(any(u.__cpu_features__[name] for name in u.__cpu_dispatch__), hashlib.sha256(found).hexdigest())\n"
    )

    def run_script():
        call = [sys.executable, str(script)]
        return subprocess.run(call, env=os.environ, capture_output=True, text=True, check=True).stdout

    outputs = []
    for kernel in (None, "SkylakeX"):
        if kernel is not None:
            monkeypatch.setenv("OPENBLAS_CORETYPE", kernel)
        before = dict(os.environ)
        with portable_workers():
            outputs.append(run_script())
        assert dict(os.environ) == before
    assert outputs[0] == outputs[1] and outputs[0].startswith("False")


def test_workers_inherit_disabled_features(monkeypatch):
    """A worker lacks the processor features that its parent disabled."""
    has = {"A": True, "B": False, "C": False}
    monkeypatch.setattr(generation, "_umath", SimpleNamespace(__cpu_dispatch__=[*has], __cpu_features__=has))
    for disabled, expected in (("B", "A B"), ("B,C", "A B C"), ("B, C", "A B C")):
        monkeypatch.setenv("NPY_DISABLE_CPU_FEATURES", disabled)
        with portable_workers():
            assert os.environ["NPY_DISABLE_CPU_FEATURES"] == expected
        assert os.environ["NPY_DISABLE_CPU_FEATURES"] == disabled


@pytest.mark.slow
def test_scenarios_of_fifteen_seconds_are_clean_and_have_ids_of_their_own(tmp_path):
    world = WorldConfig(rare_rate=0.5)
    result = generate(tmp_path / "set", 8, 3, Generation(future_s=15.0, world=world), audit=audit)
    made = ScenarioSet.open(result.path)
    assert made.capacity.steps == 161 and {int(scenario.steps) for scenario in made} == {161}
    assert all(scenario.audit["clean"] and scenario.id.startswith("w2-grid-s3-t161-") for scenario in made)
    assert {int(scenario.event_end.max()) <= 90 for scenario in made if scenario.event_kind.any()} == {True}
    assert max(np.hypot(*(s.agent_xy[160, 0] - s.agent_xy[90, 0])) for s in made) > 20.0
    for future_s in (4.0, 61.0):
        with pytest.raises(UsageError, match=f"future_s is {future_s:g}; use 8 to 60"):
            generate(tmp_path / "no", 1, 0, Generation(future_s=future_s))
    with pytest.raises(UsageError, match="its world is fixed but for its domain; leave out other settings"):
        generation.generate_benchmark(tmp_path / "no", Generation(future_s=15.0), 1)


def test_counts_and_progress_cover_all_scenarios(one_worker):
    _, result, progress = one_worker
    assert progress == [(done, SCENARIOS) for done in range(1, SCENARIOS + 1)]
    assert result.scenarios == SCENARIOS == sum(count.kept for count in result.families.values())
    assert FamilyCount(3, {"a": 1, "b": 2}, unsuited=7).rejection_rate == 0.5
    assert FamilyCount(0, {}, unsuited=7).rejection_rate == 0.0


def test_rejected_draws_count_for_their_family(tmp_path, monkeypatch):
    drawn = []

    def many(*arguments):
        for made in generate_many(*arguments):
            causes = {
                ("nowhere", "ego_collides"): 2,
                ("nowhere", "no_threat"): 3,
                (made.family, "no_occasion"): 1,
            }
            drawn.append(made.family)
            yield dataclasses.replace(made, rejected=causes)

    monkeypatch.setattr(generation, "generate_many", many)
    made = generate(tmp_path / "set", 2, 5, Generation())
    assert made.families["nowhere"] == FamilyCount(0, {"ego_collides": 4}, 6)
    assert sum(count.unsuited for name, count in made.families.items() if name != "nowhere") == 2
    assert [made.families[name].rejection_rate for name in drawn] == [0.0, 0.0]


def test_set_matches_the_request(one_worker):
    path, result, _ = one_worker
    scenarios = ScenarioSet.open(path)
    assert len(scenarios) == SCENARIOS
    families = [entry["tags"]["family"] for entry in scenarios.entries]
    assert {name: families.count(name) for name in families} == {
        k: c.kept for k, c in result.families.items()
    }
    for index, entry in enumerate(scenarios.entries):
        scenario = scenarios[index]
        assert entry["tags"]["domain"] == "grid" and entry["tags"]["dataset"] == "drivax"
        assert entry["overflow"] == {}
        flags = Flag.LANE_GRAPH | Flag.SPEED_LIMITS | Flag.ROUTE
        assert flags in scenario.has and Flag.NO_FUTURE not in scenario.has
        assert Flag.LIGHTS in scenario.has
        has_lights = bool(generate_one(5, index, WorldConfig()).recording.lights)
        assert (scenario.light_state >= 0).any() == has_lights
        # The route follows the expert's log and continues beyond it.
        n = int(scenario.route_points[0])
        route = scenario.route_xy[0, :n]
        ego = scenario.agent_xy[:, 0]
        gap = np.sqrt(np.min(np.sum((ego[:, None] - route) ** 2, axis=-1), axis=1))
        assert gap.max() < 3.0
        assert np.median(gap) < 0.8
        assert n - 1 >= scenario.log_progress[-1] + 49.0


def test_longer_set_extends_a_shorter_one(one_worker, tmp_path):
    path, *_ = one_worker
    generate(tmp_path / "three", 3, 5)
    long, short = ScenarioSet.open(path), ScenarioSet.open(tmp_path / "three")
    for i in range(3):
        assert long[i].id == short[i].id
        assert long[i].record.tobytes() == short[i].record.tobytes()


def test_audit_findings_are_stored(tmp_path):
    calls = []

    def audit(scenarios):
        calls.append(len(scenarios))
        return [{"collision": False, "agents": int(s.agent_valid[10].sum())} for s in scenarios]

    generate(tmp_path / "set", 2, 1, audit=audit)
    scenarios = ScenarioSet.open(tmp_path / "set")
    assert calls == [2]
    for index, entry in enumerate(scenarios.entries):
        assert entry["audit"]["agents"] == int(scenarios[index].agent_valid[10].sum())


def test_first_audit_runs_while_scenarios_are_drawn():
    (draw,) = generation._draw_chunk(0, 1, 5, Generation())
    later_draws, sizes = threading.Event(), []

    def audit(scenarios):
        assert later_draws.wait(10.0)
        sizes.append(len(scenarios))
        return [{"number": scenario.tags["number"]} for scenario in scenarios]

    def scenarios():
        for number in range(150):
            if number == 20:
                later_draws.set()
            yield dataclasses.replace(draw.scenario, tags={"number": str(number)})

    audited = [
        (s.tags["number"], finding["number"]) for s, finding in generation._audit_batches(scenarios(), audit)
    ]
    assert audited == [(str(number), str(number)) for number in range(150)]
    assert sizes == [4, 64, 64, 18]


def test_invalid_requests_are_refused(tmp_path):
    for arguments, text in (
        ((0, 0), "scenarios is 0; use 1 or more"),
        ((1, -1), "seed is -1; use 0 to 999999999"),
        ((1, RESERVED_SEED), "seed is 1000000000; use 0 to 999999999"),
        ((1, 0, Generation(world=WorldConfig(rare_rate=1.5))), "rare_rate is 1.5; use a share from 0 to 1"),
        ((1, 0, Generation(world=WorldConfig(scenarios_per_map=0))), "scenarios_per_map is 0; use 1"),
        ((1, 0, Generation(workers=-1)), "workers is -1; use 0 or more"),
        ((1, 0, Generation(split="80/30")), "'80/30' is not a split; give percentages"),
        ((1, 0, Generation(capacity="tiny")), "unknown capacity 'tiny'; use one of default, large"),
    ):
        with pytest.raises(UsageError, match=text):
            generate(tmp_path / "set", *arguments)
    assert list(tmp_path.iterdir()) == []


def test_disk_space_is_checked_before_the_work(tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(total=1 << 60, free=5_000_000))
    with pytest.raises(DataError, match=r"set: no space: needs about 59 MB, the disk has 5\.0 MB left"):
        generate(tmp_path / "set", 100, progress=lambda done, total: pytest.fail("drew a scenario"))
    with pytest.raises(DataError, match=r"sets: no space: needs about 3\.\d GB"):
        generate_benchmark(tmp_path / "sets")
    assert list(tmp_path.iterdir()) == []


def test_benchmark_refuses_links_in_its_folder(tmp_path):
    (tmp_path / "sets").mkdir()
    (tmp_path / "sets" / "test").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(DataError, match="sets/test: is a symbolic link; replace the link"):
        generate_benchmark(tmp_path / "sets", progress=lambda done, total: pytest.fail("drew a scenario"))


def test_failed_generation_leaves_no_files(tmp_path):
    def broken(scenarios):
        raise RuntimeError("audit broke")

    with pytest.raises(RuntimeError, match="audit broke"):
        generate(tmp_path / "set", 1, 0, audit=broken)
    assert list(tmp_path.iterdir()) == []


def test_set_appears_together_with_its_lists(tmp_path, monkeypatch):
    publish = PartialFolder.publish

    def publish_and_stop(folder):
        publish(folder)
        raise KeyboardInterrupt

    monkeypatch.setattr(PartialFolder, "publish", publish_and_stop)
    with pytest.raises(KeyboardInterrupt):
        run(Generate(out=tmp_path / "set", scenarios=2, workers=0, split="0/100/0"))
    lists = tmp_path / "set" / "splits"
    assert len((lists / "validation.txt").read_text().splitlines()) == 2
    assert {file.name for file in lists.iterdir()} == {"train.txt", "validation.txt", "test.txt", "seal.json"}


@pytest.mark.slow
def test_command_prints_rate_and_rejections(tmp_path, capsys):
    out = tmp_path / "set"
    assert run(Generate(out=out, scenarios=2, seed=2, workers=1)) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].startswith(f"{out}: 2 scenarios in ") and "/s)" in printed[0]
    assert all("of draws rejected" in line for line in printed[1:]) and len(printed) > 1
    with pytest.raises(UsageError, match="--overwrite"):
        run(Generate(out=out, scenarios=1, workers=1))
    assert run(Generate(out=out, scenarios=1, workers=1, overwrite=True)) == 0
    assert len(ScenarioSet.open(out)) == 1


def test_summary_matches_counts_by_hand(tmp_path):
    counts = {"curved_road": FamilyCount(30, {"ego_collides": 2}), "x": FamilyCount(10, {}, 1200)}
    text = summary(GeneratedSet(tmp_path, 40, 4.0, counts))
    assert text.splitlines() == [
        f"{tmp_path}: 40 scenarios in 4.0 s (10.0/s)",
        "  curved_road      30 kept,  6.25% of draws rejected (ego_collides 2)",
        "  x                10 kept,  0.00% of draws rejected; 1,200 draws without the event",
    ]


def test_summary_lists_events_by_family(tmp_path):
    counts = {
        "curved_road": FamilyCount(30, {}, 0, {"cut_in": 2, "lead_brakes": 1}),
        "x": FamilyCount(10, {}, 0, {"cut_in": 4}),
    }
    text = summary(GeneratedSet(tmp_path, 40, 4.0, counts))
    assert text.splitlines()[3:] == [
        "  7 scenarios with an event:",
        "    cut_in            6 (curved_road 2, x 4)",
        "    lead_brakes       1 (curved_road 1)",
    ]


def test_segments_are_maps_and_the_manifest_describes_the_world(one_worker):
    path, result, _ = one_worker
    scenarios = ScenarioSet.open(path)
    segments = [entry["segment"] for entry in scenarios.entries]
    each = WorldConfig().scenarios_per_map
    assert [segments.index(name) // each for name in segments] == [i // each for i in range(SCENARIOS)]
    assert len(set(segments)) == -(-SCENARIOS // each)
    # The same lanes lie under all scenarios of a map, each in a frame of its own.
    lanes = [
        dict(zip(s.lane_id[s.lane_id >= 0].tolist(), s.lane_length.tolist(), strict=False))
        for s in (scenarios[0], scenarios[1])
    ]
    both = lanes[0].keys() & lanes[1].keys()
    assert both and all(abs(lanes[0][lane] - lanes[1][lane]) < 1e-3 for lane in both)
    source = scenarios.manifest["source"]
    assert source["world"] == WORLD_VERSION and source["seed"] == 5
    assert source["config"]["domain"] == "grid" and source["config"]["rare_rate"] == 0.05
    events = [entry["tags"]["event"] for entry in scenarios.entries if "event" in entry["tags"]]
    assert sum(sum(count.events.values()) for count in result.families.values()) == len(events)


def test_flags_override_the_configuration_file(tmp_path):
    file, out = tmp_path / "world.yaml", tmp_path / "set"
    file.write_text("rare_rate: 0.25\nscenarios_per_map: 3\nnoise:\n  level: 0.5\n")
    assert (
        run(
            Generate(out=out, scenarios=1, workers=1, config=file),
            ["--rare_rate", "0.75", "--domain", "ring"],
        )
        == 0
    )
    config = ScenarioSet.open(out).manifest["source"]["config"]
    assert (config["rare_rate"], config["domain"]) == (0.75, "ring")
    assert (config["scenarios_per_map"], config["noise"]["level"]) == (3, 0.5)
    file.write_text("rare_rat: 0.25\n")
    with pytest.raises(UsageError, match="rare_rate"):
        run(Generate(out=tmp_path / "other", config=file))


def test_signal_leaves_nothing(tmp_path):
    """SIGTERM while scenarios are drawn; the first shard would be full after 512."""
    code = "from drivax.cli import main; raise SystemExit(main())"
    words = ["generate", tmp_path / "set", "--scenarios", "512", "--workers", "1"]
    process = subprocess.Popen([sys.executable, "-c", code, *words], stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 120
    while not (tmp_path / ".set.partial" / "content").is_dir() and time.monotonic() < deadline:
        time.sleep(0.05)
    process.terminate()
    _, errors = process.communicate(timeout=120)
    assert (process.returncode, errors.splitlines()[-1]) == (143, "drivax: stopped by SIGTERM")
    assert list(tmp_path.iterdir()) == []


def test_missing_shared_memory_is_explained(monkeypatch):
    def missing(*_, **__):
        raise FileNotFoundError(2, "No such file or directory")  # as sem_open does, without a file

    monkeypatch.setattr("multiprocessing.synchronize.SemLock.__init__", missing)
    with pytest.raises(UsageError, match=r"^/dev/shm: no shared memory for worker processes.*--shm-size"):
        worker_pool(1)
