from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from drivax.report.charts import distribution, distribution_charts
from drivax.report.runs import read_runs


def test_distribution_is_a_staircase():
    found = distribution([3.0, np.nan, 1.0, 3.0, 2.0])
    np.testing.assert_allclose(
        found, [(1, 0), (1, 0.25), (2, 0.25), (2, 0.5), (3, 0.5), (3, 0.75), (3, 0.75), (3, 1.0)]
    )
    assert distribution([np.nan]).shape == (0, 2)


@given(st.lists(st.floats(-5, 5), min_size=1, max_size=400))
def test_distribution_is_the_share_of_values_up_to_a_value(values):
    found = distribution(values)
    assert (
        found[0, 1] == 0 and found[-1, 1] == 1 and (np.diff(found, axis=0) >= 0).all() and len(found) <= 150
    )
    for value, share in found[1::2]:
        exact = np.mean(np.array(values) <= value)
        # Equal values make one step; its corners lie on the way up, at its foot or its top.
        below = np.mean(np.array(values) < value)
        assert below - 1e-9 <= share <= exact + 1e-9


def test_only_varying_metrics_have_a_chart(runs):
    evaluations, _ = read_runs(runs)
    html = distribution_charts(evaluations)
    titles = re.findall(r"<figcaption>([^<]+)</figcaption>", html)
    assert titles == ["V-Max score", "progress"], "the least TTC is undefined everywhere"
    assert html.count("<polyline") == 6 and all(run.name in html for run in evaluations)
    evaluations[0].metrics["progress_ratio"][:] = np.nan
    assert distribution_charts(evaluations).count("<polyline") == 5
    assert distribution_charts(evaluations[:0]) == ""


def test_nine_planners_have_distinct_strokes(runs):
    policy = read_runs(runs)[0][-1]
    html = distribution_charts([replace(policy, name=f"planner {place}") for place in range(9)])
    legend, *charts = html.split("<figure")
    assert len(set(re.findall(r'style="background:([^"]+)"', legend))) == 9
    lines = re.findall(r"<polyline (stroke.*?) points", charts[0])
    assert len(set(lines)) == len(lines) == 9 and sum("dasharray" in line for line in lines) == 3
