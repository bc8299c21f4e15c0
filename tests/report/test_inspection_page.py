"""Histograms and the self-contained page about scenario sets."""

from __future__ import annotations

import re
import shutil
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivax.errors import UsageError
from drivax.report.charts import BINS, bins, histogram
from drivax.report.inspection import Inspection, comparison
from drivax.report.pages.inspection import write_histograms
from drivax.scenario.select.selection import Selection

NUMBERS = st.one_of(
    st.lists(st.integers(0, 100_000), min_size=1, max_size=60),
    st.lists(st.floats(0, 1e6, allow_subnormal=False), min_size=1, max_size=60),
)


@given(NUMBERS)
def test_bins_hold_every_value_once(numbers):
    values = np.array(numbers, np.float64)
    edges = bins(values)
    widths = np.diff(edges)
    assert 1 <= len(widths) <= 2 * BINS
    np.testing.assert_allclose(widths, widths[0], rtol=1e-6)
    counts, _ = np.histogram(values, edges)
    assert counts.sum() == len(values)


def test_rounding_of_the_first_edge_drops_no_value():
    values = np.array([0.7, 1.0, 1.3])  # 14 bins of 0.05 begin at 0.7000000000000001
    assert np.histogram(values, bins(values))[0].sum() == 3


@pytest.mark.parametrize(
    ("values", "edges"),
    [
        ([3, 5, 6], [2.5, 3.5, 4.5, 5.5, 6.5]),
        ([91, 91], [89.5, 90.5, 91.5, 92.5]),
        ([0.0, 0.0], [-1.5, -0.5, 0.5, 1.5]),
    ],
)
def test_whole_numbers_are_bin_centres(values, edges):
    np.testing.assert_allclose(bins(np.array(values, np.float64)), edges)


def test_bar_heights_are_shares():
    # 1, 1, 1, 2: bars of 75 % and 25 %, so that one is three times as high.
    text = histogram("cars", {"a": np.array([1.0, 1.0, 1.0, 2.0])})
    heights = [float(height) for height in re.findall(r'<rect [^>]*height="([\d.]+)"', text)]
    assert len(heights) == 2 and heights[0] == pytest.approx(3 * heights[1], abs=0.2)
    assert "75 %" in text and "25 %" in text
    assert "median 1, max 2, n 4" in text


def test_series_share_their_bins():
    text = histogram("cars", {"a": np.array([1.0, 2.0]), "b": np.array([9.0]), "none": np.zeros(0)})
    lines = re.findall(r'<polyline[^>]*points="([^"]*)"', text)
    ends = {tuple(line.split()[i] for i in (0, -1)) for line in lines}
    assert len(lines) == 3 and len(ends) == 1
    assert "none: n 0" in text and "<rect" not in text


def test_names_are_escaped():
    text = histogram("a<b", {"<script>": np.array([1.0]), "&": np.array([2.0])})
    assert "<script>" not in text and "a&lt;b" in text


class _Tags(HTMLParser):
    """Checks that elements are closed in order."""

    VOID = ("meta", "br", "line", "rect", "polyline", "link")

    def __init__(self):
        super().__init__()
        self.open, self.loads = [], []

    def handle_starttag(self, tag, attrs):
        self.loads += [value for name, value in attrs if name in ("src", "href")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in self.VOID:
            assert self.open and self.open.pop() == tag


def test_page_nests_and_loads_nothing(hand_set, tmp_path):
    one = Inspection.open(hand_set, Selection())
    page = write_histograms([one, one], tmp_path / "page.html")
    parser = _Tags()
    parser.feed(page.read_text())
    assert parser.open == [] and parser.loads == []
    assert len(page.read_bytes()) < 200_000


def test_sets_in_folders_of_the_same_name_stay_apart(hand_set, tmp_path):
    for name in ("a", "b"):
        shutil.copytree(hand_set, tmp_path / name / "set")
    both = [Inspection.open(tmp_path / name / "set", Selection()) for name in ("a", "b")]
    (table,) = comparison(both)
    assert [column.heading for column in table.columns] == ["", "a/set", "b/set"]
    text = write_histograms(both, tmp_path / "page.html").read_text()
    assert text.count("<small>a/set: median") == text.count("<small>b/set: median") > 0


def test_existing_page_is_kept(hand_set, tmp_path):
    one = Inspection.open(hand_set, Selection())
    page = tmp_path / "page.html"
    page.write_text("mine")
    with pytest.raises(UsageError, match="already exists"):
        write_histograms([one], page)
    assert page.read_text() == "mine"
    with pytest.raises(UsageError, match="is a folder"):
        write_histograms([one], tmp_path)


def test_unknown_recordings_count_by_scenario():
    names = (("a", "r"), ("b", "r"), ("c", ""), ("d", ""))
    entries = [{"dataset": "d", "scenario_id": name, "segment": segment} for name, segment in names]
    assert Inspection.recordings.fget(SimpleNamespace(entries=entries)) == 3
