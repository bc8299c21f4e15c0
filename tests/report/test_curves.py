from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivax.report.charts import chart, curve_sections, format_compact, ticks
from drivax.report.pictures.palette import Stroke
from drivax.report.runs import read_runs


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0, 1, [0, 0.2, 0.4, 0.6, 0.8, 1.0]),
        (0, 2_250_000, [0, 500_000, 1e6, 1.5e6, 2e6, 2.5e6]),
        (-4.2, 17, [-5, 0, 5, 10, 15, 20]),
        (3, 3, [1, 2, 3, 4, 5]),
    ],
)
def test_ticks_are_round_numbers(low, high, expected):
    np.testing.assert_allclose(ticks(low, high, 5), expected, atol=1e-9)


@given(st.floats(-1e9, 1e9), st.floats(-1e9, 1e9))
def test_ticks_are_even_and_enclose_the_range(a, b):
    low, high = min(a, b), max(a, b)
    found = np.array(ticks(low, high, 5))
    slack = 1e-6 * max(1.0, abs(low), abs(high))
    assert found[0] <= low + slack and found[-1] >= high - slack and 2 <= len(found) <= 9
    np.testing.assert_allclose(np.diff(found), found[1] - found[0], rtol=1e-6)


def test_compact_numbers_use_k_m_and_g():
    assert [format_compact(v) for v in (0, 1500, 2.5e6, -0.25, 1e-3)] == [
        "0",
        "1.5k",
        "2.5M",
        "−0.25",
        "0.001",
    ]


def test_straight_line_is_drawn_straight_and_to_scale():
    points = np.array([[0.0, 0.0], [50.0, 0.5], [100.0, 1.0]])
    html = chart("rollout/success", {"a <run>": (Stroke("#123456"), points)}, share=True)
    drawn = np.array(
        [pair.split(",") for pair in re.search(r'points="([^"]+)"', html)[1].split()], dtype=np.float64
    )
    np.testing.assert_allclose(drawn[1], (drawn[0] + drawn[2]) / 2, atol=0.06)
    lines = [float(y) for y in re.findall(r'y1="([\d.]+)"', html)]
    assert drawn[0, 1] == max(lines) and drawn[2, 1] == min(lines), (
        "0 and 1 lie on the first and last grid line"
    )
    assert "a &lt;run&gt;" in html and "<run>" not in html


def test_long_curves_are_averaged_into_bins():
    points = np.stack((np.arange(10_000.0), np.full(10_000, 2.0)), axis=-1)
    html = chart("loss", {"a": (Stroke("#123456"), points)})
    assert len(re.search(r'points="([^"]+)"', html)[1].split()) == 150


def test_rollout_curves_come_first_and_losses_are_folded(runs):
    html = curve_sections(read_runs(runs)[1])
    first, rest = html.split("<details>")
    assert "rollout/success" in first and "loss/policy" in rest and "1 more curves" in rest
    assert curve_sections([]) == "<p>No quantity was logged more than once.</p>"
