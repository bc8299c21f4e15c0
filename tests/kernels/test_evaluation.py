"""Evaluation rows of fixed scenarios with kernels and by XLA: truths and counts are equal."""

import numpy as np
import pytest

from drivax import kernels
from drivax.evaluation.runner import evaluate
from drivax.metrics.catalogue import METRICS
from drivax.planners.catalogue import make_planner
from drivax.scenario.build.assemble import assemble
from drivax.synthetic.world import generate_recording
from kernels.compare import needs_kernels

pytestmark = [needs_kernels, pytest.mark.slow]

COUNTS = ("steps", "last_step", "ignored_overlaps", "crashed")


def assert_same_rows(planner, scenarios):
    actual = evaluate(make_planner(planner), scenarios).metrics
    with kernels.without_kernels():
        expected = evaluate(make_planner(planner), scenarios).metrics
    assert actual.keys() == expected.keys() >= METRICS.keys()
    for name, values in expected.items():
        is_exact = name in COUNTS or (name in METRICS and METRICS[name].kind in ("rate", "code"))
        # Rounding adds up over the steps of an episode.
        tolerance = 0.0 if is_exact else 1e-4
        np.testing.assert_allclose(actual[name], values, rtol=tolerance, atol=tolerance, err_msg=name)
    return expected


def test_rows_of_generated_scenarios_equal_those_of_xla():
    rows = assert_same_rows("idm", [assemble(generate_recording(23, number)) for number in range(16)])
    assert set(rows["success"]) == {0.0, 1.0}
