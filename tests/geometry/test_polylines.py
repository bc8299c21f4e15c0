"""Polylines against hand-computed values, dense sampling and a textbook recursion."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import interp1d

from drivax.geometry.polylines import (
    Polylines,
    arc_lengths,
    cut_counts,
    headings,
    point_to_segment,
    project,
    project_monotone,
    resample,
    simplify,
)

SEEDS = st.integers(0, 10_000)


def random_walk(seed: int, count: int = 60, turn: float = 0.5) -> np.ndarray:
    rng = np.random.default_rng(seed)
    course = np.cumsum(rng.normal(0.0, turn, count))
    step = rng.uniform(0.1, 2.0, count)
    xy = np.cumsum(np.stack((step * np.cos(course), step * np.sin(course)), axis=-1), axis=0)
    return np.concatenate((xy, rng.normal(0.0, 1.0, (count, 1))), axis=1)


def dense(points: np.ndarray, begin: float, end: float, count: int = 4001) -> tuple[np.ndarray, np.ndarray]:
    """Arc lengths and points between two arc lengths, by SciPy's interpolation."""
    s = np.linspace(begin, end, count)
    return s, interp1d(arc_lengths(points), points[:, :2], axis=0)(s)


def test_arc_length_by_hand_restarts_at_every_polyline():
    lines = Polylines.of(
        [np.array([[0.0, 0, 9], [3, 4, 1], [3, 10, 5]]), np.array([[100.0, 0, 0], [101, 0, 0]])]
    )
    assert lines.arc.tolist() == [0.0, 5.0, 11.0, 0.0, 1.0]
    assert lines.length.tolist() == [11.0, 1.0]
    assert lines.row.tolist() == [0, 0, 0, 1, 1]
    assert Polylines.of([np.zeros((0, 3))]).length.tolist() == [0.0]


def test_points_and_headings_on_a_corner_by_hand():
    lines = Polylines.of(
        [np.array([[50.0, 0, 0], [60, 0, 0]]), np.array([[0.0, 0, 0], [10, 0, 2], [10, 10, 4]])]
    )
    row = np.array([1, 1, 1, 1, 0])
    at = lines.at(row, np.array([5.0, 15.0, 20.0, 22.0, -1.0]))
    assert at.tolist() == [[5, 0, 1], [10, 5, 3], [10, 10, 4], [10, 12, 4.4], [49, 0, 0]]
    angle = lines.heading(np.array([1, 1, 1, 1]), np.array([0.0, 5.0, 10.0, 20.0]), span_m=2.0)
    assert angle == pytest.approx([0.0, 0.0, math.pi / 4, math.pi / 2])


@given(SEEDS)
def test_points_at_arc_lengths_equal_scipy_interpolation(seed):
    walks = [random_walk(seed + i, 5 + 7 * i) for i in range(4)]
    lines = Polylines.of(walks)
    for row, walk in enumerate(walks):
        s = np.linspace(0.0, arc_lengths(walk)[-1], 33)
        expected = interp1d(arc_lengths(walk), walk, axis=0)(s.clip(max=arc_lengths(walk)[-1]))
        assert lines.at(np.full(33, row), s) == pytest.approx(expected, abs=1e-9)


def recursive_simplify(points: np.ndarray, tolerance: float) -> set[int]:
    """Douglas and Peucker as printed: recursion over one polyline."""

    def keep(first: int, last: int) -> set[int]:
        if last - first < 2:
            return set()
        a, b = points[first, :2], points[last, :2]
        far = [_distance(points[i, :2], a, b) for i in range(first + 1, last)]
        peak = first + 1 + int(np.argmax(far))
        return {peak} | keep(first, peak) | keep(peak, last) if max(far) > tolerance else set()

    return {0, len(points) - 1} | keep(0, len(points) - 1)


def _distance(p, a, b) -> float:
    t = 0.0 if np.allclose(a, b) else min(max(float((p - a) @ (b - a) / ((b - a) @ (b - a))), 0.0), 1.0)
    return float(np.hypot(*(p - a - t * (b - a))))


@given(SEEDS)
def test_simplify_equals_the_recursion_on_every_polyline(seed):
    walks = [random_walk(seed + i, 3 + 11 * i) for i in range(4)]
    walks.append(np.concatenate((walks[3], walks[3][:1])))  # a ring
    kept = simplify(Polylines.of(walks), 0.3)
    start = np.cumsum([0, *map(len, walks)])
    for walk, begin in zip(walks, start, strict=False):
        assert set(np.flatnonzero(kept[begin : begin + len(walk)])) == recursive_simplify(walk, 0.3)


@given(SEEDS)
def test_simplify_drops_no_point_further_than_the_tolerance(seed):
    walk = random_walk(seed, 80, turn=0.1)
    kept = np.flatnonzero(simplify(Polylines.of([walk]), 0.05))
    for i in range(len(walk)):
        after = max(int(np.searchsorted(kept, i)), 1)
        assert _distance(walk[i, :2], walk[kept[after - 1], :2], walk[kept[after], :2]) <= 0.05 + 1e-12


def test_simplify_respects_weighted_height():
    hill = np.array([[0.0, 0, 0], [10, 0, 1], [20, 0, 0]])
    lines = Polylines.of([hill])
    assert simplify(lines, 0.05).tolist() == [True, False, True]
    assert simplify(lines, 0.05, z_weight=0.25).all()


def test_straight_and_tiny_polylines_simplify_to_their_ends():
    lines = Polylines.of([np.linspace([0.0, 0, 0], [9, 3, 0], 40), np.ones((1, 3)), np.ones((2, 3))])
    assert np.flatnonzero(simplify(lines, 1e-9)).tolist() == [0, 39, 40, 41, 42]


def test_cut_counts_by_hand():
    assert cut_counts(np.array([0.0, 3.9, 4.0, 4.001, 12.0]), 4.0).tolist() == [1, 1, 1, 2, 3]


@given(SEEDS)
def test_distance_to_a_segment_equals_dense_sampling(seed):
    rng = np.random.default_rng(seed)
    p, a, b = rng.normal(0.0, 5.0, (3, 1, 2))
    t = np.linspace(0.0, 1.0, 20_001)
    brute = np.hypot(*(p - a - t[:, None] * (b - a)).T)
    distance, fraction = point_to_segment(p, a, b)
    beside = np.hypot(*(b - a)[0]) / 40_000  # the nearest sample lies at most half a spacing off the foot
    assert -1e-9 <= brute.min() - distance[0] <= np.hypot(distance[0], beside) - distance[0] + 1e-9
    assert fraction[0] == pytest.approx(t[brute.argmin()], abs=1e-3)


def test_distance_to_a_segment_of_no_length():
    distance, fraction = point_to_segment(np.array([[3.0, 4.0]]), np.zeros((1, 2)), np.zeros((1, 2)))
    assert (distance.tolist(), fraction.tolist()) == ([5.0], [0.0])


@given(SEEDS)
def test_resampled_points_are_a_metre_of_arc_apart(seed):
    walk = random_walk(seed)
    points, index = resample(walk, 1.0)
    arc = arc_lengths(walk)
    assert len(points) == math.floor(arc[-1] + 1e-6) + 1
    s = np.arange(len(points)).clip(max=arc[-1])
    assert points == pytest.approx(interp1d(arc, walk, axis=0)(s), abs=1e-9)
    assert np.all((arc[index] <= s + 1e-6) & (s <= arc[index + 1] + 1e-6))
    assert len(resample(walk, 1.0, most=7)[0]) == 7


def test_headings_by_central_differences():
    corner = np.array([[0.0, 0], [1, 0], [1, 1], [1, 2]])
    assert headings(corner) == pytest.approx([0.0, math.pi / 4, math.pi / 2, math.pi / 2])


@given(SEEDS)
def test_projection_equals_dense_sampling(seed):
    walk = random_walk(seed)
    queries = np.random.default_rng(seed + 1).normal(0.0, 20.0, (5, 2))
    s, distance = project(walk, queries)
    _, line = dense(walk, 0.0, arc_lengths(walk)[-1], 40_001)
    brute = np.hypot(*(queries[:, None] - line).transpose(2, 0, 1))
    assert distance == pytest.approx(brute.min(axis=1), abs=2e-3)
    foot = interp1d(arc_lengths(walk), walk[:, :2], axis=0)(s)
    assert np.hypot(*(foot - queries).T) == pytest.approx(distance, abs=1e-9)


@given(SEEDS)
def test_monotone_projection_equals_dense_sampling_of_each_window(seed):
    walk = random_walk(seed, 50)
    rng = np.random.default_rng(seed + 1)
    total = arc_lengths(walk)[-1]
    true_s = np.sort(rng.uniform(0.0, total, 12))
    queries = interp1d(arc_lengths(walk), walk[:, :2], axis=0)(true_s) + rng.normal(0.0, 1.0, (12, 2))
    window = rng.uniform(0.5, 12.0, 12)
    found = project_monotone(walk, queries, window)
    assert (np.diff(found) >= 0.0).all()
    for k, (query, s) in enumerate(zip(queries, found, strict=True)):
        low, high = (0.0, total) if k == 0 else (found[k - 1], min(found[k - 1] + window[k], total))
        assert low - 1e-9 <= s <= high + 1e-9
        _, line = dense(walk, low, high, 8001)
        foot = interp1d(arc_lengths(walk), walk[:, :2], axis=0)(s)
        assert np.hypot(*(foot - query)) <= np.hypot(*(line - query).T).min() + 1e-6


def test_monotone_projection_stays_on_its_branch_and_at_the_end():
    hairpin = np.array([[0.0, 0], [50, 0], [50, 3], [0, 3]])
    queries = np.array([[10.0, 1.4], [20, 1.6], [30, 1.6], [30, 1.6]])
    assert project_monotone(hairpin, queries, np.full(4, 15.0)).tolist() == [10.0, 20.0, 30.0, 30.0]
    line = np.array([[0.0, 0], [2, 0], [2, 0], [4, 0]])  # with a repeated point
    assert project_monotone(line, np.array([[9.0, 0], [9, 0]]), np.full(2, 1.0)).tolist() == [4.0, 4.0]


def test_resampling_needs_memory_for_its_samples_only():
    points, index = resample(np.array([[0.0, 0.0, 0.0], [1e13, 0.0, 0.0]]), 1.0, 400)
    assert points[:, 0] == pytest.approx(np.arange(400.0))
    assert index.tolist() == [0] * 400
