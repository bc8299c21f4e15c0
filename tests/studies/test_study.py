"""The long-tail study: verdicts on results that are known, and the whole study on a few scenarios."""

import json
from dataclasses import replace

import numpy as np
import pytest

from drivax import settings
from drivax.cli import main
from drivax.curation.methods import Request, curate
from drivax.curation.scores import ScoreTable
from drivax.curation.weights import WeightConfig, draw_statistics, sampling_weights
from drivax.errors import DataError, UsageError
from drivax.evaluation.episode_table import EpisodeTable
from drivax.scenario.build.assemble import assemble
from drivax.scenario.recording import Event
from drivax.scenario.store import ScenarioSet, ScenarioWriter
from drivax.seal import seal
from drivax.stats.seeds import CrossedEffect
from drivax.stats.significance import holm_adjust
from drivax.studies import study as runner
from drivax.studies.definition import (
    Arm,
    Claim,
    Study,
    StudyConfig,
    StudyDefinition,
    StudySets,
    load_study,
)
from drivax.studies.verdicts import (
    Strata,
    ValidationCheck,
    compare_rankings,
    decide_claims,
    describe_sample_size,
    detectable_differences,
    rates,
    rates_of_groups,
    rule_cost,
)
from drivax.tracking.run_folder import RunFolder
from experiment_scripts import load_script
from scenes import SMALL, car, straight_road

LONGTAIL = load_study("longtail")
ARMS, METRICS = LONGTAIL.arms, LONGTAIL.metrics
SEEDS, SCENARIOS = 5, 400
TINY = [
    "--total_steps", "64", "--validations", "4", "--seeds", "2", "--progress", "1.5",
    "--arms", "[baseline, bc, heuristic, random_matched]",
    "--training", '["--algorithm.batch", "8", "--algorithm.updates", "1", "--algorithm.network.head", "[4]"]',
]  # fmt: skip


def draw_failures(rate_by_arm, rng):
    """Draw failures of every arm; accuracy is their absence, every other metric equals them."""
    episodes = {}
    for name, rate in rate_by_arm.items():
        seeds = np.clip(rate + 0.004 * rng.normal(size=(SEEDS, 1)), 0, 1)
        hit = (rng.random((SEEDS, SCENARIOS)) < seeds).astype(float)
        episodes[name] = dict.fromkeys(METRICS, hit) | {"accuracy": 1.0 - hit}
    return episodes


def verdicts(rate_by_arm, seed=0, rare_rates=None, share=None):
    """Return the results of the claims by their words; every second scenario is rare."""
    rng = np.random.default_rng(seed)
    labels = [f"recording-{number}" for number in range(SCENARIOS)]
    rare = np.arange(SCENARIOS) % 2 == 0
    episodes = draw_failures(rate_by_arm, rng)
    if rare_rates:
        rare_episodes = draw_failures(rare_rates, rng)
        episodes = {
            name: {
                metric: np.where(rare, rare_episodes[name][metric], values)
                for metric, values in by_metric.items()
            }
            for name, by_metric in episodes.items()
        }
    results = decide_claims(LONGTAIL.claims, episodes, Strata(labels, rare, share))
    return {result.claim.words: result for result in results}


EVEN = dict.fromkeys(ARMS, 0.16)
SIZE = "ensemble has 34% of the baseline's collisions or fewer"


@pytest.mark.slow
def test_equal_arms_rarely_support_a_claim():
    results = [result.verdict for seed in range(20) for result in verdicts(EVEN, seed).values()]
    assert results.count("supported") <= 0.01 * len(results)
    of_size = [verdicts(EVEN, seed)[SIZE].verdict for seed in range(20)]
    assert of_size.count("contradicted") >= 18


def test_effect_that_the_random_control_shares_is_not_credited():
    better = EVEN | {"ensemble": 0.02, "heuristic": 0.06, "random_matched": 0.06}
    results = verdicts(better)
    assert results["ensemble collides less than the baseline"].verdict == "supported"
    assert results["ensemble fails less than the baseline"].verdict == "supported"
    assert results["heuristic collides less than the baseline"].verdict == "supported"
    assert results["heuristic collides less than its matched random control"].verdict == "undecided"
    assert results[SIZE].verdict == "supported"
    low_high = results[SIZE].change
    assert low_high[1] < 0.02 / 0.16 - 1 < low_high[2] < -0.5


@pytest.mark.parametrize(("rate", "verdict"), [(0.06, "undecided"), (0.11, "contradicted")])
def test_a_claimed_size_is_tested_against_that_size(rate, verdict):
    """The claimed rate is 0.34 x 0.16 = 0.054: a claim of a size needs more than a reduction."""
    results = verdicts(EVEN | {"ensemble": rate})
    assert results["ensemble collides less than the baseline"].verdict == "supported"
    assert results[SIZE].verdict == verdict
    if verdict == "undecided":
        assert "would decide" in results[SIZE].needed


def by_speed(progress, rates_of, rng, seeds=SEEDS, scenarios=SCENARIOS):
    """Return values of an arm by speed: progress around a mean, and collisions at a rate."""
    episodes = {}
    for speed, mean in progress.items():
        hit = (rng.random((seeds, scenarios)) < rates_of[speed]).astype(float)
        episodes[speed] = {
            "collision": hit, "progress_ratio": mean + 0.2 * rng.normal(size=(seeds, scenarios))
        }  # fmt: skip
    return episodes


def decide_at_equal_progress(arm, reference, **options):
    """Return the result of a claim at equal progress in all scenarios."""
    claim = Claim("arm collides less", "arm", "reference", "group", at_equal_progress=True, **options)
    every, count = {"arm": arm, "reference": reference}, arm[1.0]["collision"].shape[1]
    (result,) = decide_claims(
        [claim],
        {name: episodes[1.0] for name, episodes in every.items()},
        Strata([f"r{row}" for row in range(count)], np.zeros(count, bool)),
        {name: {k: v for k, v in episodes.items() if k < 1.0} for name, episodes in every.items()},
    )
    return result


def test_slower_driving_is_not_credited_at_equal_progress():
    """The arm collides a third less, as the reference does at its progress of 0.85, between speeds 0.9 and 0.7."""
    rng = np.random.default_rng(0)
    reference = by_speed({1.0: 1.0, 0.9: 0.9, 0.7: 0.7}, {1.0: 0.45, 0.9: 0.36, 0.7: 0.24}, rng)
    arm = by_speed({1.0: 0.85, 0.9: 0.77, 0.7: 0.6}, {1.0: 0.33, 0.9: 0.3, 0.7: 0.25}, rng)
    result = decide_at_equal_progress(arm, reference)
    assert result.verdict == "undecided" and result.slower_arm == ("reference", pytest.approx(0.85, abs=0.01))
    mean = {speed: [values[name].mean() for name in ("progress_ratio", "collision")]
        for speed, values in reference.items()}  # fmt: skip
    target = arm[1.0]["progress_ratio"].mean()
    interpolated = np.interp(target, *zip(mean[0.7], mean[0.9], strict=True))
    expected = arm[1.0]["collision"].mean() - interpolated
    assert result.difference.difference == pytest.approx(expected, abs=1e-9)
    # The other way round, the arm gets further and is slowed.
    back = decide_at_equal_progress(reference, arm)
    assert back.slower_arm == ("arm", pytest.approx(result.slower_arm[1]))
    assert back.difference.difference == pytest.approx(-expected, abs=1e-9)
    # Without the control, the arm seems better.
    plain = replace(result.claim, at_equal_progress=False)
    strata = Strata([f"r{row}" for row in range(SCENARIOS)], np.zeros(SCENARIOS, bool))
    (uncontrolled,) = decide_claims([plain], {"arm": arm[1.0], "reference": reference[1.0]}, strata)
    assert uncontrolled.verdict == "supported"


def test_intervals_at_equal_progress_cover_the_true_difference():
    """The true difference is 0, wherever between the two speeds the arm's progress lies."""
    rng, covered, errors, estimates = np.random.default_rng(1), 0, [], []
    for turn in range(100):
        target = 0.85 + 0.1 * (turn % 10) / 9
        reference = by_speed({1.0: 1.0, 0.8: 0.8}, {1.0: 0.5, 0.8: 0.15}, rng, 5, 100)
        rate = 0.15 + (target - 0.8) / 0.2 * 0.35
        arm = by_speed({1.0: target, 0.8: 0.6}, {1.0: rate, 0.8: 0.1}, rng, 5, 100)
        effect = decide_at_equal_progress(arm, reference).difference
        low, high = effect.interval()
        covered += low <= 0.0 <= high
        errors.append(effect.standard_error)
        estimates.append(effect.difference)
    # 95 are expected; a variance at least as large as that of seeds or scenarios alone covers more.
    assert covered >= 91
    assert 0.9 * np.std(estimates) < np.mean(errors) < 1.4 * np.std(estimates)


def test_a_claim_at_equal_progress_needs_a_speed_that_is_low_enough():
    rng = np.random.default_rng(2)
    fast = by_speed({1.0: 1.0, 0.9: 0.9}, {1.0: 0.4, 0.9: 0.4}, rng)
    slow = by_speed({1.0: 0.5, 0.9: 0.4}, {1.0: 0.2, 0.9: 0.2}, rng)
    result = decide_at_equal_progress(slow, fast)
    assert (result.verdict, result.effect) == ("undecided", None)
    assert result.needed == "reference makes more progress even at its lowest speed"


@pytest.mark.parametrize("defined", [0, 1])
def test_undefined_progress_leaves_a_claim_undecided(defined):
    rng = np.random.default_rng(3)
    arms = [by_speed({1.0: 1.0, 0.9: 0.9}, {1.0: 0.4, 0.9: 0.3}, rng) for _ in range(2)]
    for values in (values for arm in arms for values in arm.values()):
        values["progress_ratio"][:, defined:] = np.nan
    result = decide_at_equal_progress(*arms)
    assert (result.verdict, result.effect, result.needed) == (
        "undecided", None, "fewer than two recordings define it"
    )  # fmt: skip


def test_a_margin_cannot_be_compared_with_nothing():
    """Two arms without any failure: their difference has no error, but may be larger than the margin."""
    claim = Claim("arm is not worse", "arm", "reference", "group", margin=0.01)
    episodes = {name: {"collision": np.zeros((2, 40))} for name in ("arm", "reference")}
    (result,) = decide_claims([claim], episodes, Strata(list(map(str, range(40))), np.zeros(40, bool)))
    assert result.verdict == "undecided" and result.needed.startswith("nothing varies")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"limiters": (1.2,)}, "use different numbers between 0 and 1"),
        ({"limiters": (0.5, 0.5)}, "use different numbers between 0 and 1"),
        ({"limiters": (0.1234567, 0.1234568)}, "two evaluations would have the same name"),
        ({"claims": (Claim("x", "bc", "baseline", "control", at_equal_progress=True),)}, "need limiters"),
    ],
)
def test_limiters_that_fit_no_evaluation_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        replace(LONGTAIL, **change)
    with pytest.raises(ValueError, match="use a positive number"):
        Claim("x", "bc", "baseline", "control", margin=-0.1)


def test_screening_has_every_algorithm_with_every_sampler():
    arms = load_study("longtail2_screening").arms
    assert len(arms) == 41 and {arm.preset for arm in arms.values()} == {
        f"mixed/{name}" for name in ("bc", "filtered_bc", "td3_bc", "cql", "cql_bc")
    }  # fmt: skip


def test_second_stage_has_six_claims_about_arms_of_the_screening():
    """Presets, methods and scales are those of the screening; at events claims are at equal progress."""
    second, screening = load_study("longtail2"), load_study("longtail2_screening")
    assert len(second.claims) == 6 and {claim.group for claim in second.claims} == {"claims"}
    assert all(claim.at_equal_progress == (claim.rows == "rare") for claim in second.claims)
    assert second.claims[0].metric == "at_fault_collision" and second.claims[-1].margin == 0.02
    screened = [replace(arm, weights=None) for arm in screening.arms.values()]
    assert all(replace(arm, weights=None) in screened for arm in second.arms.values())


def test_strong_weights_have_the_effective_sample_that_the_page_gives():
    """Of 2,000 scenarios with different scores; the default weights have 0.66."""
    scores = np.random.default_rng(0).permutation(2000) / 2000.0
    steps = np.repeat(scores[:, None], 2, axis=1)
    ids = tuple(map(str, range(2000)))
    table = ScoreTable("kinematic", {}, "hash", ids, np.ones(steps.shape, bool), steps, scores, {})
    strong = load_study("longtail2").arms["td3_bc_heuristic_strong"].weights
    for weights, expected in ((strong, 0.35), (WeightConfig(), 0.66)):
        drawn = draw_statistics(sampling_weights(table, weights, "scenario"), table.drawable)
        assert drawn.effective == pytest.approx(expected, abs=0.005)


def test_rates_by_kind_and_severity_of_events(data):
    kinds = {
        "cut_in": np.array([True, True, False, False]),
        "jaywalker": np.array([False, False, True, False]),
    }
    values = {"collision": np.array([[0.0, 1.0, 1.0, 0.0], [1.0, 1.0, 0.0, 0.0]])}
    strata = Strata(list("abcd"), np.ones(4, bool))
    by_kind = rates_of_groups(values, strata, kinds, "collision")
    assert list(by_kind) == ["cut_in"]  # the other kind has one recording
    assert by_kind["cut_in"]["mean"] == 0.75 and by_kind["cut_in"]["scenarios"] == 2
    events = [{"event": "cut_in", "severity_mps2": "2.0"}, {"event": "jaywalker", "severity_mps2": "4.0"}, {}]
    groups = runner.event_groups([{"tags": tags} for tags in events])
    assert {name: mask.tolist() for name, mask in groups.items()} == {
        "cut_in": [True, False, False], "jaywalker": [False, True, False],
        "below 3 m/s2": [True, False, False], "from 3 m/s2": [False, True, False],
    }  # fmt: skip


@pytest.mark.parametrize(
    ("metric", "rate", "verdict"),
    [("collision", 0.2, "supported"), ("collision", 0.3, "contradicted"), ("accuracy", 0.2, "supported")],
)
def test_a_margin_bounds_how_much_worse_an_arm_may_be(metric, rate, verdict):
    """Equal arms are not worse by 0.04, one that collides 0.1 more is."""
    claim = Claim("arm is not worse", "arm", "reference", "group", metric, margin=0.04)
    episodes = draw_failures({"arm": rate, "reference": 0.2}, np.random.default_rng(0))
    strata = Strata([f"r{row}" for row in range(SCENARIOS)], np.zeros(SCENARIOS, bool))
    (result,) = decide_claims([claim], episodes, strata)
    assert result.verdict == verdict
    shift = result.effect.difference - result.difference.difference
    assert shift == pytest.approx(-0.04 if metric == "collision" else 0.04)


def test_rare_scenarios_count_as_in_ordinary_traffic():
    """Half of the test scenarios are rare: an arm that is better only in these is worse in ordinary traffic."""
    common, rare = dict.fromkeys(ARMS, 0.02), dict.fromkeys(ARMS, 0.40)
    worse = common | {"ensemble": 0.10}, rare | {"ensemble": 0.18}
    words = "ensemble collides less than the baseline"
    assert verdicts(worse[0], 0, worse[1])[words].verdict == "supported"
    results = verdicts(worse[0], 0, worse[1], share=0.05)
    assert results[words].verdict == "contradicted"
    assert results[words].difference.difference == pytest.approx(0.95 * 0.08 - 0.05 * 0.22, abs=0.02)
    assert results[f"{words} in rare scenarios"].verdict == "supported"
    assert results[f"{words} in common scenarios"].verdict == "contradicted"


def test_an_effect_of_the_other_sign_contradicts():
    result = verdicts(EVEN | {"action_rarity": 0.3})["action_rarity collides less than the baseline"]
    assert result.verdict == "contradicted" and result.effect.difference > 0.1
    assert result.adjusted_p >= result.effect.p


def test_p_values_are_adjusted_within_their_group():
    results = list(verdicts(EVEN | {"heuristic": 0.14}).values())
    for group in {result.claim.group for result in results}:
        members = [result for result in results if result.claim.group == group]
        ps = [result.effect.p for result in members]
        assert [result.adjusted_p for result in members] == holm_adjust(ps)
    claimed = [(c.arm, c.reference, c.metric, c.rows, c.change) for c in LONGTAIL.claims]
    assert len(claimed) == len(set(claimed)) == 54


def test_claims_without_a_test_do_not_raise_the_number_that_decides():
    claim, rng = LONGTAIL.claims[0], np.random.default_rng(0)
    episodes = draw_failures({claim.arm: 0.14, claim.reference: 0.16}, rng)
    undefined = next(name for name in METRICS if name != claim.metric)
    episodes[claim.arm][undefined] = np.full((SEEDS, SCENARIOS), np.nan)
    strata = Strata([str(number) for number in range(SCENARIOS)], np.arange(SCENARIOS) % 2 == 0, None)
    (alone,) = decide_claims([claim], episodes, strata)
    among, untested = decide_claims([claim, replace(claim, metric=undefined)], episodes, strata)
    assert untested.effect is None and alone.verdict == "undecided"
    assert among.needed == alone.needed and "would decide" in alone.needed


def test_undecided_claims_name_the_seeds_or_recordings_that_would_decide():
    few = CrossedEffect(0.02, (4e-5, 4e-5), 1e-5, (5, 5), 400)
    seeds = int(describe_sample_size(few, 1).split()[0])
    assert 10 <= seeds <= 13  # by a normal distribution 4e-4 / ((0.02 / 2.8016)^2 - 1e-5) = 9.77
    assert int(describe_sample_size(few, 20).split()[0]) > seeds
    assert describe_sample_size(replace(few, difference=1e-6), 1).startswith("neither seeds nor recordings")
    assert "test recordings" in describe_sample_size(CrossedEffect(0.02, (1e-6, 1e-6), 9e-5, (5, 5), 400), 1)


def test_detectable_differences_follow_from_the_baselines():
    """From the variation of the first baseline's seeds, at a stricter level if more claims are tested."""
    rng = np.random.default_rng(1)
    episodes = draw_failures({"baseline": 0.16, "bc": 0.3}, rng)
    strata = Strata(list(map(str, range(SCENARIOS))), np.arange(SCENARIOS) < 40, 0.05)
    baseline, bc = episodes["baseline"], episodes["bc"]
    smallest, stricter = (detectable_differences(baseline, bc, strata, METRICS, claims) for claims in (1, 9))
    assert sorted(smallest) == sorted(METRICS)
    assert 0.02 < smallest["collision"] < stricter["collision"] < 0.2
    undefined = baseline | {"vmax_score": np.full((SEEDS, SCENARIOS), np.nan)}
    assert "vmax_score" not in detectable_differences(undefined, bc, strata, METRICS, 1)


def test_rule_cost_is_paired_by_seed_and_scenario():
    rng = np.random.default_rng(2)
    best = draw_failures({"baseline": 0.16}, rng)["baseline"]
    strata = Strata(list(map(str, range(SCENARIOS))), np.zeros(SCENARIOS, bool))
    same = rule_cost(best, best, strata, METRICS)
    assert same["collision"] == {"difference": 0.0, "interval": [0.0, 0.0]}
    hit = best["collision"] + (rng.random((SEEDS, SCENARIOS)) < 0.03) * (1 - best["collision"])
    results = rule_cost(best | {"collision": hit}, best, strata, METRICS)
    assert 0.0 < results["collision"]["interval"][0] < results["collision"]["difference"] < 0.05


def test_controls_have_the_effective_sizes_of_their_arms(data):
    """Over steps and over scenarios, for scores of which some vary more between scenarios, and for labels."""
    rng, shape = np.random.default_rng(0), (600, 91)
    tables = {}
    for place, method in enumerate(("kinematic", "action_rarity", "ensemble", "oracle", "uniform")):
        slow = np.cumsum(rng.normal(size=shape), axis=1) + 6 * (place + 1) * rng.normal(size=(shape[0], 1))
        steps = 1 / (1 + np.exp(-slow / 10))
        if method == "oracle":
            steps = ((rng.random((shape[0], 1)) < 0.1) & (np.arange(shape[1]) // 20 == 2)).astype(float)
        elif method == "uniform":
            steps = np.ones(shape)
        ids = tuple(map(str, range(shape[0])))
        tables[method] = ScoreTable(method, {}, "x", ids, np.ones(shape, bool), steps, steps.max(axis=1))
    usable = np.zeros(shape, bool)
    usable[:, 10:89] = rng.random((shape[0], 79)) < 0.95
    pairs = {(c.arm, c.reference) for c in LONGTAIL.claims if ARMS[c.reference].permuted}
    curated = [name for name in ARMS if name.startswith(("heuristic", "ensemble", "action_rarity"))]
    assert {arm for arm, _ in pairs} == {*curated, "oracle"}
    for pair in pairs:
        own, control = (
            draw_statistics(
                ARMS[name].weigh(data, tables.__getitem__, WeightConfig(), usable, seed=3),
                usable,
            )
            for name in pair
        )
        assert control.effective == pytest.approx(own.effective, rel=0.02), pair
        assert control.effective_scenarios == pytest.approx(own.effective_scenarios, rel=0.06), pair
    for name, share in (("oracle", 0.115), ("oracle_strong", 0.3)):
        weights = ARMS[name].weigh(data, tables.__getitem__, WeightConfig(), usable)
        during = weights[tables["oracle"].steps > 0].sum() / weights.sum()
        # Uniform draws also hit events.
        assert during == pytest.approx(share + (1 - share) * (tables["oracle"].steps > 0)[usable].mean())
    assert len(curated) == 6 and {ARMS[name].scale for name in curated} == {"step", "scenario"}


def test_scores_of_another_method_are_refused(data):
    table = curate("uniform", Request(data))
    with pytest.raises(UsageError, match="scores of 'uniform' for an arm with the method 'action_rarity'"):
        ARMS["action_rarity"].weigh(data, lambda _: table, WeightConfig())


def test_checks_read_the_best_checkpoint_and_the_last_validations():
    rising = {"score": [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8], "progress": [0.0] * 7 + [0.95]}
    flat = {"score": [0.1, 0.5, 0.8, 0.8, 0.81, 0.8, 0.8, 0.8], "progress": [0.0] * 4 + [0.9] + [0.0] * 3}
    check = ValidationCheck.of("bc", [rising], 0.8, 0.03)
    assert check.change == pytest.approx(0.2) and check.progress == 0.95 and not check.met
    assert ValidationCheck.of("bc", [flat], 0.8, 0.03).met
    assert not ValidationCheck.of("bc", [flat], 0.91, 0.03).met
    # Of equal scores, the latest is that of the best checkpoint.
    equal = {"score": [0.8] * 8, "progress": [0.0] * 7 + [0.9]}
    assert ValidationCheck.of("bc", [equal], 0.8, 0.03).progress == 0.9


def test_seeds_do_not_make_up_for_each_other():
    """Opposite changes of two seeds do not cancel, and four good seeds do not outweigh a bad one."""
    up = {"score": [0.5] * 6 + [0.7, 0.7], "progress": [0.9] * 8}
    down = {"score": [0.7] * 6 + [0.5, 0.5], "progress": [0.9] * 8}
    flat = {"score": [0.7] * 8, "progress": [0.9] * 8}
    check = ValidationCheck.of("bc", [up, down], 0.8, 0.03)
    assert check.change == pytest.approx(0.0) and check.moved == pytest.approx(0.2) and not check.met
    check = ValidationCheck.of("bc", [flat] * 4 + [flat | {"progress": [0.5] * 8}], 0.8, 0.03)
    assert check.progress > 0.8 and check.least == 0.5 and not check.met


def test_rankings_and_rates(data):
    kinematic, labels = curate("kinematic", Request(data)), [f"r{row}" for row in range(len(data))]
    (same,) = compare_rankings({"kinematic": kinematic, "published": kinematic, "uniform": kinematic}, labels)
    assert (same["methods"], same["orthogonal"]) == (["kinematic", "published"], "contradicted")
    np.testing.assert_allclose([same["rho"], *same["interval"], same["overlap"]], 1.0)
    rng = np.random.default_rng(5)
    shape = (2_000, 91)
    scores = {name: rng.random(shape) for name in ("a", "b")} | {"c": np.zeros(shape)}
    scores["c"] = (scores["a"] + 3 * rng.random(shape)) / 4
    ids = tuple(map(str, range(2_000)))
    tables = {
        name: ScoreTable(name, {}, "x", ids, np.ones(shape, bool), steps, steps[:, 0])
        for name, steps in scores.items()
    }
    verdict = {tuple(r["methods"]): r["orthogonal"] for r in compare_rankings(tables, ids)}
    # Correlations of 0 and, within one standard error of the limit, of about 0.3.
    assert verdict == {("a", "b"): "supported", ("a", "c"): "undecided", ("b", "c"): "supported"}
    rng = np.random.default_rng(0)
    results = rates(
        draw_failures({"bc": 0.2}, rng)["bc"],
        Strata(list(map(str, range(SCENARIOS))), np.zeros(SCENARIOS, bool)),
        METRICS,
    )
    assert sorted(results) == ["common", "ordinary"] and results["ordinary"]["collision"]["low"] < 0.2
    none = dict.fromkeys(METRICS, np.zeros((SEEDS, 100))) | {"vmax_score": np.full((SEEDS, 100), np.nan)}
    results = rates(none, Strata(list(map(str, range(100))), np.arange(100) < 50, 0.05), METRICS)
    # Wilson: 3.84 / (n + 3.84), where n = 1 / (0.95^2 / 50 + 0.05^2 / 50) = 55.2.
    assert results["ordinary"]["collision"] == {
        "mean": 0.0, "low": 0.0, "high": pytest.approx(0.065, abs=1e-4), "scenarios": 100
    }  # fmt: skip
    assert "vmax_score" not in results["rare"]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Six scenarios with the data set name of the built-in world, two with an event."""
    path = tmp_path_factory.mktemp("longtail") / "set"
    with ScenarioWriter(path, SMALL) as writer:
        for row in range(6):
            cars = [car(speed=8.0 + row), car(x=30.0 + row, speed=8.0)]
            events = (Event(3, 8, 30, (101,)),) if row < 2 else ()
            recording = replace(
                straight_road(cars),
                scenario_id=f"drive-{row}",
                segment=f"r{row}",
                dataset="drivax",
                events=events,
            )
            writer.add(assemble(recording, SMALL))
    return ScenarioSet.open(path)


@pytest.fixture
def in_process(monkeypatch):
    """Train in this process: a new one takes half a minute to start and compile."""

    def one_by_one(call, tasks, cores):
        return [(task, call(task)) for task in tasks]

    monkeypatch.setattr(runner, "one_core_each", one_by_one)


def write_sealed(file, content):
    """Replace a sealed JSON file by another one that drivax could have written."""
    file.write_text(json.dumps(content))
    seal(file.parent, file.name)


@pytest.mark.slow
def test_the_whole_study(data, tmp_path, in_process, capsys, monkeypatch):
    out = tmp_path / "study"
    sets = ["--data", str(data.path), "--validation", str(data.path), "--test", str(data.path)]
    arguments = ["study", "longtail", *sets, "--out", str(out), *TINY]
    assert main(arguments) == 2
    assert "does not drive well enough" in capsys.readouterr().err
    assert main([*arguments, "--anyway"]) == 0
    output = capsys.readouterr()
    assert "undecided" in output.out and "trained and evaluated random_matched, seed 1" in output.err
    results = json.loads((out / "results.json").read_text())
    assert (results["about"]["test"], results["about"]["rare"]) == (6, 2)
    assert list(results["rates"]) == ["expert", "constant_speed", "idm", "pdm", *results["draws"]]
    assert list(results["draws"]) == ["baseline", "bc", "heuristic", "random_matched"]
    assert results["draws"]["bc"]["effective"] == 1.0
    page = (out / "report.html").read_text()
    assert "The conditions of the comparison are not met" in page and "http://" not in page
    assert (out / "critical.html").is_file()
    # A finished study trains and evaluates nothing again.
    assert main([*arguments, "--anyway"]) == 0
    again = capsys.readouterr().err
    assert "trained" not in again and "evaluating" not in again
    # An edited evaluation is refused, or named by the results and the page.
    episodes = out / "evaluations" / "heuristic" / "seed-0" / "episodes.csv"
    text = episodes.read_text()
    rows = [line.split(",") for line in text.splitlines(keepends=True)]
    rows[1][rows[0].index("ade")] = "1.5"
    episodes.write_text("".join(map(",".join, rows)))
    assert main([*arguments, "--anyway"]) == 1
    assert f"{episodes}: changed since drivax wrote it" in capsys.readouterr().err
    assert main([*arguments, "--anyway", "--edited"]) == 0
    assert capsys.readouterr().err.endswith(f"drivax: made with edited files: {episodes}\n")
    assert json.loads((out / "results.json").read_text())["edited"] == [str(episodes)]
    assert f"edited after drivax wrote them:</b> {episodes}" in (out / "report.html").read_text()
    episodes.write_text(text)
    assert main([*arguments, "--anyway"]) == 0
    assert "edited files" not in capsys.readouterr().err
    assert json.loads((out / "results.json").read_text()) == results
    # A study that is restored from its stored files trains nothing, either.
    script = load_script("longtail")
    monkeypatch.setattr(script, "KEPT", tmp_path / "kept")
    script.keep(out)
    script.restore(tmp_path / "restored")
    assert not list((tmp_path / "restored").rglob("checkpoints"))
    restored = [file for file in (tmp_path / "restored").rglob("*") if file.is_file()]
    scores = {file.name for file in restored if file.suffix == ".npz"}
    assert scores == {file.name for file in (out / "scores").iterdir()} >= {"kinematic.npz"}
    kept = [file for file in restored if file.suffix != ".npz"]
    assert {file.name for file in kept} == {
        "config.yaml", "run.json", "metrics.jsonl", "episodes.csv", "summary.json", "seal.json"
    }  # fmt: skip
    for file in kept:
        assert str(tmp_path.parent) not in file.read_text(), file
    arguments[arguments.index(str(out))] = str(tmp_path / "restored")
    assert main([*arguments, "--anyway"]) == 0
    again = capsys.readouterr().err
    assert "trained" not in again and "evaluating" not in again
    script.keep(tmp_path / "restored")  # a restored study can be stored again
    again = json.loads((tmp_path / "restored" / "results.json").read_text())
    assert again == results
    arguments[arguments.index(str(tmp_path / "restored"))] = str(out)
    blocks = [f"claims {group}" for group in LONGTAIL.groups]
    blocks += ["conditions", "detectable", "draws", "rankings", "rule cost", "validations"]
    blocks += [f"rates {kind}" for kind in ("ordinary", "common", "rare")]
    page = script.fill_page("".join(f"{script.BEGIN.format(b)}\n{script.END}\n" for b in blocks), results)
    assert script.fill_page(page, results) == page and page.count("|---") >= len(blocks)
    assert "heuristic collides less than its matched random control" in page
    # Runs with other weights, and evaluations older than their run, are refused.
    run = out / "runs" / "heuristic" / "seed-0" / "run.json"
    info, evaluation = json.loads(run.read_text()), out / "evaluations" / "heuristic" / "seed-0" / "run.json"
    write_sealed(run, info | {"weights": "0" * 64})
    assert main([*arguments, "--anyway"]) == 2
    assert "was trained with other settings, weights or episodes" in capsys.readouterr().err
    write_sealed(run, info)
    tested = json.loads(evaluation.read_text())
    write_sealed(evaluation, tested | {"data": [tested["data"][0] | {"hash": "0" * 64}]})
    assert main([*arguments, "--anyway"]) == 2
    assert "is of another test set" in capsys.readouterr().err
    write_sealed(evaluation, tested)
    old = json.loads(evaluation.read_text()) | {"started": "2020-01-01T00:00:00+00:00"}
    write_sealed(evaluation, old)
    assert main([*arguments, "--anyway"]) == 2
    assert "is older than the run that it evaluates" in capsys.readouterr().err
    assert main([*arguments, "--anyway", "--rare", "0.3"]) == 2
    assert "contains a study with other settings" in capsys.readouterr().err


RECORDED = """
title: Recorded
baselines: [td3_bc, bc]
planners: [idm]
metrics: [collision, progress_ratio]
checkpoints_by: validation/mean_q
limiters: [0.9, 0.4]
groups: {first: First}
arms:
  bc: {preset: offline/bc}
  td3_bc: {preset: offline/td3_bc}
claims:
  - {words: td3_bc collides less, arm: td3_bc, reference: bc, group: first, at_equal_progress: true}
  - {words: td3_bc does not collide more, arm: td3_bc, reference: bc, group: first, margin: 0.1}
"""


def test_a_set_of_one_recording_needs_a_validation_set(tmp_path, capsys):
    with ScenarioWriter(tmp_path / "set", SMALL) as writer:
        writer.add(assemble(straight_road([car(), car(x=30.0, speed=8.0)]), SMALL))
    file, data = tmp_path / "own.yaml", str(tmp_path / "set")
    file.write_text(RECORDED)
    call = ["study", str(file), "--data", data, "--test", data, "--episodes", str(tmp_path / "none")]
    assert main([*call, "--out", str(tmp_path / "study")]) == 2
    assert "all scenarios are of one recording, so none can be held out; pass" in capsys.readouterr().err
    assert not (tmp_path / "study").exists()


@pytest.mark.slow
def test_a_study_on_recorded_episodes(data, tmp_path, in_process, capsys):
    record = [
        "record",
        "idm",
        "constant_speed",
        "--data",
        str(data.path),
        "--out",
        str(tmp_path / "episodes"),
    ]
    assert main(record) == 0
    file, out = tmp_path / "recorded.yaml", tmp_path / "study"
    file.write_text(RECORDED)
    sets = ["--data", str(data.path), "--test", str(data.path), "--out", str(out)]
    settings = [word for word in TINY if word not in ("--arms", TINY[TINY.index("--arms") + 1])]
    arguments = ["study", str(file), *sets, *settings, "--anyway"]
    assert main(arguments) == 2
    assert "no validation or test set" in capsys.readouterr().err
    arguments += ["--episodes", str(tmp_path / "episodes")]
    assert main(arguments) == 0
    names = sorted(path.name for path in (out / "evaluations").iterdir())
    arms = [f"{arm}{speed}" for arm in ("bc", "td3_bc") for speed in ("", "_at_0.4", "_at_0.9")]
    assert names == sorted([*arms, "idm", "td3_bc_by_mean_q"])
    slow = EpisodeTable.read(out / "evaluations" / "bc_at_0.4" / "seed-0")
    assert slow.planner.startswith("seed-0 (limit x 0.4)")
    results = json.loads((out / "results.json").read_text())
    equal, margin = results["claims"]
    slower, share = equal["slower_arm"]
    assert slower in ("bc", "td3_bc") and 0.4 <= share <= 1.0
    assert margin["slower_arm"] is None and margin["claim"]["margin"] == 0.1
    assert results["rates"]["bc_at_0.4"]["common"]["progress_ratio"]["mean"] < 0.9
    # One held-out scenario has no spread of returns to compare Q with.
    assert results["critics"] == {"bc": [None, None], "td3_bc": [None, None]}
    run = RunFolder.open(out / "runs" / "bc" / "seed-0").info
    assert run["recorded_episodes"] and run["validation"]["recordings"]
    capsys.readouterr()
    assert main(arguments) == 0
    assert "trained" not in capsys.readouterr().err
    assert main([*record[:2], *record[3:-1], str(tmp_path / "fewer")]) == 0
    assert main([*arguments[:-1], str(tmp_path / "fewer")]) == 2
    assert "other settings, weights or episodes" in capsys.readouterr().err


def test_no_file_shadows_a_study(tmp_path, monkeypatch):
    (tmp_path / "studies").mkdir()
    for name in ("longtail", "studies/longtail", "studies/own"):
        (tmp_path / name).write_text("title: 5")
    monkeypatch.chdir(tmp_path)
    load_study.cache_clear()
    assert load_study("longtail") == LONGTAIL
    with pytest.raises(UsageError, match="no preset 'studies/own'"):
        load_study("own")
    for path in ("./longtail", "studies/own"):
        with pytest.raises(UsageError, match=rf"^{path.removeprefix('./')}: title: 5 is not text"):
            load_study(path)


def test_invalid_studies_are_refused(data, tmp_path):
    sets = StudySets(data.path, data.path, (data.path,))
    with pytest.raises(UsageError, match="baseline 'bc' is missing"):
        Study(LONGTAIL, StudyConfig(arms=("baseline",)), sets, tmp_path)
    with pytest.raises(UsageError, match="unknown arm 'heuristics'"):
        Study(LONGTAIL, StudyConfig(arms=("baseline", "bc", "heuristics")), sets, tmp_path)
    with pytest.raises(UsageError, match=r"no preset or file 'studies/longtial'.*longtail"):
        load_study("longtial")
    own = tmp_path / "own.yaml"
    own.write_text(settings.dump(LONGTAIL))
    assert load_study(own) == LONGTAIL
    declared = settings.plain(LONGTAIL)
    declared["claims"][0]["arm"] = "heuristics"
    own.write_text(settings.dump(declared))
    with pytest.raises(UsageError, match=r"own\.yaml: .*names 'heuristics', which the study lacks"):
        settings.load(StudyDefinition, own)
    with pytest.raises(UsageError, match="no validation or test set"):
        StudySets.of(data.path, None, ())
    with pytest.raises(UsageError, match="none: scenario set not found"):
        StudySets.of(tmp_path / "none", None, ())
    # Before anything is scored or trained, and with the arms that need no labels.
    with ScenarioWriter(tmp_path / "recorded", SMALL) as writer:
        writer.add(assemble(straight_road([car(speed=8.0)]), SMALL))
    recorded = tmp_path / "recorded"
    sets = StudySets.of(recorded, recorded, (recorded,))
    with pytest.raises(UsageError, match=r"recorded: has no labelled events.*--arms \[bc,baseline,.*o\]"):
        runner.run_study(Study(LONGTAIL, StudyConfig(), sets, tmp_path / "study"))
    assert not (tmp_path / "study").exists()


def test_settings_out_of_range_are_refused(data, tmp_path):
    for settings_, words in (
        ({"seeds": 1}, "seeds is 1; use 2 or more"), ({"rare": 0.0}, "rare is 0.0; use a number between 0 and 1"),
        ({"arms": ("bc", "baseline", "bc")}, "duplicate arm 'bc'"),
    ):  # fmt: skip
        with pytest.raises(UsageError, match=words):
            StudyConfig(**settings_)
    study = Study(
        LONGTAIL, StudyConfig(total_steps=0), StudySets(data.path, data.path, (data.path,)), tmp_path
    )
    for steps, words in ((0, "total_steps is 0"), (1, "a training of 1 steps has one iteration")):
        study = replace(study, config=replace(study.config, total_steps=steps))
        with pytest.raises(UsageError, match=words):
            study.train_config("bc", 0)
    patient = ("--patience", "2", "--evaluate_every", "1")
    for training in (patient, ("--checkpoint_rule", "lexicographic")):
        study = replace(study, config=replace(study.config, total_steps=None, training=training))
        with pytest.raises(UsageError, match="leave out checkpoint_rule and patience"):
            study.train_config("bc", 0)


def test_claims_that_no_test_decides_are_refused():
    claim = LONGTAIL.claims[0]
    with pytest.raises(ValueError, match=r"has the change -1.0; use a number above -1"):
        replace(claim, change=-1.0)
    metrics = (*LONGTAIL.metrics, "distance")
    with pytest.raises(ValueError, match="names 'distance', which has no better direction"):
        replace(LONGTAIL, metrics=metrics, claims=(replace(claim, metric="distance"),))
    with pytest.raises(ValueError, match="two different baselines"):
        replace(LONGTAIL, baselines=("bc", "bc"))
    with pytest.raises(ValueError, match="use the method to match with permuted: true"):
        replace(LONGTAIL, arms=LONGTAIL.arms | {"control": Arm(method="random_matched")})
    with pytest.raises(ValueError, match="'idm' is a planner and an arm"):
        replace(LONGTAIL, arms=LONGTAIL.arms | {"idm": LONGTAIL.arms["bc"]})


def test_study_without_scores_has_no_player(data, tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "write_report", lambda *_: None)
    study = Study(
        LONGTAIL,
        StudyConfig(arms=("bc", "baseline")),
        StudySets(data.path, data.path, (data.path,)),
        tmp_path,
    )
    runner._write_pages(study, data, {}, {})
    assert not (tmp_path / "critical.html").exists()


def test_changed_claims_are_refused_when_a_study_resumes(data, tmp_path):
    sets = StudySets(data.path, data.path, (data.path,))
    runner._open_folder(Study(LONGTAIL, StudyConfig(), sets, tmp_path / "study"))
    runner._open_folder(Study(LONGTAIL, StudyConfig(), sets, tmp_path / "study"))
    fewer = replace(LONGTAIL, claims=LONGTAIL.claims[:-1])
    with pytest.raises(UsageError, match="contains a study with another definition"):
        runner._open_folder(Study(fewer, StudyConfig(), sets, tmp_path / "study"))


@pytest.mark.parametrize(
    "name",
    [
        "runs",
        "runs/bc/seed-0",
        "evaluations",
        "scores/x.npz",
        "test",
        "results.json",
        "report.html",
        "critical.html",
    ],
)
def test_links_in_the_folder_of_a_study_are_refused(data, tmp_path, name):
    """Nothing is read, trained or written behind them."""
    elsewhere, link = tmp_path / "elsewhere", tmp_path / "study" / name
    elsewhere.mkdir()
    study = Study(LONGTAIL, StudyConfig(), StudySets(data.path, data.path, (data.path,)), tmp_path / "study")
    runner._open_folder(study)
    link.parent.mkdir(parents=True, exist_ok=True)
    link.symlink_to(elsewhere)
    uses = {
        "runs/bc/seed-0": lambda: runner._is_finished(runner.Job(study, "bc", 0, np.zeros((1, 1), bool))),
        "scores/x.npz": lambda: study.scores("x"),
    }
    with pytest.raises(DataError, match=f"{name}: is a symbolic link; replace the link"):
        uses.get(name, lambda: runner._open_folder(study))()
    assert not any(elsewhere.iterdir())


def test_evaluated_run_without_checkpoints_is_not_trained_again(data, tmp_path):
    study = Study(LONGTAIL, StudyConfig(), StudySets(data.path, data.path, (data.path,)), tmp_path)
    study.evaluation("bc", 0).mkdir(parents=True)
    with pytest.raises(UsageError, match=r"has evaluations, but no checkpoints; remove .*bc.*seed-0"):
        runner._run_job(runner.Job(study, "bc", 0, np.zeros((1, 1), bool)))
