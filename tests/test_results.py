"""Pages of results show what is stored, and nothing else."""

import json
import re
import types

import numpy as np
import pytest

from drivax import settings
from drivax.learning import TrainConfig
from drivax.stats.significance import holm_adjust
from drivax.studies.definition import load_study
from drivax.tasks.actions import Route
from drivax.tracking.run_folder import policy_folder, zoo
from experiment_scripts import load_script


@pytest.fixture(scope="module")
def script():
    """A module of ``experiments``, by its name."""
    return load_script


@pytest.fixture(scope="module")
def stored(repository):
    """A stored result, by its name."""
    folder = repository / "experiments" / "results"
    return lambda name: json.loads((folder / f"{name}.json").read_text())


def test_algorithm_pages_show_stored_results(script, stored):
    tables = script("learning.tables")
    learning, training = stored("learning"), stored("training")
    pages = list(tables.pages())
    assert {page.stem for page in pages} >= {"learning", "bc", "ppo", "sac", "warm-start"}
    for page in pages:
        text = page.read_text()
        shown = tables.fill_page(page, learning, training) == text
        assert shown, "run python -m experiments.learning.presets table, and read what the pages say about it"
        assert text.count("<!-- presets.py: end -->") * 2 == text.count("<!-- presets.py: ")
    for name in learning.get("curves", {}):
        assert tables.curve_file(name).is_file()


def test_speed_page_shows_stored_measurements(script, stored):
    simulator = script("speed.simulator")
    table = simulator.table(stored("simulator"), stored("simulator_runs"))
    shown = f"{simulator.BEGIN}\n\n{table}\n\n{simulator.END}" in simulator.PAGE.read_text()
    assert shown, "run python -m experiments.speed.simulator --table, and read what the page says about it"


def test_speed_page_shows_evaluation_times(script, stored):
    timing = script("speed.evaluation")
    shown = (
        f"{timing.BEGIN}\n\n{timing.table(stored('evaluation'))}\n\n{timing.END}" in timing.PAGE.read_text()
    )
    assert shown, "run python -m experiments.speed.evaluation --table, and read what the page says about it"


def test_real_files_page_shows_each_planner(script, stored):
    real = script("data.real_files")
    shown = f"{real.BEGIN}\n\n{real.tables(stored('real_files'))}\n\n{real.END}" in real.PAGE.read_text()
    assert shown, "run python -m experiments.data.real_files --table, and read what the page says about it"


def test_benchmark_page_shows_stored_results(script, stored):
    benchmark = script("learning.benchmark")
    text = benchmark.PAGE.read_text()
    shown = benchmark.fill_page(text, benchmark.page_tables(stored("benchmark"))) == text
    assert shown, "run python -m experiments.learning.benchmark table, and read what the page says about it"
    rows = stored("benchmark")["planners"]
    assert rows["expert"]["log"]["accuracy"]["mean"] == 1.0


def test_progress_until_failure(script):
    # 1 m a step from step 10 on: hits at step 13 and leaves the road later, fails never, fails at once.
    motion = np.zeros((3, 6, 4))
    motion[:, :, 0] = np.arange(6)
    events = {"collision": np.array([13, -1, -1]), "offroad": np.array([14, -1, 10])}
    trajectories = types.SimpleNamespace(events=events, ego=motion, start=10)
    results = types.SimpleNamespace(trajectories=trajectories)
    found = script("learning.benchmark").metrics_until_failure(results)
    np.testing.assert_array_equal(found["steps_until_failure"], [3, 5, 0])
    np.testing.assert_array_equal(found["metres_until_failure"], [3, 5, 0])


def test_goals_are_judged_by_the_end_of_the_interval(script):
    benchmark = script("learning.benchmark")
    reached = {
        "differences": {
            "log": {
                "ppo - pdm": {"accuracy": of(0.05), "at_fault_collision": of(0.005), "vmax_score": of(0.015)}
            }
        },
        "planners": {
            "ppo": {"log": {"success": of(0.86), "accuracy": of(0.97)}},
            "self_play": {"log": {"km_per_fault": of(9.0)}},
        },
    }
    rows = [line.strip("| ").split(" | ") for line in benchmark.goals_table(reached)[2:]]
    assert [(row[0].rpartition(": ")[2], row[-1]) for row in rows] == [
        ("accuracy", "aim"), ("success", "**no**"),
        ("accuracy", "aim"), ("vmax score", "goal"), ("at fault", "**no**"),
        ("km per fault", "**no**"),
    ]  # fmt: skip


def test_distances_are_relative_to_those_of_the_expert(script):
    benchmark = script("learning.benchmark")
    driven, expert = (
        benchmark.Episodes({"distance": np.array(d)}, np.zeros(2), {}) for d in ([[3.0, 1]], [[2.0, 0]])
    )
    np.testing.assert_array_equal(benchmark.distance_ratio(driven, expert), [[1.5, np.nan]])


def test_planners_along_the_route_are_marked(script, stored, repository):
    tables, learning = script("learning.tables"), stored("learning")

    def plans_along_route(name, *overrides):
        return isinstance(settings.load(TrainConfig, name, overrides).task.actions, Route)

    on_route = {name for name in learning["training"] if plans_along_route(name)}
    assert on_route == set(tables.ON_ROUTE)
    in_zoo = {name for name in zoo() if plans_along_route(policy_folder(name) / "config.yaml")}
    assert {name for name in zoo() if tables.label(name).endswith("(route)")} == in_zoo
    for page in ("learning", "benchmark", "real-files"):
        text = (repository / "docs" / "results" / f"{page}.md").read_text()
        # The table of changed definitions has presets of before.
        blocks = re.findall(r"<!-- \w+\.py: (?!changes|end).*?-->(.*?)<!-- \w+\.py: end -->", text, re.S)
        rows = [line for block in blocks for line in block.splitlines() if line.startswith("|")]
        assert len(rows) > 10
        for row in rows:
            assert all(f"`{name}` (route)" in row for name in on_route if f"`{name}`" in row), row


@pytest.mark.slow
def test_evaluations_are_compared_in_pairs(script, tmp_path, monkeypatch):
    benchmark = script("learning.benchmark")
    monkeypatch.setattr(benchmark, "EPISODES", tmp_path)
    monkeypatch.setattr(benchmark, "FORMER_EPISODES", tmp_path / "former")
    monkeypatch.setattr(benchmark, "POLICIES", tmp_path / "policies")
    few = {name: name for name in (*benchmark.DIFFERENCE_METRICS, "collision", "offroad", "distance_ratio")}
    monkeypatch.setattr(benchmark, "COLUMNS", few)
    for seed in ("seed-0", "seed-1"):
        (tmp_path / "policies" / "bc" / seed).mkdir(parents=True)
    names = (*benchmark.COLUMNS, *benchmark.FAILURE_METRICS, "distance")
    columns = dict.fromkeys(names, np.array([[0.0, 1.0, np.nan]]))

    def keep(name, kind, accuracy, test="a"):
        about = {"planner": name, "traffic": kind, "seeds": len(accuracy), "test": test}
        values = columns | {"accuracy": np.array(accuracy)}
        np.savez(
            benchmark.episodes_file(name, kind), about=json.dumps(about), segment=["s", "s", "t"], **values
        )

    tags = {tag: ["few", "many", "many"] for tag in benchmark.TAGS}
    np.savez(tmp_path / benchmark.STRATA, test="a", **tags)
    keep("idm", "log", [[1, 1, 0]])
    keep("idm", "idm", [[1, 0, 0]])
    keep("bc", "log", [[1, 1, 1], [1, 1, 0]])
    keep(benchmark.BOX, "log", [[0, 0, 0]])
    with pytest.raises(SystemExit, match="drive the expert"):
        benchmark.compute_results()
    keep("expert", "log", [[1, 1, 1]])
    found = benchmark.compute_results()
    assert found["planners"]["bc"]["seeds"] == 2
    np.testing.assert_allclose(found["planners"]["bc"]["log"]["accuracy"]["mean"], 5 / 6)
    assert list(found["reactive"]) == ["idm"]
    np.testing.assert_allclose(found["reactive"]["idm"]["accuracy"]["mean"], -1 / 3)
    assert (
        list(found["differences"]["log"]) == ["expert - idm", "bc - idm"] and not found["differences"]["idm"]
    )
    np.testing.assert_allclose(found["differences"]["log"]["bc - idm"]["accuracy"]["mean"], 1 / 6)
    # One of the three episodes is at fault, and 1 m is driven in all.
    fault = found["planners"]["idm"]["log"][benchmark.KM_PER_FAULT]
    assert fault["mean"] == pytest.approx(0.001) and fault["n"] == 1
    few, many = found["strata"][:2]
    assert (few["value"], few["scenarios"], few["planners"]["bc"]["mean"]) == ("few", 1, 1.0)
    assert (many["scenarios"], many["planners"]["idm"]["mean"]) == (2, 0.5)
    shown = benchmark.page_tables(found)
    assert [line.split(" | ")[:2] for line in shown["idm"][2:]] == [["| `idm`", "1"]]
    assert shown["random"][2].startswith(f"| {benchmark.BOX} | `log` | 0.5")
    # A training that is no preset is in the table of its comparison only.
    for name in ("encoder_mlp", "encoder_lq"):
        (tmp_path / "policies" / name / "seed-0").mkdir(parents=True)
        (tmp_path / "policies" / name / "training.json").write_text('{"seeds": 1, "seconds": 9}')
    keep("encoder_mlp", "log", [[1, 0, 0]])
    keep("encoder_lq", "log", [[1, 1, 1]])
    assert list(benchmark.compute_results()["planners"]) == list(found["planners"])
    presets = script("learning.presets")
    monkeypatch.setattr(presets, "POLICIES", tmp_path / "policies")
    mlp, lq = presets.compare_trainings(("encoder_mlp", "encoder_lq", "encoder_entity")).values()
    assert mlp["differences"] == {} and lq["seconds"] == 9
    np.testing.assert_allclose(lq["differences"]["accuracy"]["mean"], 2 / 3)
    keep("pdm", "log", [[1, 1, 1]], test="b")
    with pytest.raises(SystemExit, match="2 test sets"):
        benchmark.compute_results()


def test_curation_page_shows_stored_results(script, stored):
    curation = script("curation.methods")
    shown = curation.fill_page(curation.PAGE.read_text(), stored("curation")) == curation.PAGE.read_text()
    assert shown, "run python -m experiments.curation.methods table, and read what the page says about it"


def test_page_of_critical_moments_shows_stored_results(script, stored, repository):
    moments, result = script("curation.moments"), stored("critical_moments")
    page = (repository / "docs" / "results" / "critical-moments.md").read_text()
    assert moments.fill_places(page, "moments.py", moments.page_tables(result)) == page
    scores = [moment["scenario_score"] for moment in result["moments"]]
    assert len(scores) == moments.MOMENTS and scores == sorted(scores, reverse=True)
    assert {moment["scenario"] for moment in result["moments"]} == set(moments.VERDICTS)


def test_mixtures_page_shows_stored_results(script, stored):
    module, result = script("learning.mixtures"), stored("mixtures")
    text = module.PAGE.read_text()
    shown = module.fill_places(text, "mixtures.py", module.page_tables(result)) == text
    assert shown, "run python -m experiments.learning.mixtures table, and read what the page says about it"
    for name, policy in result["policies"].items():
        for other, difference in policy["differences"].items():
            means = result["drivers"].get(other)
            means = means or result["policies"][f"{name.partition('/')[0]}/{other}"]["means"]
            expected = policy["means"]["success"]["mean"] - means["success"]["mean"]
            assert difference["success"]["mean"] == pytest.approx(expected, abs=1e-9)


def test_td3_bc_beats_clones_and_drivers_of_the_mixture(script, stored):
    """The claim of the page: better success than both clones and than the best drivers, with healthy critics."""
    best = stored("mixtures")["policies"]["mixed/td3_bc"]
    page = " ".join(script("learning.mixtures").PAGE.read_text().split())
    for difference in best["differences"].values():
        assert "{mean:.3f} [{low:.3f}, {high:.3f}]".format(**difference["success"]) in page
        assert "{mean:.3f}".format(**difference["vmax_score"]) in page
    for metric in ("success", "vmax_score"):
        assert all(difference[metric]["low"] > 0.0 for difference in best["differences"].values())
    assert {"bc", "filtered_bc", "pdm"} <= best["differences"].keys()


def test_no_algorithm_is_worse_than_cloning_of_the_log(stored):
    """The claim of the page, at events."""
    policies = {
        name: own for name, own in stored("mixtures")["policies"].items() if name.startswith("expert/")
    }
    assert len(policies) == 5
    for name in policies.keys() - {"expert/bc"}:
        for metric in ("success", "vmax_score", "at_fault_collision", "offroad", "progress_ratio"):
            difference = policies[name]["differences"]["bc"][metric]
            assert difference["low"] < 0.0 < difference["high"] and round(abs(difference["mean"]), 3) <= 0.018
        assert all(
            "0.0% of the episodes fail" in " ".join(problems) for problems in policies[name]["critics"]
        )


def test_cql_page_quotes_the_comparison_with_corl(stored, repository):
    page, result = (repository / "docs" / "algorithms" / "cql.md").read_text(), stored("corl")
    for name, label in (("drivax", "our CQL"), ("corl", "CORL's code")):
        assert f"| {label} | {', '.join(map(str, result[name]['returns']))} |" in page
    assert ", ".join(str(result["data"][name]["mean"]) for name in ("random", "medium", "good")) in page


def test_curation_and_planners_share_the_test_set(stored):
    assert stored("curation")["sets"]["test"] == stored("benchmark")["test"]["hash"]


def test_kinematic_finds_the_events_that_force_a_reaction(stored, repository):
    """The target is 0.80, on scenarios that neither set its weights nor were looked at before."""
    found = stored("curation")
    tests = found["methods"]["kinematic"]["events"]["forced"], found["checks"]["fresh"]
    assert all(one["auc_interval"][0] > 0.8 for one in tests)
    control = found["methods"]["random_matched"]["events"]["forced"]["auc_interval"]
    assert control[0] < 0.5 < control[1]
    auc = f"the probability is {found['methods']['kinematic']['events']['forced']['auc']:.3f}"
    assert auc in (repository / "docs" / "guide" / "critical-scenarios.md").read_text()


def test_members_disagree_where_they_err(stored):
    low, high = stored("curation")["methods"]["ensemble"]["error_rank_interval"]
    assert 0.0 < low < high


@pytest.fixture
def found(script):
    """What the long-tail study found."""
    return json.loads(script("longtail").result_file("longtail").read_text())


@pytest.mark.parametrize("name", ["longtail", "longtail2_screening"])
def test_longtail_pages_show_stored_results(script, stored, name):
    longtail = script("longtail")
    text = longtail.PAGES[name].read_text()
    assert f"<!-- longtail.py: {name} rates rare -->" in text
    assert longtail.fill_page(text, name, stored(name)) == text, (
        f"run python -m experiments.longtail table {name}, and read what the page says about it"
    )


def test_longtail2_text_quotes_the_screening(script, stored):
    """Ranges and means of the findings, and the sizes for which the power was computed."""
    found, page = stored("longtail2_screening"), script("longtail").PAGES["longtail2"].read_text()
    text = " ".join(page.split())
    assert "<!-- longtail.py: power -->" in page and "| 8 | 4,504 |" in page

    def errors(*algorithms):
        seeds = [seed for arm, own in found["critics"].items() if arm.startswith(algorithms) for seed in own]
        return [float(error) for error in re.findall(r"Q is off by (\d+\.\d+)", json.dumps(seeds))]

    def at_fault(stratum, *algorithms):
        arms = (arm for arm in found["draws"] if arm.startswith(algorithms))
        return [found["rates"][arm][stratum]["at_fault_collision"]["mean"] for arm in arms]

    assert "off by {:.2f} to {:.2f} standard".format(*_ends(errors("td3_bc"))) in text
    assert "CQL+BC are off by {:.2f} to {:.2f}".format(*_ends(errors("cql"))) in text
    best, others = at_fault("common", "td3_bc", "filtered_bc"), at_fault("common", "cql")
    assert "are between {:.3f} and {:.3f}".format(*_ends(best)) in text
    assert "CQL+BC between {:.3f} and {:.3f}".format(*_ends(others)) in text
    arms = (
        "td3_bc_heuristic",
        "td3_bc_heuristic_scenario",
        "td3_bc",
        "td3_bc_random",
        "td3_bc_random_scenario",
    )
    rare = {
        arm: f"{rates['rare']['at_fault_collision']['mean']:.3f}" for arm, rates in found["rates"].items()
    }
    sentence = "{} by step and {} by scenario, against {} with uniform sampling, and {} and {} with"
    assert sentence.format(*(rare[arm] for arm in arms)) in text
    assert all(seeds == [None, None] or all(seeds) for seeds in found["critics"].values())


def _ends(values):
    return min(values), max(values)


def test_longtail_rates_follow_from_collision_counts(found):
    """Mean over the whole test of every arm, from the number of its episodes with a collision by seed."""
    about = found["about"]
    assert list(found["collisions"]) == list(found["rates"])
    for name, rates in found["rates"].items():
        counts = found["collisions"][name]
        assert len(counts) == (1 if name in load_study("longtail").planners else about["seeds"])
        rare = about["rare"] / about["test"]
        whole = rare * rates["rare"]["collision"]["mean"] + (1 - rare) * rates["common"]["collision"]["mean"]
        np.testing.assert_allclose(np.mean(counts) / about["test"], whole, atol=1e-9)


def test_longtail_verdicts_hold_under_joint_adjustment(found):
    """As its page says."""
    claims = found["claims"]
    together = holm_adjust([one["p"] for one in claims])
    assert [p < 0.05 for p in together] == [one["verdict"] != "undecided" for one in claims]


@pytest.fixture
def supplement(stored):
    """What the runs of the long-tail study show beyond its claims."""
    return stored("longtail_supplement")


def test_longtail_page_shows_the_supplement(script, supplement):
    module = script("longtail_supplement")
    text = module.PAGE.read_text()
    assert module.fill_page(text, supplement) == text, (
        "run python -m experiments.longtail_supplement page, and read what the page says about it"
    )
    assert text.count("<!-- longtail_supplement.py: end -->") == len(module.page_tables(supplement))
    assert f"]({module.PICTURE.name})" in text and module.PICTURE.stat().st_size < 200_000


def test_differences_from_bc_follow_from_the_rates(found, supplement):
    assert set(supplement["against_bc"]) == set(found["draws"]) - {"bc"}
    for arm, differences in supplement["against_bc"].items():
        for stratum, difference in differences.items():
            rates = [found["rates"][name][stratum]["collision"]["mean"] for name in (arm, "bc")]
            np.testing.assert_allclose(difference["mean"], rates[0] - rates[1], atol=1e-9)
            assert difference["low"] < difference["mean"] < difference["high"]


def test_correlations_with_progress_follow_from_the_rates(found, supplement):
    rates = [found["rates"][arm] for arm in found["draws"]]
    correlations = supplement["progress"]
    assert correlations["arms"] == len(rates) == 16
    for collisions in ("common", "rare"):
        for progress in ("common", "rare"):
            means = [
                (one[collisions]["collision"]["mean"], one[progress]["progress_ratio"]["mean"])
                for one in rates
            ]
            expected = np.corrcoef(np.transpose(means))[0, 1]
            np.testing.assert_allclose(correlations[collisions][progress], expected, atol=1e-9)


def test_kinds_of_scenarios_follow_from_the_rates(found, supplement):
    kinds, about = supplement["kinds"], found["about"]
    assert sum(kind["scenarios"] for kind in kinds.values()) == about["test"]
    assert kinds["event"]["scenarios"] == about["rare"]
    np.testing.assert_allclose(sum(kind["share"] for kind in kinds.values()), 1.0)
    np.testing.assert_allclose(kinds["event"]["share"], about["share"])
    for arm in found["draws"]:
        rate = sum(kind["share"] * kind["rates"][arm] for kind in kinds.values())
        np.testing.assert_allclose(rate, found["rates"][arm]["ordinary"]["collision"]["mean"], atol=1e-9)


def test_logs_of_the_longtail_study_hold_no_failure(supplement):
    rewards = supplement["rewards"]
    assert rewards["failures"] == 0
    np.testing.assert_allclose(rewards["largest"], 0.2, atol=1e-6)
    assert rewards["return"] < rewards["largest"] / (1.0 - rewards["discount"])


def test_critic_curves_cover_the_training(found, supplement):
    critics = supplement["critics"]
    assert set(critics["arms"]) == set(found["draws"]) - {"bc"}
    assert critics["steps"][-1] == 6_000 * 256
    for curves in critics["seeds"].values():
        assert np.shape(curves) == (found["about"]["seeds"], len(critics["steps"]))
    # The mean Q of the baseline at its validations, on held-out steps, is near that of the training steps.
    held_out = np.mean([seed["rule"] for seed in found["validations"]], axis=0)
    trained = np.mean(critics["seeds"]["loss/mean_q"], axis=0)[4::5]
    np.testing.assert_allclose(trained, held_out, atol=0.3)


def test_longtail_text_quotes_the_supplement(script, found, supplement):
    """Numbers in the paragraphs, which no script writes."""
    text = " ".join(script("longtail_supplement").PAGE.read_text().split())
    against = {arm: values["rare"] for arm, values in supplement["against_bc"].items()}

    def quoted(difference, sign="+"):
        bounds = ", ".join(f"{difference[name]:{sign}.3f}" for name in ("low", "high"))
        return f"{difference['mean']:{sign}.3f} [{bounds}]"

    assert f"by {quoted(against['baseline'], '')}." in text
    for arm in ("heuristic", "action_rarity", "action_rarity_scenario", "oracle"):
        assert quoted(against[arm]) in text
    methods = [arm for arm in found["draws"] if arm.startswith(("heuristic", "ensemble", "action_rarity"))]
    assert len(methods) == 6 and all(against[arm]["high"] > 0 for arm in methods)
    controls = [arm for arm in against if arm.startswith("random_matched")]
    assert len(controls) == 5 and all(against[arm]["low"] > 0 for arm in ("baseline", *controls))
    rates, share = found["rates"]["baseline"], found["about"]["share"]
    without_event = (
        (1 - share) * rates["common"]["collision"]["mean"] / rates["ordinary"]["collision"]["mean"]
    )
    assert (
        f"{without_event:.0%}".replace("%", " %") + " of the baseline's collisions in ordinary traffic"
        in text
    )
    detectable = found["detectable"]["collision"] / rates["ordinary"]["collision"]["mean"]
    assert f"{detectable:.0%}".replace("%", " %") + " of the baseline's collisions" in text
    errors, temperatures = (
        np.mean(supplement["critics"]["seeds"][name], axis=0)[4::5]
        for name in ("loss/critic", "loss/temperature")
    )
    assert f"rises from {errors[0]:.2f} at the first validation to {errors[-1]:.2f} at the last" in text
    assert f"temperature rises from {temperatures[0]:.2f} to {temperatures[-1]:.2f}" in text
    ends = {
        name: [curves[name][-1] for arm, curves in supplement["critics"]["arms"].items() if arm != "baseline"]
        for name in ("loss/critic", "loss/temperature")
    }
    low, high = min(ends["loss/critic"]), max(ends["loss/critic"])
    assert f"TD errors of {low:.2f} to {high:.2f}" in text
    low, high = min(ends["loss/temperature"]), max(ends["loss/temperature"])
    assert f"temperatures of {low:.2f} to {high:.2f}" in text
    q = np.mean(supplement["critics"]["seeds"]["loss/mean_q"], axis=0)[-1]
    assert f"mean Q of logged actions falls to {q:.1f}" in text
    assert f"discounted return is {supplement['rewards']['return']:.1f}." in text
    assert f"r = {supplement['progress']['rare']['rare']:.2f} over the 16 arms" in text


def test_nuplan_page_shows_stored_counts(script, stored):
    nuplan = script("data.nuplan")
    shown = (
        f"{nuplan.BEGIN}\n\n{nuplan.agreement_table(stored('nuplan'))}\n\n{nuplan.END}"
        in nuplan.PAGE.read_text()
    )
    assert shown, "run python -m experiments.data.nuplan --table, and read what the page says about it"


def test_offline_page_shows_stored_speed(script, stored):
    offline = script("speed.offline")
    shown = (
        f"{offline.BEGIN}\n\n{offline.table(stored('offline'))}\n\n{offline.END}" in offline.PAGE.read_text()
    )
    assert shown, "run python -m experiments.speed.offline --table, and read what the page says about it"


def of(mean, half=0.01):
    return {"mean": mean, "low": mean - half, "high": mean + half, "n": 9, "by_seed": [mean, mean]}


def compared(mean):
    return dict.fromkeys(("success", "accuracy", "at_fault_collision", "offroad", "vmax_score"), of(mean))


@pytest.fixture
def learning():
    columns = (
        "success", "accuracy", "accuracy_at_fault", "vmax_score", "collision", "offroad", "progress_ratio",
    )  # fmt: skip
    planners = {
        name: dict.fromkeys(columns, of(mean)) for name, mean in (("idm", 0.7), ("bc", 0.6), ("ppo", 0.85))
    }
    nowhere = {"mean": None, "low": None, "high": None, "n": 0}
    return {
        "planners": planners | {"idm": planners["idm"] | {"offroad": nowhere}},
        "training": {"bc": {"seconds": 300, "seeds": 2}, "ppo": {"seconds": 1500, "seeds": 2}},
        "differences": {
            "ppo - idm": {"success": of(0.15), "vmax_score": of(0.005)},
            "ppo - bc": {"success": of(0.25), "vmax_score": of(-0.25)},
        },
        "comparisons": {
            "encoders": {
                "mlp": {"seeds": 2, "seconds": 90, "results": compared(0.5), "differences": {}},
                "lq": {"seeds": 2, "seconds": 1800, "results": compared(0.6), "differences": compared(0.1)},
            }
        },
        "curves": {
            "ppo": {"success": {"seed-0": [[100, 0.2], [200, 0.8]], "seed-1": [[100, 0.3], [200, 0.7]]}}
        },
    }


def test_learning_tables_show_stored_results(script, learning):
    tables = script("learning.tables")
    training = {
        "training": {"ppo": {"steps_per_second": 9000, "share": {"simulation": 0.25, "update": 0.75}}}
    }

    def lines(what, *names, page=tables.FOLDER / "ppo.md"):
        return tables.format_block(what, list(names), learning, training, page).splitlines()

    rows = [line.split(" | ") for line in lines("reached")]
    assert [row[0] for row in rows[2:]] == ["| `ppo` (route)", "| `idm`", "| `bc`"]
    assert rows[2][1] == "0.850 [0.840, 0.860]" and rows[3][6] == "-"
    assert (
        lines("differences")[2]
        == "| `ppo` (route) - `idm` | +0.150 [+0.140, +0.160] | +0.005 [-0.005, +0.015] |"
    )
    assert lines("training")[3] == "| `ppo` (route) | 2 | 1,500 |"
    heads, _, mlp, lq, difference = (line.split(" | ") for line in lines("comparison", "encoders"))
    assert heads[:4] == ["| training", "seeds", "core time (s)", "`success`"]
    assert mlp[:4] == ["| `mlp`", "2", "90", "0.500 [0.490, 0.510]"] and lq[2] == "1,800"
    assert (difference[0], difference[3]) == ("| `lq` (route) - `mlp`", "+0.100 [+0.090, +0.110]")
    assert lines("speed")[2] == "| ppo | 9,000 | 25% | 75% |"
    shown = lines("curves", "ppo", "bc")
    assert shown[0] == "![Learning curves of ppo](curve-ppo.png)" and "2 seeds" in shown[2]
    assert shown[-1] == "No curves of preset `bc` are stored yet."
    there = lines("curves", page=tables.DOCS / "results" / "learning.md")
    assert there[0] == "![Learning curves of ppo](../algorithms/curve-ppo.png)" and len(there) == 3
    # Kilometres per collision, without any collision.
    assert tables.interval({"mean": None, "low": 18.04, "high": None}, digits=1) == "above 18.0"
    assert tables.interval({"mean": None, "low": None, "high": None}) == "-"


def test_training_time_is_that_of_the_median_speed(script):
    """600 steps at 20 steps/s; the first row has the compilation in it, and no row a pause."""
    rates = np.array([[200, 2.0], [400, 20.0], [600, 25.0]])
    training = types.SimpleNamespace(curves={"steps_per_second": rates})
    assert script("learning.presets").training_seconds(training) == 30


def test_curves_show_every_seed(script, learning):
    curves = learning["curves"]["ppo"]
    figure = script("learning.tables").draw_curves("ppo", curves, seconds=60.0)
    (axes,) = figure.axes
    assert axes.get_ylabel() == "validation success"
    figure.canvas.draw()
    (minutes,) = axes.child_axes
    # 200 steps take a minute.
    np.testing.assert_allclose(minutes.get_xlim(), np.divide(axes.get_xlim(), 200.0))
    for line, (seed, points) in zip(axes.lines, curves["success"].items(), strict=True):
        assert line.get_label() == seed
        np.testing.assert_array_equal(line.get_xydata(), points)


def test_speed_page_shows_ratios_against_the_earlier_state(script, stored):
    ratios = script("speed.ratios")
    for comparison in ratios.COMPARISONS:
        table = ratios.table(stored("speed_ratios")[comparison.key], comparison)
        assert f"{comparison.begin}\n\n{table}\n\n{comparison.end}" in ratios.PAGE.read_text()


def test_speed_page_shows_stored_times_of_commands(script, stored):
    commands = script("speed.commands")
    table = commands.table(stored("command_times")["rows"])
    assert f"{commands.BEGIN}\n\n{table}\n\n{commands.END}" in commands.PAGE.read_text()


def test_pages_show_the_stored_demo(script, stored):
    demo = script("demo")
    for page in demo.PAGES:
        text = page.read_text()
        assert demo.fill(text, stored("demo")) == text and "<!-- demo.py: planners -->" in text
    by_planner = {one["planner"]: one["metrics"] for one in stored("demo")["summaries"]}
    assert "policy (route)" in by_planner
    differences = stored("demo")["policy_minus"]
    # What the pages say.
    assert differences["constant_speed"]["success"]["low"] > 0 < differences["idm"]["vmax_score"]["low"]
    assert differences["idm"]["success"]["low"] < 0 < differences["idm"]["success"]["high"]


def test_robustness_page_shows_stored_outcomes(script, stored):
    robustness = script("robustness")
    table = robustness.table(stored("kills"), stored("soak"))
    shown = f"{robustness.BEGIN}\n\n{table}\n\n{robustness.END}" in robustness.PAGE.read_text()
    assert shown, "run python -m experiments.robustness page"
