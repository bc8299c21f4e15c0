"""Densities against the formula for all pairs, closed forms, and another implementation of the published histogram."""

from dataclasses import replace

import numpy as np
import pytest

from drivax.curation.logged import score_bank
from drivax.curation.rarity import (
    ExpertActions,
    KernelRarity,
    PublishedRarity,
    rarity_steps,
    read_actions,
    write_actions,
)
from drivax.errors import DataError, UsageError
from scenes import bank_of, car, straight_road

RNG = np.random.default_rng(2)


def test_density_of_one_action_is_the_kernel():
    kernel = KernelRarity(bandwidth=0.1, cells=512)
    middle = np.zeros((1, 2)) + 1 / 512  # the centre of a cell
    at = middle + np.array([[0.0, 0.0], [0.1, 0.0], [0.0, -0.2], [0.15, 0.15]])
    expected = np.exp(-0.5 * ((at - middle) ** 2).sum(axis=1) / 0.01) / (2 * np.pi * 0.01)
    np.testing.assert_allclose(kernel.density(kernel.histogram(middle), at), expected, rtol=2e-3)


def test_density_integrates_to_one_at_the_bounds_too():
    """Kernels are mirrored at the bounds."""
    actions = np.clip(RNG.normal(0.9, 0.3, (500, 2)), -1, 1)
    centres = -1 + (np.arange(256) + 0.5) / 128
    grid = np.stack(np.meshgrid(centres, centres), -1).reshape(-1, 2)
    kernel = KernelRarity()
    assert kernel.density(kernel.histogram(actions), grid).sum() / 128**2 == pytest.approx(1.0, rel=1e-9)


def test_density_equals_the_sum_over_pairs():
    actions, at = RNG.uniform(-0.5, 0.5, (400, 2)), RNG.uniform(-0.5, 0.5, (60, 2))
    squared_distance = ((at[:, None] - actions) ** 2).sum(axis=2)
    expected = np.exp(-0.5 * squared_distance / 0.05**2).mean(axis=1) / (2 * np.pi * 0.05**2)
    kernel = KernelRarity(bandwidth=0.05, cells=1024)
    np.testing.assert_allclose(kernel.density(kernel.histogram(actions), at), expected, rtol=0.02)


@pytest.mark.parametrize("temper", [1.0, 0.5, 0.0])
def test_inverse_frequency_tempered_and_clipped(temper):
    """Two distant actions, of which one has nine tenths of the steps: the other is nine times rarer."""
    actions = np.repeat([[0.25, 0.25], [-0.5, 0.5]], (900, 100), axis=0)
    kernel = KernelRarity(temper=temper, most=5.0)
    scores = kernel.scores(kernel.histogram(actions), actions)
    np.testing.assert_allclose(scores[:900], 1 / 5)
    np.testing.assert_allclose(scores[900:], min(9**temper, 5.0) / 5, rtol=1e-6)
    other = kernel.scores(kernel.histogram(actions), np.array([[0.9, -0.9], [0.25, 0.25]]))
    np.testing.assert_allclose(other, [1.0 if temper else 0.2, 0.2])


def test_published_histogram_equals_counts_cell_by_cell():
    """The histogram is counted and weighted cell by cell."""
    config = PublishedRarity()
    acceleration, curvature = config.edges
    assert len(acceleration) == len(curvature) == 90
    assert (np.diff(acceleration) == 0).sum() == (np.diff(curvature) == 0).sum() == 2
    actions = np.concatenate([np.zeros((300, 2)), RNG.uniform(-1, 1, (200, 2)), [[1.0, 1.0], [-1.0, -1.0]]])
    values = actions * [6.0, 0.3]
    counts = np.zeros((89, 89))
    cells = []
    for a, k in values:
        i = max(i for i in range(89) if acceleration[i] <= a and acceleration[i + 1] > acceleration[i])
        j = max(j for j in range(89) if curvature[j] <= k and curvature[j + 1] > curvature[j])
        counts[i, j] += 1
        cells.append((i, j))
    weight = 1 / (counts + 1)
    expected = [weight[cell] / weight.mean() / 3 + 0.01 for cell in cells]
    scores = config.scores(config.histogram(actions), actions)
    np.testing.assert_allclose(scores, expected)
    assert scores.max() < 1.764 / 3 + 0.01  # the cap of 3 never binds


def test_expert_actions_and_their_mask():
    """Constant speed, constant acceleration of 2 m/s2 (a third of the bound), and a log that ends early."""
    time = (np.arange(91) - 10) * 0.1
    faster = car() | {
        "xy": np.stack([10.0 * time + time**2, np.zeros(91)], -1),
        "velocity": np.stack([10.0 + 2.0 * time, np.zeros(91)], -1),
    }
    bank = bank_of(
        straight_road([car(speed=10.0)]),
        straight_road([faster]),
        straight_road([car(speed=5.0, steps=range(30))]),
    )
    result = {name: np.asarray(part) for name, part in score_bank(ExpertActions(), bank).items()}
    np.testing.assert_allclose(result["action"][0, :89], 0.0, atol=1e-3)
    np.testing.assert_allclose(result["action"][1, :89], [[1 / 3, 0.0]] * 89, atol=2e-3)
    assert result["known"].sum(axis=1).tolist() == [89, 89, 28]
    steps = rarity_steps(KernelRarity(), result["action"], result["known"])
    assert (steps[result["known"]] > 0).all() and (steps[~result["known"]] == 0).all()
    assert steps[1, 20] > steps[0, 20]  # 89 steps against 117 without acceleration


@pytest.mark.parametrize("config", [KernelRarity(cells=64, temper=1.0), PublishedRarity(most=1.5)])
def test_a_histogram_scores_other_actions_after_it_was_read(config, tmp_path):
    known, other = np.ones((1, 40), bool), RNG.uniform(-1, 1, (1, 40, 2))
    histogram = config.histogram(RNG.normal(0.0, 0.2, (500, 2)))
    write_actions(config, histogram, "abc", tmp_path / "actions.npz")
    stored, read, set_hash = read_actions(type(config)(), tmp_path / "actions.npz")
    assert stored == config and read.counts.sum() == 500 and set_hash == "abc"
    np.testing.assert_array_equal(
        rarity_steps(stored, other, known, read), rarity_steps(config, other, known, histogram)
    )
    assert np.ptp(rarity_steps(stored, other, known, read) - rarity_steps(config, other, known)) > 0.01
    with pytest.raises(UsageError, match="exists"):
        write_actions(config, histogram, "abc", tmp_path / "actions.npz")
    wrong = KernelRarity() if isinstance(config, PublishedRarity) else PublishedRarity()
    with pytest.raises(DataError, match=r"is a histogram of action_rarity.*; use curate action_rarity"):
        read_actions(wrong, tmp_path / "actions.npz")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("counts", np.zeros((64, 64), np.int64)),
        ("counts", np.ones((64, 64))),
        ("counts", np.ones((3, 3), np.int64)),
        ("median", np.array(np.nan)),
        ("median", np.array(0.0)),
        ("acceleration_edges", np.linspace(0, 1, 65)),
        ("settings", np.array('{"method": "action_rarity", "set_hash": "abc", "cells": 100000000}')),
        ("settings", np.array('{"method": "action_rarity", "set_hash": "abc", "bandwidth": 1e9}')),
        ("settings", np.array('{"method": "mine", "set_hash": "abc"}')),
        ("settings", np.array("[1]")),
    ],
)
def test_damaged_histograms_are_refused(name, value, tmp_path):
    config = KernelRarity(cells=64)
    write_actions(config, config.histogram(np.zeros((3, 2))), "abc", tmp_path / "good.npz")
    arrays = dict(np.load(tmp_path / "good.npz")) | {name: value}
    np.savez(tmp_path / "bad.npz", **arrays)
    with pytest.raises(DataError, match=r"bad.npz.*; write it with"):
        read_actions(KernelRarity(), tmp_path / "bad.npz")


def test_invalid_arguments_are_refused():
    for name, wrong in (("bandwidth", 0.0), ("cells", 1), ("temper", 2.0), ("most", 0.5)):
        with pytest.raises(UsageError, match=name):
            replace(KernelRarity(), **{name: wrong})
    with pytest.raises(UsageError, match=r"most is 0\.0; use a positive number"):
        PublishedRarity(most=0.0)
    with pytest.raises(DataError, match="no log has three consecutive steps"):
        rarity_steps(KernelRarity(), np.zeros((1, 3, 2)), np.zeros((1, 3), bool))
