"""The script that finds the most critical moments of real files: which of them it counts as the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drivax.curation.scores import ScoreTable
from drivax.scenario.build.assemble import assemble
from experiment_scripts import load_script
from scenes import SMALL, STEPS, car, straight_road


def test_moments_of_one_recording_are_apart():
    """Scenarios in order of their score: recording, window and vehicle, place, step of the highest score."""
    moments = (
        ("a", "a@0/1", 0.0, 40),  # at 4.0 s
        ("a", "a@0/2", 29.0, 60),  # 2 s and 29 m from the first
        ("a", "a@0/3", 31.0, 60),  # 2 s later, but 31 m away
        ("a", "a@20/1", 0.0, 50),  # at 7.0 s: 3 s after the first, as far as the bound
        ("a", "a@20/2", 0.0, 51),  # at 7.1 s
        ("b", "b@0/1", 0.0, 40),  # of another recording
        ("a", "a@0/4", 31.0, 61),  # next to the third
    )
    scenarios, steps = [], np.zeros((len(moments), STEPS))
    for row, (recording, name, x, step) in enumerate(moments):
        scene = straight_road([car(x=x), car(x=x + 20.0)])
        scenarios.append(assemble(replace(scene, scenario_id=name, segment=recording), SMALL))
        steps[row, step] = 1.0
    criticality = 1.0 - np.arange(len(moments)) / 10.0
    ids = tuple(scenario.id for scenario in scenarios)
    table = ScoreTable("kinematic", {}, "hash", ids, np.ones(steps.shape, bool), steps, criticality, {})
    chosen = list(load_script("curation.moments").most_critical(table, scenarios))
    assert chosen == [(0, 40), (2, 60), (4, 51), (5, 40)]
