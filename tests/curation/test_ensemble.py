"""Ensemble: folds, disagreement and information by hand, and disagreement on rare data."""

import json
import math
import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from drivax.cli import main
from drivax.curation import ensemble as ensemble_module
from drivax.curation.ensemble import (
    EnsembleConfig,
    Predictions,
    _check_finite,
    assign_folds,
    experience_of,
    fit,
    load_ensemble,
    mutual_information,
    sample_recordings,
    save_ensemble,
    train_ensemble,
)
from drivax.curation.methods import check_combination, ensemble_table
from drivax.curation.rarity import KernelRarity
from drivax.curation.scores import read_scores
from drivax.errors import DataError, UsageError
from drivax.learning.algorithms.behaviour_cloning import BcConfig, BcState
from drivax.learning.driving import Driving
from drivax.learning.experience import sample_steps
from drivax.learning.training_log import DivergenceError
from drivax.networks.actor_critic import NetworkConfig
from drivax.networks.attention import EntityConfig
from drivax.networks.distributions import Grid, SquashedGaussian, SquashedMixture
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.scenario.store import ScenarioSet, ScenarioWriter
from drivax.simulator.simulator import Simulator
from drivax.tasks.actions import DeltaLocal, DirectState
from drivax.tasks.task import Task
from drivax.tracking.run_folder import RunFolder
from quick import quick
from scenes import SMALL, car, straight_road

NETWORK = NetworkConfig(encoder=EntityConfig(width=8), head=(8,), activation="relu")
TINY = EnsembleConfig(
    folds=3, cloning=BcConfig(network=NETWORK, batch=16, updates=4, learning_rate=3e-3), total_steps=2_000
)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Five recordings, two windows each."""
    path = tmp_path_factory.mktemp("ensemble") / "set"
    with ScenarioWriter(path, SMALL) as writer:
        for row in range(10):
            cars = [car(speed=8.0 + 0.2 * row), car(x=60.0, speed=8.0)]
            recording = straight_road(cars)
            recording = replace(recording, scenario_id=f"drive-{row}", segment=f"recording-{row // 2}")
            writer.add(assemble(recording, SMALL))
    return ScenarioSet.open(path)


@pytest.fixture(scope="module")
def ensemble(data):
    return train_ensemble(TINY, data)


@pytest.mark.slow
def test_divergence_is_one_line_and_writes_nothing(data, tmp_path, capsys):
    call = ["curate", "ensemble", "--data", str(data.path), "--out", str(tmp_path / "scores.npz")]
    call += ["--folds", "3", "--total_steps", "640", "--cloning.batch", "16", "--cloning.updates", "4"]
    call += ["--cloning.network.encoder.width", "8", "--cloning.network.head", "[8]"]
    assert main([*call, "--cloning.learning_rate", "1e30"]) == 1
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("drivax: ")]
    assert re.search(
        r"ensemble diverged at step 64: .* is (NaN|infinite) in member 0; lower cloning.learning_rate$", line
    )
    assert not list(tmp_path.iterdir())


def test_divergence_of_a_member_is_named():
    numbers = jnp.arange(3)
    state = BcState({"w": jnp.zeros((3, 2))}, (), jax.random.split(jax.random.key(0), 3), numbers)
    logs = {"loss/imitation": jnp.ones(3)}
    finite = jnp.ones(3, bool)
    _check_finite(64, state, logs, finite)
    with pytest.raises(DivergenceError, match="step 64: loss/imitation is infinite in member 1; lower"):
        _check_finite(64, state, {"loss/imitation": jnp.array([1.0, jnp.inf, 1.0])}, finite)
    with pytest.raises(DivergenceError, match=r"\.parameters\['w'\] is NaN in member 2; lower"):
        diverged = replace(state, parameters={"w": jnp.zeros((3, 2)).at[2, 1].set(jnp.nan)})
        _check_finite(64, diverged, logs, finite.at[2].set(False))


@pytest.mark.slow
def test_saved_ensemble_scores_as_the_trained_one_and_other_sets(data, ensemble, tmp_path, capsys):
    out = tmp_path / "members"
    save_ensemble(ensemble, out)
    with pytest.raises(UsageError, match="already exists"):
        save_ensemble(ensemble, out)
    loaded = load_ensemble(out, data)
    expected, table = ensemble_table(ensemble, data), ensemble_table(loaded, data)
    np.testing.assert_array_equal(table.steps, expected.steps)
    assert dict(table.config) == dict(expected.config)
    other = tmp_path / "other"
    with ScenarioWriter(other, SMALL) as writer:
        writer.add(assemble(straight_road([car(speed=4.0), car(x=30.0, speed=8.0)]), SMALL))
    call = ["curate", "ensemble", "--data", str(other), "--members", str(out)]
    scores = tmp_path / "scores.npz"
    assert main([*call, "--out", str(scores)]) == 0
    table = read_scores(scores, ScenarioSet.open(other))
    assert table.config["trained_on"] == data.hash and table.config["folds"] == 3
    assert main([*call, "--out", str(tmp_path / "x.npz"), "--folds", "4"]) == 2
    assert "members, which exists; leave out --folds 4" in capsys.readouterr().err
    assert main(["curate", "kinematic", "--data", str(other), "--members", str(out), "--out", "x.npz"]) == 2
    assert "leave out --members" in capsys.readouterr().err


def test_damaged_ensembles_are_refused(data, ensemble, tmp_path):
    save_ensemble(ensemble, out := tmp_path / "members")
    info = json.loads((out / "run.json").read_text())
    for change, words in (
        ({"deviation": [0.0, 1.0]}, "a deviation is missing"),
        ({"kind": "policy"}, "not ensemble"),
    ):
        RunFolder.open(out).note(**change)
        with pytest.raises(DataError, match=words):
            load_ensemble(out, data)
        RunFolder.open(out).note(**info)
    content = (out / "members.npz").read_bytes()
    (out / "members.npz").write_bytes(content[:-100])
    with pytest.raises(DataError, match=r"members\.npz"):
        load_ensemble(out, data)


def test_folds_never_share_a_recording():
    rng = np.random.default_rng(0)
    clusters = [f"recording-{number}" for number in rng.integers(0, 40, 300)]
    fold = assign_folds(clusters, 5, seed=1)
    assert {len(set(fold[np.array(clusters) == name])) for name in clusters} == {1}
    sizes = np.bincount([fold[clusters.index(name)] for name in sorted(set(clusters))])
    assert len(sizes) == 5 and np.ptp(sizes) <= 1
    assert (assign_folds(clusters, 5, seed=2) != fold).any()
    with pytest.raises(UsageError, match="4 recordings for 5 folds"):
        assign_folds(["a", "b", "c", "d", "d"], 5, seed=0)


def test_disagreement_is_relative_to_the_variance_of_the_expert():
    action = np.zeros((1, 2, 3, 2), np.float32)
    action[0, 1] = [[0.1, 0.0], [0.2, 0.0], [0.3, 0.3]]
    predictions = Predictions(action, np.zeros((1, 2, 2)), np.ones((1, 2), bool), None)
    values = predictions.disagreement(np.array([0.5, 0.1]))
    np.testing.assert_allclose(values[0, 0], 0.0)
    np.testing.assert_allclose(values[0, 1], [0.01 / 0.25, 0.03 / 0.01], rtol=1e-5)


def test_error_is_that_of_the_member_that_excluded_the_scenario():
    action = np.zeros((2, 1, 2, 1), np.float32)
    action[0, 0], action[1, 0] = [[0.4], [0.9]], [[0.1], [0.2]]
    predictions = Predictions(action, np.zeros((2, 1, 1)), np.ones((2, 1), bool), None)
    np.testing.assert_allclose(
        predictions.error(np.array([0.1]), np.array([0, 1]))[:, 0], [16.0, 4.0], rtol=1e-5
    )
    np.testing.assert_allclose(predictions.error(np.array([0.1]), None)[:, 0], [6.5**2, 1.5**2], rtol=1e-5)


def stacked(*distributions):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *distributions)


def test_information_of_grids_is_the_jensen_shannon_divergence():
    shares = np.random.default_rng(0).dirichlet(np.ones(6), size=3)
    levels = ((-1.0, 0.0, 1.0), (-0.5, 0.5))
    ensemble = stacked(*(Grid(jnp.log(jnp.asarray(row, jnp.float32)), levels) for row in shares))
    mean = shares.mean(axis=0)
    expected = np.mean([np.sum(row * np.log(row / mean)) for row in shares])
    values = quick(
        jax.vmap(mutual_information, (None, 0)), ensemble, jax.random.split(jax.random.key(0), 200)
    )
    assert values.mean() == pytest.approx(expected, abs=0.02)


def test_information_depends_on_modes_with_equal_means():
    """Two members with the same two modes have no mutual information; two members with one mode each have."""

    def two_modes(logit):
        parts = SquashedGaussian(jnp.array([[0.0, -1.0], [0.0, 1.0], [0.0, 0.0]]), jnp.full((3, 2), 0.05))
        return SquashedMixture(jnp.array([logit, -logit, -50.0]), parts)

    key = jax.random.key(0)
    same = stacked(two_modes(0.0), two_modes(0.0))
    assert float(mutual_information(same, key)) == pytest.approx(0.0, abs=1e-5)
    different = stacked(two_modes(50.0), two_modes(-50.0))
    assert float(mutual_information(different, key)) == pytest.approx(math.log(2))


@pytest.mark.slow
@pytest.mark.parametrize("weighted", ["plain", "rarity"])
def test_member_learns_from_all_folds_but_its_own(ensemble, data, weighted):
    """Changed expert actions of a fold do not affect its own member, but all others."""
    config = replace(TINY, weighted=weighted)
    environment, bank = Driving(Simulator(config.task)), ScenarioBank.from_scenarios(data)
    experience, _ = experience_of(config, environment, bank)
    learner = config.cloning.build(environment, bank, config.iterations)
    before = fit(config, learner, experience, ensemble.fold)
    for own in range(config.folds):
        action = jnp.where((ensemble.fold == own)[:, None, None], 0.9, experience.expert.action)
        altered = replace(experience, expert=replace(experience.expert, action=action))
        after = fit(config, learner, altered, ensemble.fold)
        same = jax.tree.map(lambda old, new: np.asarray(jax.vmap(jnp.array_equal)(old, new)), before, after)
        same = np.all(jax.tree.leaves(same), axis=0)
        assert same.tolist() == [member == own for member in range(config.folds)]


@pytest.mark.slow
def test_member_excludes_all_egos_of_its_fold(tmp_path):
    capacity = SMALL.with_egos(2)
    with ScenarioWriter(tmp_path / "set", capacity) as writer:
        for row in range(3):
            recording = straight_road([car(speed=8.0 + row), car(x=-20.0, speed=7.0 + row)])
            writer.add(assemble(replace(recording, scenario_id=str(row), segment=str(row)), capacity))
    data, config = ScenarioSet.open(tmp_path / "set"), replace(TINY, total_steps=640)
    trained = train_ensemble(config, data, egos="moving")
    environment, bank = trained.learner.environment, ScenarioBank.from_scenarios(data)
    experience, _ = experience_of(config, environment, bank)
    assert experience.usable.shape == (6, 91) and np.asarray(experience.usable).any(axis=1).all()
    (scenario,) = np.flatnonzero(trained.fold == 1)
    action = experience.expert.action.at[2 * scenario + 1].set(0.9)  # of the further ego
    altered = replace(experience, expert=replace(experience.expert, action=action))
    after = fit(config, trained.learner, altered, trained.fold)
    same = jax.tree.map(
        lambda old, new: np.asarray(jax.vmap(jnp.array_equal)(old, new)), trained.parameters, after
    )
    assert np.all(jax.tree.leaves(same), axis=0).tolist() == [False, True, False]
    table = ensemble_table(trained, data)
    assert table.egos == 2 and table.steps.shape == (6, 91) and table.scenarios.shape == (3,)
    predictions = trained.predictions(data)
    np.testing.assert_array_equal(predictions.known, experience.usable)
    unseen = np.arange(6) // 2 == scenario
    error = predictions.error(trained.deviation, np.where(unseen, 1, -1))
    expected = (predictions.action[unseen][:, :, 1] - predictions.expert[unseen]) / trained.deviation
    np.testing.assert_allclose(error[unseen], (expected**2).sum(axis=-1), rtol=1e-5)
    own = predictions.error(trained.deviation, np.repeat(trained.fold, 2))[predictions.known]
    by_hand = scipy.stats.spearmanr(table.steps[predictions.known], own).statistic
    assert table.config["error_rank_correlation"] == pytest.approx(by_hand)


@pytest.mark.slow
def test_stacked_and_sequential_updates_agree(ensemble, data):
    environment, bank = Driving(Simulator(TINY.task)), ScenarioBank.from_scenarios(data)
    experience, _ = experience_of(TINY, environment, bank)
    learner = TINY.cloning.build(environment, bank, TINY.iterations)
    one, other = (fit(TINY, learner, experience, ensemble.fold, batched=batched) for batched in (True, False))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4), one, other)


def test_sampled_recordings_are_whole():
    clusters = [f"recording-{number}" for number in np.random.default_rng(0).integers(0, 40, 300)]
    rows = sample_recordings(clusters, 100, seed=1)
    sampled = {clusters[row] for row in rows}
    assert rows.tolist() == [row for row, name in enumerate(clusters) if name in sampled]
    largest = max(clusters.count(name) for name in sampled)
    assert 100 <= len(rows) < 100 + largest
    assert sample_recordings(clusters, 100, seed=2).tolist() != rows.tolist()
    assert (
        len(sample_recordings(clusters, None, seed=1))
        == len(sample_recordings(clusters, 1_000, seed=1))
        == 300
    )


@pytest.mark.slow
def test_ensemble_trained_on_some_recordings_scores_all(data):
    trained = train_ensemble(replace(TINY, learn_from=6), data)
    assert sorted(np.bincount(trained.fold + 1)) == [2, 2, 2, 4]
    assert len({*np.flatnonzero(trained.fold < 0) // 2}) == 2  # two recordings of two windows
    table, predictions, unseen = ensemble_table(trained, data), trained.predictions(data), trained.fold < 0
    whole = predictions.disagreement(trained.deviation).sum(axis=-1)
    for rows, scale in zip((~unseen, unseen), table.config["scale"], strict=True):
        assert scale == pytest.approx(np.percentile(whole[rows], 99.0))
        np.testing.assert_allclose(table.steps[rows], whole[rows] / (whole[rows] + scale))
    known = predictions.known & unseen[:, None]
    error = predictions.error(trained.deviation, trained.fold)
    np.testing.assert_allclose(error[unseen], predictions.error(trained.deviation, None)[unseen])
    by_hand = scipy.stats.spearmanr(table.steps[known], error[known]).statistic
    assert table.config["error_rank_correlation"] == pytest.approx(by_hand)


def test_more_scenarios_than_fit_are_refused(data, monkeypatch):
    scenario_bytes = ScenarioBank.from_scenarios(list(data)).nbytes / 10
    monkeypatch.setattr(ensemble_module, "free_memory", lambda device: int(16.5 * scenario_bytes))
    with pytest.raises(UsageError, match=r"10 scenarios take .* GB, .* set learn_from to 4 to"):
        train_ensemble(TINY, data)
    with pytest.raises(UsageError, match="are free; free memory"):
        train_ensemble(replace(TINY, folds=5), data)


@pytest.mark.slow
def test_all_recordings_are_drawn(ensemble, data):
    environment, bank = Driving(Simulator(TINY.task)), ScenarioBank.from_scenarios(data)
    experience, _ = experience_of(TINY, environment, bank)
    rows, steps = sample_steps(experience.critic, jax.random.key(0), (30_000,))
    usable = np.asarray(experience.usable)
    assert usable[np.asarray(rows), np.asarray(steps)].all()
    shares = np.bincount(ensemble.fold[np.asarray(rows)]) / 30_000
    expected = [usable[ensemble.fold == own].sum() / usable.sum() for own in range(TINY.folds)]
    np.testing.assert_allclose(shares, expected, atol=0.01)


@pytest.mark.slow
def test_rare_actions_are_drawn_by_the_inverse_of_their_density(data):
    environment, bank = Driving(Simulator(TINY.task)), ScenarioBank.from_scenarios(data)
    experience, _ = experience_of(replace(TINY, weighted="rarity"), environment, bank)
    usable = np.asarray(experience.usable)
    action = np.asarray(experience.expert.action, np.float64)[usable]
    chance = np.diff(np.asarray(experience.critic.cumulative, np.float64), prepend=0.0).reshape(usable.shape)
    assert chance[usable].all() and not chance[~usable].any()
    kernel = KernelRarity()
    density = kernel.density(kernel.histogram(action), action)
    inverse = np.minimum(np.median(density) / density, kernel.most)
    np.testing.assert_allclose(chance[usable] / chance.sum(), inverse / inverse.sum(), rtol=1e-5)


@pytest.mark.slow
def test_predictions_cover_every_step(ensemble, data):
    assert ensemble.set_hash == data.hash
    predictions = ensemble.predictions(data)
    assert predictions.action.shape == (10, 91, 3, 2) and predictions.information is None
    assert np.ptp(predictions.action, axis=2).max() > 0.0
    assert sorted(np.bincount(ensemble.fold)) == [2, 4, 4]


@pytest.mark.slow
def test_members_disagree_on_rare_data(ensemble, tmp_path):
    """Scenarios similar to the training data, and others: rotated, fast, and enclosed by agents."""
    usual = [[car(speed=8.1 + 0.2 * row), car(x=60.0, speed=8.0)] for row in range(4)]
    strange = [
        [car(speed=25.0), car(x=12.0), car(x=-8.0, speed=25.0), car(y=3.7, speed=25.0)],
        [car(speed=0.0, y=1.8), car(x=6.0), car(x=-6.0), car(y=4.5)],
    ]
    with ScenarioWriter(tmp_path / "set", SMALL) as writer:
        for row, cars in enumerate(usual + strange):
            writer.add(assemble(replace(straight_road(cars), scenario_id=str(row), segment=str(row)), SMALL))
    predictions = ensemble.predictions(ScenarioSet.open(tmp_path / "set"))
    values = predictions.disagreement(ensemble.deviation).sum(axis=-1).mean(axis=1)
    assert values[4:].min() > 3.0 * values[:4].max()


@pytest.mark.slow
@pytest.mark.parametrize("weighted", ["plain", "rarity"])
def test_ensemble_scores_saturate_relative_to_the_99th_percentile(data, ensemble, weighted):
    trained = ensemble if weighted == "plain" else train_ensemble(replace(TINY, weighted="rarity"), data)
    table = ensemble_table(trained, data)
    assert table.method == "ensemble"
    assert sorted(table.components) == ["action_0", "action_1", "disagreement"]
    predictions = trained.predictions(data)
    whole = predictions.disagreement(trained.deviation).sum(axis=-1)
    # 0.5 at the 99th percentile, more beyond it, so the largest disagreements stay in order.
    expected = whole / (whole + np.percentile(whole, 99.0))
    np.testing.assert_allclose(table.steps, expected)
    action_0 = predictions.disagreement(trained.deviation)[..., 0]
    expected_0 = action_0 / (action_0 + np.percentile(whole, 99.0))
    np.testing.assert_allclose(table.components["action_0"], expected_0)
    assert np.unique(table.steps[expected > 0.5]).size > 5 and table.steps.max() < 1.0
    error = predictions.error(trained.deviation, trained.fold)[predictions.known]
    by_hand = scipy.stats.spearmanr(table.steps[predictions.known], error).statistic
    assert table.config["error_rank_correlation"] == pytest.approx(by_hand)
    assert table.config["trained_on"] == data.hash


@pytest.mark.slow
def test_command_trains_mixtures_by_likelihood(data, tmp_path, capsys):
    out = tmp_path / "scores.npz"
    arguments = ["curate", "ensemble", "--data", str(data.path), "--out", str(out), "--folds", "2"]
    arguments += ["--total_steps", "500", "--cloning.batch", "16", "--cloning.updates", "4"]
    arguments += ["--cloning.loss", "likelihood", "--cloning.network.distribution", "mixture"]
    arguments += ["--seed", "3"]
    assert main(arguments) == 0
    assert "rank correlation" in capsys.readouterr().out
    table = read_scores(out, data)
    assert list(table.components) == ["information"]
    assert table.config["cloning"]["network"]["distribution"] == "mixture"
    assert table.config["seed"] == 3


def test_every_dimension_of_the_action_is_a_component():
    config = EnsembleConfig(task=Task(actions=DeltaLocal()))
    check_combination("ensemble", config, {"weights": {"action_2": 1.0}})
    with pytest.raises(UsageError, match="unknown component 'action_3'"):
        check_combination("ensemble", config, {"weights": {"action_3": 1.0}})


def test_invalid_settings_are_refused(data, tmp_path, capsys):
    with pytest.raises(UsageError, match="1 folds"):
        EnsembleConfig(folds=1)
    with pytest.raises(UsageError, match="learn_from is 0"):
        EnsembleConfig(learn_from=0)
    with pytest.raises(UsageError, match="total_steps is 0; use 1 or more"):
        EnsembleConfig(total_steps=0)
    with pytest.raises(UsageError, match="seed is -1; use 0 or more"):
        EnsembleConfig(seed=-1)
    with pytest.raises(UsageError, match="policies cannot learn in direct_state"):
        EnsembleConfig(task=Task(actions=DirectState()))
    with pytest.raises(UsageError, match="rarity needs actions of two dimensions; use weighted: plain"):
        EnsembleConfig(weighted="rarity", task=Task(actions=DeltaLocal()))
    call = ["curate", "kinematic", "--data", str(data.path), "--out", str(tmp_path / "s.npz")]
    assert main([*call, "--folds", "3"]) == 2
    assert "folds: unknown setting; use one of urgent_s" in capsys.readouterr().err
    assert main([*call[:1], "uniform", *call[2:], "--folds", "3"]) == 2
    assert "unknown setting for uniform; leave out --folds 3" in capsys.readouterr().err
