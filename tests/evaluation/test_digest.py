"""``drivax doctor --digest``: one value for float noise and for any setting, another one for other physics."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivax.cli import main
from drivax.evaluation import digest
from drivax.evaluation.digest import EXACT, SCENARIOS, UNITS, episode_digest, grid_cells
from drivax.evaluation.episode_table import KEYS, EpisodeTable, Trajectories
from drivax.evaluation.runner import evaluate
from drivax.metrics.catalogue import EVENTS
from drivax.planners.simple import IdmPlanner
from drivax.scenario.build.assemble import assemble
from drivax.simulator.idm import IdmParameters
from drivax.synthetic.world import generate_recording

#: Least distance of a value from an edge, and least lead of the chosen start of a grid over the second best, m. The
#: largest difference of a quantity between optimised and unoptimised programs was 1.8e-4 m.
EDGE_M, LEAD_M = 5e-3, 1e-3


def episodes(seed: int = 0) -> EpisodeTable:
    """Random episodes: truths, counts, quantities of up to 80 m with some undefined, and first events."""
    rng = np.random.default_rng(seed)
    metrics = {name: rng.integers(0, 2, SCENARIOS).astype(float) for name in EXACT}
    for name in UNITS:
        metrics[name] = np.where(rng.random(SCENARIOS) < 0.1, np.nan, rng.gamma(2.0, 20.0, SCENARIOS))
    events = {name: rng.integers(-1, 90, SCENARIOS) for name in EVENTS}
    ego, action = np.zeros((SCENARIOS, 2, 4), np.float32), np.zeros((SCENARIOS, 1, 2))
    trajectories = Trajectories(ego, action, np.full(SCENARIOS, 10), events)
    keys = dict.fromkeys(KEYS, ("",) * SCENARIOS)
    return EpisodeTable(None, "random", {}, keys, metrics, in_memory=trajectories)


def with_metric(table: EpisodeTable, name: str, values) -> EpisodeTable:
    return replace(table, metrics={**table.metrics, name: values})


def test_float_noise_keeps_the_digest():
    table, rng = episodes(), np.random.default_rng(1)
    share = rng.uniform(-1e-3, 1e-3, SCENARIOS)
    noisy = {name: table.metrics[name] + share * unit for name, unit in UNITS.items()}
    assert episode_digest(replace(table, metrics={**table.metrics, **noisy})) == episode_digest(table)


@pytest.mark.parametrize("name", [*EXACT, *UNITS])
def test_one_other_episode_changes_the_digest(name):
    table = episodes()
    values = table.metrics[name].copy()
    values[17] = 81.0 if not np.isfinite(values[17]) else values[17] + 1.0
    assert episode_digest(with_metric(table, name, values)) != episode_digest(table)
    values[17] = np.nan
    assert episode_digest(with_metric(table, name, values)) != episode_digest(table)


@pytest.mark.parametrize("event", EVENTS)
def test_first_events_change_the_digest(event):
    table = episodes()
    steps = table.in_memory.events[event].copy()
    steps[3] += 1
    other = replace(table.in_memory, events={**table.in_memory.events, event: steps})
    assert episode_digest(replace(table, in_memory=other)) != episode_digest(table)


@pytest.mark.parametrize("change", [lambda v: 1.005 * v, lambda v: v + 0.25])
def test_small_systematic_changes_change_the_digest(change):
    table = episodes()
    assert episode_digest(
        with_metric(table, "distance", change(table.metrics["distance"]))
    ) != episode_digest(table)


def test_grid_starts_farthest_from_all_values():
    """Hand-computed: values near 0 and 1/2 of a unit of 2; the first start with a quarter of it on both sides."""
    values = np.array([2.02, 5.0, np.nan, 8.02])
    cells, distances = grid_cells(values, 2.0)
    np.testing.assert_allclose(distances[[0, 1, 2, 3, 6]], [0.01, 0.115, 0.24, 0.125, 0.25], atol=1e-12)
    # Edges at 0.75, 1.75, 2.75 ... units: 1.01, 2.5 and 4.01 lie in the cells 0, 1 and 3, of 8 eighths each.
    assert cells.tolist() == [6, 14, np.iinfo(np.int64).min, 30]
    assert grid_cells(np.full(3, np.nan), 1.0)[0].tolist() == [np.iinfo(np.int64).min] * 3


def test_digest_takes_no_path(capsys):
    assert main(["doctor", "--digest", "somewhere"]) == 2
    assert "leave out one of them" in capsys.readouterr().err


@pytest.mark.slow
def test_slightly_different_planner_has_another_digest():
    scenarios = [assemble(generate_recording(33, i)) for i in range(8)]
    digests = [
        episode_digest(evaluate(IdmPlanner(parameters=parameters), scenarios))
        for parameters in (IdmParameters(), IdmParameters(), IdmParameters(acceleration_mps2=1.52))
    ]
    assert digests[0] == digests[1] != digests[2]


#: Settings that stand for other machines: kernels, threads, devices, older processors, another order of operations.
SETTINGS = {
    "default": {},
    "without kernels": {"DRIVAX_NATIVE": "0"},
    "one thread": {"XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false"},
    "two devices": {"XLA_FLAGS": "--xla_force_host_platform_device_count=2"},
    "without AVX": {"XLA_FLAGS": "--xla_cpu_max_isa=SSE4_2"},
    "not optimised": {
        "XLA_FLAGS": "--xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=0"
        " --xla_llvm_disable_expensive_passes=true"
    },
}


@pytest.mark.slow
def test_digest_is_one_value_under_every_setting():
    digests = {}
    for name, variables in SETTINGS.items():
        environment = os.environ | {"XLA_FLAGS": "", "PYTHONPATH": os.pathsep.join(sys.path)} | variables
        call = [sys.executable, "-m", "drivax", "doctor", "--digest"]
        out = subprocess.run(call, env=environment, capture_output=True, text=True, check=True).stdout
        lines = (line.strip() for line in out.splitlines() if not line.startswith("jax"))
        digests[name] = dict(re.split(r"\s{2,}", line) for line in lines)
    assert len(digests["default"]["digest"]) == 16
    assert all(rows == digests["default"] for rows in digests.values()), digests
    page = Path(__file__).parents[2] / "docs" / "guide" / "reproducibility.md"
    assert f"the digest `{digests['default']['digest']}`" in page.read_text()


@pytest.mark.slow
def test_no_standard_value_is_near_an_edge(monkeypatch):
    """Nor is the second best start of a grid near the best one, so noise chooses no other start."""
    tables = []
    monkeypatch.setattr(digest, "episode_digest", lambda table: tables.append(table) or "")
    assert [name for name, _ in digest.standard_digests()][-1] == "digest" and len(tables) == 3
    for table in tables:
        for name, unit in UNITS.items():
            second, best = np.sort(grid_cells(table.metrics[name], unit)[1])[-2:]
            assert best * unit > EDGE_M and (best - second) * unit > LEAD_M, (name, best, second)
