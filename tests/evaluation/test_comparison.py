"""Comparisons of hand-made evaluations: pairing, refusals and decisions."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import scipy.stats

import drivax
from drivax import settings
from drivax.errors import UsageError
from drivax.evaluation.comparison import ComparisonPlan, compare
from drivax.evaluation.episode_table import EpisodeTable
from drivax.stats.effects import power, scenarios_needed
from drivax.stats.intervals import paired_bootstrap, rate
from drivax.stats.significance import holm_adjust, mcnemar_test, paired_permutation

N = 60
PLAN = ComparisonPlan(minimum_scenarios=10, resamples=400, secondary=("collision", "comfortable"))


def table(name, shift=0.0, seed=1, rows=range(N), per_recording=1, about=None, **metrics):
    """An evaluation with score, collisions and comfort; ``rows`` are numbers of scenarios."""
    rng, rows = np.random.default_rng(seed), np.array(rows)
    scenario_score = np.random.default_rng(0).normal(0.6, 0.2, 10 * N)[rows]
    values = {
        "vmax_score": scenario_score + shift + rng.normal(0, 0.05, rows.size),
        "collision": (rng.random(rows.size) < 0.3 - shift).astype(float),
        "comfortable": (rng.random(rows.size) < 0.5).astype(float),
        "min_ttc": np.full(rows.size, np.nan),
        "steps": np.full(rows.size, 80.0),
    }
    keys = {
        "planner": (name,) * rows.size,
        "dataset": ("d",) * rows.size,
        "scenario_id": tuple(f"s{row}" for row in rows),
        "segment": tuple(f"r{row // per_recording}" for row in rows),
        "seed": ("0",) * rows.size,
        "traffic": ("log",) * rows.size,
    }
    info = {"traffic": "log", "data": {"hash": "abc"}} | (about or {})
    return EpisodeTable(Path("runs") / name, name, info, keys, values | metrics)


def test_paired_comparison_equals_hand_computed_values():
    a, b = table("one", 0.1, seed=2), table("two")
    result = compare(PLAN, [a], [b])
    one = result.primary
    x, y = a.metrics["vmax_score"], b.metrics["vmax_score"]
    assert one.difference == paired_bootstrap(x, y, a.clusters, resamples=400, seed=0)
    assert one.evidence == paired_permutation(x, y, a.clusters, 400, seed=0)
    assert one.effects["d_z"] == pytest.approx((x - y).mean() / (x - y).std(ddof=1))
    assert (result.scenarios, result.recordings, result.strata) == ((N, N), (N, N), 1)
    assert one.winner == "A" and result.decision.recommendation == "A" and result.decision.because == "test"
    rates = result.secondary
    assert rates[0].evidence == mcnemar_test(a.metrics["collision"], b.metrics["collision"])
    assert rates[0].a == rate(a.metrics["collision"])
    assert [r.p_adjusted for r in rates] == holm_adjust([r.evidence.p for r in rates])


def test_exchanging_planners_negates_the_difference():
    a, b = table("one", 0.1, seed=2), table("two")
    forth, back = compare(PLAN, [a], [b]), compare(PLAN, [b], [a])
    assert back.decision.recommendation == "B"
    assert back.primary.difference.mean == pytest.approx(-forth.primary.difference.mean)
    assert back.primary.evidence.p == pytest.approx(forth.primary.evidence.p, abs=0.01)


def test_lower_is_better_for_metrics_to_minimise():
    worse = table("one", collision=np.ones(N))
    plan = dataclasses.replace(PLAN, primary="collision", secondary=("vmax_score",))
    assert compare(plan, [worse], [table("two", seed=2)]).decision.recommendation == "B"


def test_recordings_are_resampled_as_a_whole():
    a, b = table("one", per_recording=3, seed=2), table("two", per_recording=3)
    result = compare(PLAN, [a], [b])
    assert result.recordings == (20, 20) and result.secondary[0].evidence.name == "permutation"
    assert result.primary.evidence.units == 20


def test_planners_of_one_name_are_distinguished_by_their_folders():
    """Every algorithm has a ``seed-0``."""
    tables = [table("seed-0", seed=seed) for seed in (1, 2, 3)]
    folders = ("runs/bc/seed-0", "runs/ppo/seed-0", "runs/ppo/other")
    bc, ppo, other = (
        dataclasses.replace(one, folder=Path(f)) for one, f in zip(tables, folders, strict=True)
    )
    assert compare(PLAN, [bc], [ppo]).names == ("seed-0 (bc/seed-0)", "seed-0 (ppo/seed-0)")
    assert compare(PLAN, [bc], [other]).names == ("seed-0 (seed-0)", "seed-0 (other)")
    seeds = [dataclasses.replace(one, folder=Path(f"runs/bc/{row}")) for row, one in enumerate((*tables, bc))]
    assert compare(PLAN, seeds[:2], seeds[2:]).names == ("bc (A)", "bc (B)")


def test_order_does_not_matter_and_only_common_scenarios_count():
    a = table("one", rows=range(N))
    part = table("two", rows=list(reversed(range(20, N + 10))))
    result = compare(PLAN, [a], [part])
    y = dict(zip(part.keys["scenario_id"], part.metrics["vmax_score"], strict=True))
    expected = np.mean([a.metrics["vmax_score"][row] - y[f"s{row}"] for row in range(20, N)])
    assert result.scenarios == (40, 40) and result.primary.difference.mean == pytest.approx(expected)


def test_pairs_with_undefined_values_are_excluded():
    a, b = table("one", seed=2), table("two")
    a.metrics["vmax_score"][:5], b.metrics["vmax_score"][3:10] = np.nan, np.nan
    one = compare(PLAN, [a], [b]).primary
    assert (one.a.n, one.b.n, one.difference.n, one.undefined_a, one.undefined_b) == (50, 50, 50, 5, 7)
    assert one.a.mean - one.b.mean == pytest.approx(one.difference.mean)


def test_too_few_scenarios_decide_nothing():
    result = compare(
        dataclasses.replace(PLAN, minimum_scenarios=61), [table("one", 0.3)], [table("two", seed=2)]
    )
    assert result.primary.winner == "A", "the result of the test is still reported"
    assert (result.decision.recommendation, result.decision.because) == ("not enough scenarios", "minimum")
    assert result.decision.needed >= 61


def test_power_separates_no_difference_from_too_few_scenarios():
    a, b = table("one", seed=2), table("two")
    deviation = (a.metrics["vmax_score"] - b.metrics["vmax_score"]).std(ddof=1)
    for smallest, recommendation in ((0.05, "no difference"), (0.01, "not enough scenarios")):
        result = compare(dataclasses.replace(PLAN, smallest_difference=smallest), [a], [b])
        assert result.primary.winner is None and result.decision.because == "power"
        assert result.decision.recommendation == recommendation
        sensitivity = result.sensitivity
        assert sensitivity.power == pytest.approx(power(smallest / deviation, N))
        assert sensitivity.design_effect == 1.0
        assert sensitivity.needed == scenarios_needed(smallest / deviation)
        assert power(sensitivity.detectable / deviation, N) == pytest.approx(0.8)
    assert result.decision.needed == result.sensitivity.needed > N
    # By default a tenth of the deviation, for which textbooks ask for 787 pairs.
    assert compare(PLAN, [a], [b]).sensitivity.needed == scenarios_needed(0.1) == 787


def test_clustered_scenarios_need_more_of_them():
    a, b = table("one", per_recording=4, seed=2), table("two", per_recording=4)
    a.metrics["vmax_score"][:] += np.repeat(np.random.default_rng(5).normal(0, 0.2, N // 4), 4)
    sensitivity = compare(PLAN, [a], [b]).sensitivity
    assert 3 < sensitivity.design_effect <= 4.5 and sensitivity.needed > 3 * 787


def test_equal_planners_give_no_difference():
    result = compare(PLAN, [table("one")], [table("two")])
    assert (result.decision.recommendation, result.decision.because) == ("no difference", "equal")
    assert result.primary.evidence.p == 1.0 and result.sensitivity is None


def test_worse_secondary_metrics_are_caveats():
    result = compare(PLAN, [table("one", 0.3, collision=np.ones(N))], [table("two", seed=2)])
    assert result.decision.recommendation == "A" and result.decision.caveats == ("collision",)


def entries():
    tags = [{"difficulty": "hard" if row % 3 == 0 else "easy"} for row in range(10 * N)]
    return [{"dataset": "d", "scenario_id": f"s{row}", "tags": tag} for row, tag in enumerate(tags)]


@pytest.mark.parametrize("split", ["random", "stratified"])
def test_splits_give_each_planner_its_own_scenarios(split):
    rows = range(10 * N)
    plan = dataclasses.replace(PLAN, split=split, strata=("difficulty",), ratio=0.4)
    a, b = table("one", 0.2, seed=2, rows=rows), table("two", rows=rows)
    result = compare(plan, [a], [b], entries())
    assert result.scenarios == (240, 360) and result.strata == (2 if split == "stratified" else 1)
    one = result.primary
    assert (one.a.n, one.b.n, one.difference.n) == (240, 360, 600) and list(one.effects) == ["d"]
    assert one.difference.mean == pytest.approx(one.a.mean - one.b.mean)
    assert one.difference.mean == pytest.approx(0.2, abs=0.05)
    assert result.decision.recommendation == "A"
    # Nearly the width of an ordinary interval of two means.
    spread = np.sqrt(0.2**2 + 0.05**2) * np.sqrt(1 / 240 + 1 / 360)
    assert one.difference.high - one.difference.low == pytest.approx(2 * 1.96 * spread, rel=0.15)
    expected = scipy.stats.norm.ppf([0.975, 0.8]).sum() ** 2 / 0.1**2 / (0.4 * 0.6)
    assert result.sensitivity.needed == pytest.approx(expected, rel=0.01)


def seeds_of(*shifts, folder="runs/bc", first=3, **more):
    """Evaluations of a policy's seeds, whose scores are shifted by ``shifts``."""
    tables = [table(f"seed-{n}", shift, seed=first + n, **more) for n, shift in enumerate(shifts)]
    return [dataclasses.replace(one, folder=Path(folder) / one.name) for one in tables]


def test_interval_covers_seeds_and_scenarios():
    seeds, others = seeds_of(0.0, 0.03, 0.06), [table("two")]
    result = compare(PLAN, seeds, others)
    assert result.names[0] == "bc" and result.folders[0] == Path("runs/bc")
    rows = np.stack([one.metrics["vmax_score"] for one in seeds])
    other = others[0].metrics["vmax_score"]
    apart = rows.mean(axis=0) - other
    one = result.primary
    assert one.difference.mean == pytest.approx(apart.mean()) and one.difference.n == N
    # By hand: every scenario is its own recording, and the other planner has no variance of seeds.
    residuals = rows - rows.mean(axis=1, keepdims=True) - rows.mean(axis=0) + rows.mean()
    seed_variance = rows.mean(axis=1).var(ddof=1) / 3
    scenario_variance, interaction = apart.var(ddof=1) / N, (residuals**2).sum() / (N * (N - 1) * 3 * 2)
    square = max(seed_variance + scenario_variance - interaction, seed_variance, scenario_variance)
    freedom = square**2 / (seed_variance**2 / 2 + scenario_variance**2 / (N - 1))
    half = scipy.stats.t.ppf(0.975, freedom) * np.sqrt(square)
    assert (one.difference.low, one.difference.high) == pytest.approx(
        (apart.mean() - half, apart.mean() + half)
    )
    assert one.evidence.p == pytest.approx(2 * scipy.stats.t.sf(abs(apart.mean()) / np.sqrt(square), freedom))
    assert (one.winner is None) == (one.difference.low <= 0 <= one.difference.high)
    spread = result.seeds[0]
    assert spread.means == pytest.approx(rows.mean(axis=1))
    assert spread.interquartile.low < spread.interquartile.mean < spread.interquartile.high
    assert result.seeds[1] is None and result.secondary[0].a.n == N, (
        "means over several seeds are not only 0 or 1"
    )


def test_no_number_of_scenarios_decides_between_varying_seeds():
    """Each seed alone would be significant, but no number of scenarios suffices."""
    others, plan = [table("two")], dataclasses.replace(PLAN, smallest_difference=0.05)
    seeds = seeds_of(-0.2, 0.3)
    alone = [compare(plan, [seed], others).decision.recommendation for seed in seeds]
    assert alone == ["B", "A"]
    result = compare(plan, seeds, others)
    assert (result.decision.recommendation, result.decision.because) == ("not enough scenarios", "seeds")
    assert result.sensitivity.needed is None and result.sensitivity.power < 0.2
    assert result.primary.a.low < result.primary.a.mean < result.primary.a.high


def test_seeds_that_agree_give_a_winner_or_no_difference():
    others = seeds_of(0.0, 0.0, 0.0, folder="runs/other", first=9)
    assert compare(PLAN, seeds_of(0.3, 0.3, 0.3), others).decision.recommendation == "A"
    plan = dataclasses.replace(PLAN, smallest_difference=0.5)
    result = compare(plan, seeds_of(0.0, 0.0, 0.001), others)
    assert (result.decision.recommendation, result.decision.because) == ("no difference", "power")
    assert result.sensitivity.needed == N


def test_seeds_that_differ_equally_everywhere_need_more_seeds():
    rows = [np.ones(N), np.zeros(N)]
    seeds = [table(f"seed-{n}", vmax_score=row) for n, row in enumerate(rows)]
    result = compare(PLAN, seeds, [table("two", vmax_score=np.zeros(N))])
    assert (result.decision.recommendation, result.decision.because) == ("not enough scenarios", "seeds")
    assert (result.primary.a.low, result.primary.a.high) == (0.0, 1.0), "intervals of a score stay in [0, 1]"
    same = compare(
        PLAN, [table(f"seed-{n}", vmax_score=rows[0]) for n in range(2)], [table("two", vmax_score=rows[0])]
    )
    assert (same.decision.recommendation, same.decision.because) == ("no difference", "equal")


def test_seeds_on_one_recording_decide_nothing():
    result = compare(PLAN, seeds_of(0.0, 0.1, per_recording=N), [table("two", per_recording=N)])
    assert result.primary.evidence.p is None and result.primary.winner is None and result.sensitivity is None
    assert result.primary.difference.low is None and result.primary.difference.mean is not None


def test_split_with_several_seeds_is_refused():
    plan = dataclasses.replace(PLAN, split="random")
    with pytest.raises(UsageError, match="one evaluation"):
        compare(plan, seeds_of(0.0, 0.1), [table("two")])


def test_comparison_is_plain_json():
    result = compare(PLAN, [table("one", 0.1)], [table("two", seed=2)])
    stored = json.loads(json.dumps(result.as_dict(), allow_nan=False))
    assert stored["decision"]["recommendation"] == "A" and stored["primary"]["difference"]["n"] == N
    assert stored["plan"]["primary"] == "vmax_score" and stored["secondary"][0]["metric"] == "collision"
    assert settings.load(ComparisonPlan, stored["plan"]) == PLAN


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"about": {"data": {"hash": "other"}}}, "differ in scenario set"),
        ({"about": {"traffic": "idm"}}, "differ in traffic (log and idm)"),
        ({"rows": range(N, 2 * N)}, "no scenario in common"),
        ({"vmax_score": np.full(N, np.nan)}, "in no common scenario"),
        (
            {"vmax_score": np.full(N, np.nan), "vmax_score_partial": np.ones(N)},
            "every vmax_score of two is partial",
        ),
        ({"name": "one"}, "the same run"),
    ],
)
def test_incomparable_evaluations_are_refused(change, words):
    with pytest.raises(UsageError) as caught:
        compare(PLAN, [table("one")], [table(**{"name": "two"} | change)])
    assert words in str(caught.value) and caught.value.cure and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"primary": "vmaxscore"}, "has no metric 'vmaxscore'; did you mean 'vmax_score'?"),
        ({"secondary": ("steps",)}, "steps is a code or count without a mean"),
        ({"primary": "vmax_score_partial"}, "combines different inputs"),
        ({"primary": "ade"}, "has no better direction"),
        ({"split": "stratified"}, "--data"),
        ({"split": "random", "ratio": 0.999}, "leave an arm empty"),
    ],
)
def test_plans_that_do_not_fit_the_runs_are_refused(change, words):
    more = {"vmax_score_partial": np.ones(N), "ade": np.ones(N)}
    with pytest.raises(UsageError) as caught:
        compare(dataclasses.replace(PLAN, **change), [table("one", **more)], [table("two", **more)])
    assert words in str(caught.value) and caught.value.cure and "\n" not in str(caught.value)


def test_folders_of_several_planners_are_refused():
    with pytest.raises(UsageError, match=r"several planners \(idm, one\)"):
        compare(PLAN, [table("one"), table("idm", seed=2)], [table("two", seed=3)])
    in_memory = [dataclasses.replace(table(name), folder=None) for name in ("one", "idm")]
    with pytest.raises(UsageError, match="pass those of one planner"):
        compare(PLAN, in_memory, [table("two", seed=3)])
    seeds = [table("seed-0@4"), table("seed-1@4", seed=2)]
    assert compare(PLAN, seeds, [table("two", seed=3)]).decision
    with pytest.raises(UsageError, match=r"several planners \(one@4, one@8\)"):
        compare(PLAN, [table("one@4"), table("one@8", seed=2)], [table("two", seed=3)])


@pytest.mark.parametrize(
    "change",
    [
        "ratio: 1.0", "confidence: 95", "power: 0", "minimum_scenarios: 1", "resamples: 10", "smallest_difference: 0",
        "smallest_difference: .inf", "seed: -1",
        "secondary: [offroad, offroad]", "split: halves",
        "{split: random, test: bootstrap}", "minimum: 3",
    ],
)  # fmt: skip
def test_impossible_plans_are_refused(change):
    with pytest.raises(UsageError) as caught:
        settings.load(ComparisonPlan, settings.parse_yaml(change))
    line, cure = str(caught.value), caught.value.cure or ""
    name = {"secondary": "metric", "{split": "test"}.get(key := change.split(":")[0], key)
    assert name in line and cure and cure != "correct this setting" and "\n" not in line


def test_plans_round_trip():
    plan = ComparisonPlan(name="weekly", a=Path("runs/a"), b=Path("runs/b"), smallest_difference=0.02)
    assert settings.load(ComparisonPlan, settings.parse_yaml(settings.dump(plan))) == plan
    default = ComparisonPlan()
    assert (default.primary, default.minimum_scenarios, default.confidence) == ("vmax_score", 1000, 0.95)
    assert (default.power, default.ratio, default.split) == (0.8, 0.5, "paired")


def written(folder, lines, about='{"kind": "evaluation", "planner": "p"}'):
    folder.mkdir(parents=True)
    (folder / "run.json").write_text(about)
    head = "planner,dataset,scenario_id,segment,seed,traffic,success"
    (folder / "episodes.csv").write_text("\n".join([head, *lines]) + "\n")
    return folder


def test_runs_round_trip_and_damaged_files_are_named(tmp_path):
    run = written(tmp_path / "run", ["p,d,s1,,0,log,1", "p,d,s1,,1,log,0", "p,d,s2,r,0,log,"])
    result = EpisodeTable.read(run)
    assert result.by_scenario("success")["d", "s1"] == 0.5 and np.isnan(
        result.by_scenario("success")["d", "s2"]
    )
    assert result.clusters == ["d/s1", "d/s1", "d/r"]
    bad = written(tmp_path / "nan", ["p,d,s1,,0,log,nan"])
    with pytest.raises(Exception, match="record 1: success is NaN"):
        EpisodeTable.read(bad)
    with pytest.raises(Exception, match="of kind 'training', not evaluation"):
        EpisodeTable.read(written(tmp_path / "train", [], '{"kind": "training"}'))
    for seed in range(2):
        written(tmp_path / "seeds" / f"seed-{seed}", ["p,d,s1,,0,log,1"])
    assert len(EpisodeTable.read_seeds(tmp_path / "seeds")) == 2 and len(EpisodeTable.read_seeds(run)) == 1
    with pytest.raises(Exception, match="run folder not found"):
        EpisodeTable.read_seeds(tmp_path / "nowhere")


def test_other_starts_are_refused(tmp_path):
    a, b = (written(tmp_path / name, ["p,d,s1,,0,log,1"]) for name in "ab")
    (a / "config.yaml").write_text("noisy_start: true\nstart_step: 10\n")
    (b / "config.yaml").write_text("noisy_start: false\nstart_step: 10\n")
    with pytest.raises(UsageError, match=r"differ in noisy_start \(True and False\)"):
        compare(PLAN, [EpisodeTable.read(a)], [EpisodeTable.read(b)])


def test_values_out_of_range_are_named():
    with pytest.raises(UsageError, match=r"^smallest_difference is -0.1; use a number above 0, or null$"):
        ComparisonPlan(smallest_difference=-0.1)
    with pytest.raises(UsageError, match=r"^resamples is 10; use 100 or more$"):
        ComparisonPlan(resamples=10)


def test_duplicate_run_on_one_side_is_refused():
    with pytest.raises(UsageError, match=r"^runs/one: duplicate run"):
        compare(PLAN, [table("two")], [table("one"), table("one")])


def test_metric_that_only_one_planner_defines_is_not_called_partial():
    halves = np.arange(N) < N / 2
    a, b = (
        table(
            name, vmax_score=np.where(defined, 0.5, np.nan), vmax_score_partial=np.where(defined, np.nan, 0.5)
        )
        for name, defined in (("one", halves), ("two", ~halves))
    )
    with pytest.raises(UsageError, match="vmax_score is defined for A and B in no common scenario"):
        compare(PLAN, [a], [b])
    split = dataclasses.replace(PLAN, split="random")
    with pytest.raises(UsageError, match="vmax_score is undefined in every scenario of A, or of B"):
        compare(split, [a], [table("two", vmax_score=np.full(N, np.nan))])


def test_own_metric_may_be_called_partial():
    own = {"own_metrics": {"cost_partial": {"unit": "-", "better": "low", "text": "cost"}}}
    a, b = (table(name, about=own, cost_partial=np.full(N, k)) for k, name in enumerate(("one", "two")))
    assert compare(dataclasses.replace(PLAN, primary="cost_partial"), [a], [b]).decision.recommendation == "A"


def test_compared_runs_replace_those_of_the_plan(monkeypatch):
    monkeypatch.setattr("drivax.api.EpisodeTable.read_seeds", lambda path: [path])
    plans = []

    def compare_by(plan, *_):
        plans.append(plan)
        raise UsageError("stop")

    monkeypatch.setattr("drivax.api.compare_evaluations", compare_by)
    with pytest.raises(UsageError, match="stop"):
        drivax.compare("x", "y", ComparisonPlan(a=Path("old"), primary="success"))
    assert plans == [ComparisonPlan(a=Path("x"), b=Path("y"), primary="success")]
