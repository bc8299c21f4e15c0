"""The long-tail study: verdicts on results that are known, and the whole study on a few scenarios."""

import json
from dataclasses import replace

import numpy as np
import pytest

from drivax import settings
from drivax.cli import main
from drivax.curation.methods import Request, curate
from drivax.curation.scores import ScoreTable
from drivax.curation.weights import WeightConfig, draw_statistics
from drivax.errors import UsageError
from drivax.scenario.build.assemble import assemble
from drivax.scenario.recording import Event
from drivax.scenario.store import ScenarioSet, ScenarioWriter
from drivax.stats.seeds import CrossedEffect
from drivax.stats.significance import holm_adjust
from drivax.studies import study as runner
from drivax.studies.definition import Study, StudyConfig, StudyDefinition, StudySets, load_study
from drivax.studies.verdicts import (
    Strata,
    ValidationCheck,
    compare_rankings,
    decide_claims,
    describe_sample_size,
    detectable_differences,
    rates,
    rule_cost,
)
from experiment_scripts import load_script
from scenes import SMALL, car, straight_road

LONGTAIL = load_study("longtail")
ARMS, METRICS = LONGTAIL.arms, LONGTAIL.metrics
SEEDS, SCENARIOS = 5, 400
TINY = [
    "--total_steps", "64", "--validations", "4", "--seeds", "2",
    "--arms", "[baseline, bc, heuristic, random_matched]",
    "--training", '["--algorithm.batch", "8", "--algorithm.updates", "1", "--algorithm.network.head", "[4]"]',
]  # fmt: skip


def drives(rates_of, rng):
    """Failures drawn by the rates of every arm; accuracy is their absence, the rest says nothing."""
    found = {}
    for name, rate in rates_of.items():
        seeds = np.clip(rate + 0.004 * rng.normal(size=(SEEDS, 1)), 0, 1)
        hit = (rng.random((SEEDS, SCENARIOS)) < seeds).astype(float)
        found[name] = dict.fromkeys(METRICS, hit) | {"accuracy": 1.0 - hit}
    return found


def verdicts(rates_of, seed=0, rare_rates=None, share=None):
    """Results of the claims by their words; every second scenario is rare."""
    rng = np.random.default_rng(seed)
    labels = [f"recording-{number}" for number in range(SCENARIOS)]
    rare = np.arange(SCENARIOS) % 2 == 0
    tested = drives(rates_of, rng)
    if rare_rates:
        other = drives(rare_rates, rng)
        tested = {
            name: {metric: np.where(rare, other[name][metric], values) for metric, values in one.items()}
            for name, one in tested.items()
        }
    results = decide_claims(LONGTAIL.claims, tested, Strata(labels, rare, share))
    return {result.claim.words: result for result in results}


EVEN = dict.fromkeys(ARMS, 0.16)
SIZE = "ensemble has 34% of the baseline's collisions or fewer"


def test_agents_that_do_not_differ_support_no_claim():
    found = [one.verdict for seed in range(20) for one in verdicts(EVEN, seed).values()]
    assert found.count("supported") <= 0.01 * len(found)
    of_size = [verdicts(EVEN, seed)[SIZE].verdict for seed in range(20)]
    assert of_size.count("contradicted") >= 18


def test_effect_that_the_random_control_shares_is_not_credited():
    better = EVEN | {"ensemble": 0.02, "heuristic": 0.06, "random_matched": 0.06}
    found = verdicts(better)
    assert found["ensemble collides less than the baseline"].verdict == "supported"
    assert found["ensemble fails less than the baseline"].verdict == "supported"
    assert found["heuristic collides less than the baseline"].verdict == "supported"
    assert found["heuristic collides less than its matched random control"].verdict == "undecided"
    assert found[SIZE].verdict == "supported"
    low_high = found[SIZE].change
    assert low_high[1] < 0.02 / 0.16 - 1 < low_high[2] < -0.5


@pytest.mark.parametrize(("rate", "verdict"), [(0.06, "undecided"), (0.11, "contradicted")])
def test_a_claimed_size_is_tested_against_that_size(rate, verdict):
    """A rate of 0.055 is what is claimed: a real reduction alone does not make a claim of a size true."""
    found = verdicts(EVEN | {"ensemble": rate})
    assert found["ensemble collides less than the baseline"].verdict == "supported"
    assert found[SIZE].verdict == verdict
    if verdict == "undecided":
        assert "would decide" in found[SIZE].needed


def test_rare_scenarios_count_as_in_ordinary_traffic():
    """Half of the test is rare: worse where it is common and better where it is rare is worse on the road."""
    common, rare = dict.fromkeys(ARMS, 0.02), dict.fromkeys(ARMS, 0.40)
    worse = common | {"ensemble": 0.10}, rare | {"ensemble": 0.18}
    words = "ensemble collides less than the baseline"
    assert verdicts(worse[0], 0, worse[1])[words].verdict == "supported"
    found = verdicts(worse[0], 0, worse[1], share=0.05)
    assert found[words].verdict == "contradicted"
    assert found[words].difference.difference == pytest.approx(0.95 * 0.08 - 0.05 * 0.22, abs=0.02)
    assert found[f"{words} in rare scenarios"].verdict == "supported"
    assert found[f"{words} in common scenarios"].verdict == "contradicted"


def test_an_effect_of_the_other_sign_contradicts():
    found = verdicts(EVEN | {"action_rarity": 0.3})
    one = found["action_rarity collides less than the baseline"]
    assert one.verdict == "contradicted" and one.effect.difference > 0.1
    assert one.adjusted_p >= one.effect.p


def test_p_values_are_adjusted_within_their_group():
    found = list(verdicts(EVEN | {"heuristic": 0.14}).values())
    for group in {one.claim.group for one in found}:
        ps = [one.effect.p for one in found if one.claim.group == group]
        assert [one.adjusted_p for one in found if one.claim.group == group] == holm_adjust(ps)
    claimed = [(c.arm, c.reference, c.metric, c.rows, c.change) for c in LONGTAIL.claims]
    assert len(claimed) == len(set(claimed)) == 54


def test_what_is_undecided_says_what_would_decide():
    few = CrossedEffect(0.02, (4e-5, 4e-5), 1e-5, (5, 5), 400)
    seeds = int(describe_sample_size(few, 1).split()[0])
    assert 10 <= seeds <= 13  # by a normal distribution 4e-4 / ((0.02 / 2.8016)^2 - 1e-5) = 9.75
    assert int(describe_sample_size(few, 20).split()[0]) > seeds
    assert describe_sample_size(replace(few, difference=1e-6), 1).startswith("neither seeds nor recordings")
    assert "test recordings" in describe_sample_size(CrossedEffect(0.02, (1e-6, 1e-6), 9e-5, (5, 5), 400), 1)


def test_what_can_be_found_is_known_before_the_others_learn():
    """By the variation of the baseline's seeds, and at a stricter level where more claims are tested."""
    rng = np.random.default_rng(1)
    tested = drives({"baseline": 0.16, "bc": 0.3}, rng)
    strata = Strata(list(map(str, range(SCENARIOS))), np.arange(SCENARIOS) < 40, 0.05)
    one, nine = (detectable_differences(tested["baseline"], tested["bc"], strata, METRICS, m) for m in (1, 9))
    assert sorted(one) == sorted(METRICS) and 0.02 < one["collision"] < nine["collision"] < 0.2
    undefined = tested["baseline"] | {"vmax_score": np.full((SEEDS, SCENARIOS), np.nan)}
    assert "vmax_score" not in detectable_differences(undefined, tested["bc"], strata, METRICS, 1)


def test_mean_q_is_judged_in_pairs():
    rng = np.random.default_rng(2)
    best = drives({"baseline": 0.16}, rng)["baseline"]
    strata = Strata(list(map(str, range(SCENARIOS))), np.zeros(SCENARIOS, bool))
    same = rule_cost(best, best, strata, METRICS)
    assert same["collision"] == {"difference": 0.0, "interval": [0.0, 0.0]}
    hit = best["collision"] + (rng.random((SEEDS, SCENARIOS)) < 0.03) * (1 - best["collision"])
    found = rule_cost(best | {"collision": hit}, best, strata, METRICS)
    assert 0.0 < found["collision"]["interval"][0] < found["collision"]["difference"] < 0.05


def test_controls_have_the_effective_sizes_of_their_arms(data):
    """Of steps and of scenarios: of scores that lie together within scenarios more or less, and of labels, mostly 0."""
    rng, shape = np.random.default_rng(0), (600, 91)
    found = {}
    for place, method in enumerate(("kinematic", "action_rarity", "ensemble", "oracle", "uniform")):
        slow = np.cumsum(rng.normal(size=shape), axis=1) + 6 * (place + 1) * rng.normal(size=(shape[0], 1))
        steps = 1 / (1 + np.exp(-slow / 10))
        if method == "oracle":
            steps = ((rng.random((shape[0], 1)) < 0.1) & (np.arange(shape[1]) // 20 == 2)).astype(float)
        elif method == "uniform":
            steps = np.ones(shape)
        ids = tuple(map(str, range(shape[0])))
        found[method] = ScoreTable(method, {}, "x", ids, np.ones(shape, bool), steps, steps.max(axis=1))
    usable = np.zeros(shape, bool)
    usable[:, 10:89] = rng.random((shape[0], 79)) < 0.95
    pairs = {(c.arm, c.reference) for c in LONGTAIL.claims if ARMS[c.reference].permuted}
    curated = [name for name in ARMS if name.startswith(("heuristic", "ensemble", "action_rarity"))]
    assert {one for one, _ in pairs} == {*curated, "oracle"}
    for pair in pairs:
        own, control = (
            draw_statistics(
                ARMS[name].weigh(data, found.__getitem__, WeightConfig(), usable, seed=3).weights,
                usable,
            )
            for name in pair
        )
        assert control.effective == pytest.approx(own.effective, rel=0.02), pair
        assert control.effective_scenarios == pytest.approx(own.effective_scenarios, rel=0.06), pair
    for name, share in (("oracle", 0.115), ("oracle_strong", 0.3)):
        weights = ARMS[name].weigh(data, found.__getitem__, WeightConfig(), usable).weights
        during = weights[found["oracle"].steps > 0].sum() / weights.sum()
        # And those that uniform draws find.
        assert during == pytest.approx(share + (1 - share) * (found["oracle"].steps > 0)[usable].mean())
    assert len(curated) == 6 and {ARMS[name].scale for name in curated} == {"step", "scenario"}


def test_scores_of_another_method_are_refused(data):
    table = curate("uniform", Request(data))
    with pytest.raises(UsageError, match="scores of 'uniform' for an arm with the method 'action_rarity'"):
        ARMS["action_rarity"].weigh(data, lambda _: table, WeightConfig())


def test_conditions_look_at_the_chosen_checkpoint_and_at_the_end():
    rising = {"score": [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8], "progress": [0.0] * 7 + [0.95]}
    flat = {"score": [0.1, 0.5, 0.8, 0.8, 0.81, 0.8, 0.8, 0.8], "progress": [0.0] * 4 + [0.9] + [0.0] * 3}
    one = ValidationCheck.of("bc", [rising], 0.8, 0.03)
    assert one.change == pytest.approx(0.2) and one.progress == 0.95 and not one.met
    assert ValidationCheck.of("bc", [flat], 0.8, 0.03).met
    assert not ValidationCheck.of("bc", [flat], 0.91, 0.03).met
    # Of equal scores, the latest is that of the best checkpoint.
    equal = {"score": [0.8] * 8, "progress": [0.0] * 7 + [0.9]}
    assert ValidationCheck.of("bc", [equal], 0.8, 0.03).progress == 0.9


def test_seeds_do_not_make_up_for_each_other():
    """One that falls does not make one that rises flat, and four that drive do not carry one that stands."""
    up = {"score": [0.5] * 6 + [0.7, 0.7], "progress": [0.9] * 8}
    down = {"score": [0.7] * 6 + [0.5, 0.5], "progress": [0.9] * 8}
    flat = {"score": [0.7] * 8, "progress": [0.9] * 8}
    found = ValidationCheck.of("bc", [up, down], 0.8, 0.03)
    assert found.change == pytest.approx(0.0) and found.moved == pytest.approx(0.2) and not found.met
    found = ValidationCheck.of("bc", [flat] * 4 + [flat | {"progress": [0.5] * 8}], 0.8, 0.03)
    assert found.progress > 0.8 and found.least == 0.5 and not found.met


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
        name: ScoreTable(name, {}, "x", ids, np.ones(shape, bool), one, one[:, 0])
        for name, one in scores.items()
    }
    verdict = {tuple(r["methods"]): r["orthogonal"] for r in compare_rankings(tables, ids)}
    # Correlations of 0 and, within one standard error of the limit, of about 0.3.
    assert verdict == {("a", "b"): "supported", ("a", "c"): "undecided", ("b", "c"): "supported"}
    rng = np.random.default_rng(0)
    found = rates(
        drives({"bc": 0.2}, rng)["bc"],
        Strata(list(map(str, range(SCENARIOS))), np.zeros(SCENARIOS, bool)),
        METRICS,
    )
    assert sorted(found) == ["common", "ordinary"] and found["ordinary"]["collision"]["low"] < 0.2
    none = dict.fromkeys(METRICS, np.zeros((SEEDS, 100))) | {"vmax_score": np.full((SEEDS, 100), np.nan)}
    found = rates(none, Strata(list(map(str, range(100))), np.arange(100) < 50, 0.05), METRICS)
    # Wilson: 3.84 / (n + 3.84), where n = 1 / (0.95^2 / 50 + 0.05^2 / 50) = 55.2.
    assert found["ordinary"]["collision"] == {
        "mean": 0.0, "low": 0.0, "high": pytest.approx(0.065, abs=1e-4), "scenarios": 100
    }  # fmt: skip
    assert "vmax_score" not in found["rare"]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Six drives said to be of the built-in world, two with an event."""
    path = tmp_path_factory.mktemp("longtail") / "set"
    with ScenarioWriter(path, SMALL) as writer:
        for row in range(6):
            cars = [car(speed=8.0 + row), car(x=30.0 + row, speed=8.0)]
            events = (Event(3, 8, 30, (101,)),) if row < 2 else ()
            drive = replace(
                straight_road(cars),
                scenario_id=f"drive-{row}",
                segment=f"r{row}",
                dataset="drivax",
                events=events,
            )
            writer.add(assemble(drive, SMALL))
    return ScenarioSet.open(path)


@pytest.fixture
def here(monkeypatch):
    """Trainings in this process: a new one takes half a minute to start and compile."""

    def one_by_one(call, tasks, cores):
        return [(task, call(task)) for task in tasks]

    monkeypatch.setattr(runner, "one_core_each", one_by_one)


@pytest.mark.slow
def test_the_whole_study(data, tmp_path, here, capsys, monkeypatch):
    out = tmp_path / "study"
    sets = ["--data", str(data.path), "--validation", str(data.path), "--test", str(data.path)]
    arguments = ["study", "longtail", *sets, "--out", str(out), *TINY]
    assert main(arguments) == 2
    assert "does not drive well enough" in capsys.readouterr().err
    assert main([*arguments, "--anyway"]) == 0
    told = capsys.readouterr()
    assert "undecided" in told.out and "trained and evaluated random_matched, seed 1" in told.err
    results = json.loads((out / "results.json").read_text())
    assert (
        results["about"]["test"] == 4 and results["about"]["rare"] == 2
    )  # as many without an event as with one
    assert list(results["rates"]) == ["expert", "idm", "pdm", *results["draws"]]
    assert list(results["draws"]) == ["baseline", "bc", "heuristic", "random_matched"]
    assert results["draws"]["bc"]["effective"] == 1.0
    page = (out / "report.html").read_text()
    assert "The conditions of the comparison are not met" in page and "http://" not in page
    assert (out / "critical.html").is_file()
    # Everything is there: nothing is trained or episodes again.
    assert main([*arguments, "--anyway"]) == 0
    again = capsys.readouterr().err
    assert "trained" not in again and "evaluating" not in again
    # And so where only what was kept of it is.
    script = load_script("longtail")
    monkeypatch.setattr(script, "KEPT", tmp_path / "kept")
    script.keep(out)
    script.restore(tmp_path / "restored")
    assert not list((tmp_path / "restored").rglob("checkpoints"))
    restored = [file for file in (tmp_path / "restored").rglob("*") if file.is_file()]
    scores = {file.name for file in restored if file.suffix == ".npz"}
    assert scores == {file.name for file in (out / "scores").iterdir()} >= {"kinematic.npz"}
    kept = [file for file in restored if file.suffix != ".npz"]
    assert {file.name for file in kept} == {"config.yaml", "run.json", "metrics.jsonl", "episodes.csv"}
    for file in kept:
        assert str(tmp_path.parent) not in file.read_text(), file
    arguments[arguments.index(str(out))] = str(tmp_path / "restored")
    assert main([*arguments, "--anyway"]) == 0
    again = capsys.readouterr().err
    assert "trained" not in again and "evaluating" not in again
    script.keep(tmp_path / "restored")  # a study that was restored tells no command
    again = json.loads((tmp_path / "restored" / "results.json").read_text())
    assert again == results
    arguments[arguments.index(str(tmp_path / "restored"))] = str(out)
    blocks = [f"claims {group}" for group in LONGTAIL.groups]
    blocks += ["conditions", "detectable", "draws", "rankings", "rule cost", "validations"]
    blocks += [f"rates {kind}" for kind in ("ordinary", "common", "rare")]
    page = script.fill_page("".join(f"{script.BEGIN.format(b)}\n{script.END}\n" for b in blocks), results)
    assert script.fill_page(page, results) == page and page.count("|---") >= len(blocks)
    assert "heuristic collides less than its matched random control" in page
    # What was trained with other weights, or evaluated before it was trained, belongs to no study.
    run = out / "runs" / "heuristic" / "seed-0" / "run.json"
    told, drive = json.loads(run.read_text()), out / "drives" / "heuristic" / "seed-0" / "run.json"
    run.write_text(json.dumps(told | {"weights": "0" * 64}))
    assert main([*arguments, "--anyway"]) == 2
    assert "was trained with other settings or weights" in capsys.readouterr().err
    run.write_text(json.dumps(told))
    drive.write_text(json.dumps(json.loads(drive.read_text()) | {"started": "2020-01-01T00:00:00+00:00"}))
    assert main([*arguments, "--anyway"]) == 2
    assert "is older than the run that it evaluates" in capsys.readouterr().err
    assert main([*arguments, "--anyway", "--rare", "0.3"]) == 2
    assert "contains a study with other settings" in capsys.readouterr().err


def test_invalid_studies_are_refused(data, tmp_path):
    given = StudySets(data.path, data.path, (data.path,))
    with pytest.raises(UsageError, match="baseline 'bc' is missing"):
        Study(LONGTAIL, StudyConfig(arms=("baseline",)), given, tmp_path)
    with pytest.raises(UsageError, match="unknown arm 'heuristics'"):
        Study(LONGTAIL, StudyConfig(arms=("baseline", "bc", "heuristics")), given, tmp_path)
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


def test_changed_claims_are_refused_when_a_study_resumes(data, tmp_path):
    sets = StudySets(data.path, data.path, (data.path,))
    runner._open_folder(Study(LONGTAIL, StudyConfig(), sets, tmp_path / "study"))
    runner._open_folder(Study(LONGTAIL, StudyConfig(), sets, tmp_path / "study"))
    fewer = replace(LONGTAIL, claims=LONGTAIL.claims[:-1])
    with pytest.raises(UsageError, match="contains a study with other arms or claims"):
        runner._open_folder(Study(fewer, StudyConfig(), sets, tmp_path / "study"))


def test_evaluated_run_without_checkpoints_is_not_trained_again(data, tmp_path):
    study = Study(LONGTAIL, StudyConfig(), StudySets(data.path, data.path, (data.path,)), tmp_path)
    study.evaluation("bc", 0).mkdir(parents=True)
    with pytest.raises(UsageError, match=r"has evaluations, but no checkpoints; remove .*bc.*seed-0"):
        runner._run_job(runner.Job(study, "bc", 0, np.zeros((1, 1), bool)))
