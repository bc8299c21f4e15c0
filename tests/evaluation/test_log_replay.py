"""Log replay: the exact expert never diverges, collides or leaves the road; the driven expert stays next to it.

Six generated logs do so in every quick run (``tests/simulator/test_simulator.py``).
"""

from functools import cache

import numpy as np
import pytest

from drivax.datasets.formats import detect, survey
from drivax.evaluation.audit import audit, scenario_names
from drivax.evaluation.runner import evaluate
from drivax.planners.simple import Expert
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.scenario.recording import windows
from drivax.synthetic.world import generate_recording

EXACT, DRIVEN = Expert(), Expert(replays=False)


def driven_by(planner, scenarios):
    bank = ScenarioBank.from_scenarios(scenarios, trim=False)
    return evaluate(planner, bank, scenario_names(scenarios)).metrics


def check_exact(scenarios):
    metrics = driven_by(EXACT, scenarios)
    # Logged poses are replayed as stored, so not even rounding adds to them.
    assert np.nanmax(metrics["ade"]) == 0.0 and np.nanmax(metrics["fde"]) == 0.0
    for name in ("collision", "at_fault_collision", "offroad", "red_light"):
        assert np.nansum(metrics[name]) == 0.0, name
    assert (metrics["accuracy"] == 1.0).all()


def generated(seed, count):
    return [assemble(generate_recording(seed, index)) for index in range(count)]


@cache
def real_windows(folder):
    """Windows of the egos of all real files, and their audit findings."""
    scenarios = []
    for file in survey(folder).paths():
        for recording in detect(file).read(file):
            scenarios += [assemble(window) for window in windows(recording)]
    return scenarios, audit(scenarios)


@pytest.mark.slow
@pytest.mark.parametrize("part", range(4))
def test_thousand_generated_logs_replay_exactly_and_can_be_driven(part):
    scenarios = generated(1000 + part, 250)
    check_exact(scenarios)
    assert (driven_by(DRIVEN, scenarios)["fde"] <= 0.2).mean() >= 0.95


@pytest.mark.slow
def test_every_real_file_replays_exactly_and_can_be_driven(real_data):
    scenarios, findings = real_windows(real_data)
    assert all(finding["clean"] for finding in findings) and len(scenarios) >= 25
    check_exact(scenarios)
    fde_m = driven_by(DRIVEN, scenarios)["fde"]
    # A car within the bounds cannot follow a log that exceeds them, as logs interpolated from 2 Hz do.
    within = np.array([finding["clipped_physical"] == 0 for finding in findings])
    assert fde_m[within].max() <= 0.2 and fde_m.max() <= 0.5
