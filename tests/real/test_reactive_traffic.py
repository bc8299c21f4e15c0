"""Reactive traffic on the recordings of ``../shared/data``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from drivax.datasets.conversion import Conversion, convert_file
from drivax.datasets.reader import BadRecord
from drivax.scenario.bank.columns import AgentColumn
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.simulator.traffic.agent_paths import AgentPaths
from drivax.simulator.traffic.bank_data import data_of
from drivax.simulator.traffic.reactive import DRIVES, REPLAYS
from traffic_oracle import TRAFFIC, compare, new_overlaps, runs_of
from traffic_oracle import Path as Line

pytestmark = pytest.mark.slow
FILES = (
    "womd/*", "scenarionet/*.pkl", "gpudrive/*.json", "av2/*/scenario_*.parquet",
    "av2_sensor/*/annotations*.feather",
)  # fmt: skip


@pytest.fixture(scope="module")
def bank(real_data: Path) -> ScenarioBank:
    for package in ("shapely", "pyarrow", "google.protobuf"):
        pytest.importorskip(package, reason=f"needs {package}")
    files = [file for pattern in FILES for file in sorted(real_data.glob(pattern))]
    found = [item for file in files for item in convert_file(file, Conversion())]
    scenarios = [item for item in found if not isinstance(item, BadRecord)]
    assert len(scenarios) >= 15
    return TRAFFIC.prepare(ScenarioBank.from_scenarios(scenarios))


@pytest.fixture(scope="module")
def runs(bank):
    return runs_of(bank)


def test_reactive_vehicles_follow_idm(bank, runs):
    found = np.concatenate([compare(bank, index, *run, every=20) for index, run in enumerate(runs)])
    assert len(found) > 400
    assert np.quantile(found[:, 0], 0.99) < 5e-3


def test_paths_follow_logs_and_vehicles_follow_paths(bank, runs):
    agents = np.asarray(bank.agents, np.float64)
    away, left, moves = [], [], []
    for index, (frames, traffic) in enumerate(runs):
        for row in np.flatnonzero((traffic.phase == DRIVES).any(0)):
            slot, path = (
                int(data_of(bank, AgentPaths).slot[index, row]),
                Line(data_of(bank, AgentPaths), index, row),
            )
            seen = agents[index, :, slot, AgentColumn.VALID] > 0
            x, y, _, _ = path.at(np.asarray(data_of(bank, AgentPaths).log_arc[index, seen, row]))
            away += np.hypot(x - agents[index, seen, slot, 0], y - agents[index, seen, slot, 1]).tolist()
            moves += (np.hypot(*agents[index, seen, slot, 5:7].T) > 1.0).tolist()
            there = np.flatnonzero(frames.valid[1:, slot])[::10] + 1
            if slot > 0:
                left += [path.project(frames.box[t, slot, :2].astype(float), 0, np.inf)[1] for t in there]
    # A standing car's boxes jitter by up to a metre, which shapes no path.
    assert np.quantile(np.array(away)[moves], 0.99) < 0.1 and max(away) < 1.1
    assert max(left) < 0.02


def test_few_reactive_vehicles_collide(bank, runs):
    found = [new_overlaps(bank, index, *run) for index, run in enumerate(runs)]
    reacting = sum(len(agents) for _, agents in found)
    between = sum(len([pair for pair in pairs if set(pair) <= set(agents)]) for pairs, agents in found)
    print(
        f"{reacting} react, {sum(len(p) for p, _ in found)} new overlaps, {between} of them between two that react"
    )
    # Merging without a light, and things that appear on top of somebody after they were hidden.
    assert reacting > 300 and between <= 0.03 * reacting


def test_reactive_speeds_match_the_log(bank, runs):
    shares = []
    for index, (_, traffic) in enumerate(runs):
        for row in np.flatnonzero((traffic.phase != REPLAYS).any(0)):
            logged = float(
                data_of(bank, AgentPaths).log_arc[index, -1, row]
                - data_of(bank, AgentPaths).log_arc[index, 10, row]
            )
            if logged > 20.0:
                shares.append((traffic.arc[-1, -1, row] - traffic.arc[0, -1, row]) / logged)
    assert 0.8 < np.median(shares) < 1.3
