"""The page of a long-tail study, of results that are known; in a browser."""

import json
from dataclasses import replace

import numpy as np
import pytest

from browser import acted, browse, needs_browser
from drivax.curation.scores import ScoreTable
from drivax.studies.definition import load_study
from drivax.studies.report import (
    critics_table,
    events_table,
    rankings_table,
    rates_table,
    validations_table,
    write_report,
)
from drivax.studies.verdicts import compare_rankings

LONGTAIL = load_study("longtail")
METRICS = LONGTAIL.metrics
RATE = {metric: {"mean": 0.1234, "low": 0.1, "high": 0.15} for metric in METRICS}
CLAIM = {"words": "a < b & c", "arm": "heuristic", "reference": "baseline", "group": "control", "metric": "collision",
    "rows": "ordinary"}  # fmt: skip
RESULTS = {
    "about": {"seeds": 5, "train": 4096, "test": 1126, "rare": 563, "labelled": True, "share": 0.05},
    "conditions": [
        {"arm": name, "progress": 0.93, "least": 0.9, "change": 0.004, "moved": 0.01, "met": name == "baseline"}
        for name in ("baseline", "heuristic")
    ],
    "detectable": dict.fromkeys(METRICS, 0.031),
    "claims": [
        {
            "claim": CLAIM | {"change": None}, "verdict": "supported", "needed": "", "difference": -0.05,
            "interval": [-0.08, -0.02], "p": 0.001, "adjusted": 0.02, "change": [-0.3, -0.5, -0.1],
        },
        {
            "claim": CLAIM | {"change": None}, "verdict": "undecided", "needed": "41 seeds each", "difference": None,
            "interval": None, "p": None, "adjusted": None, "change": None, "slower_arm": ["baseline", 0.84],
        },
    ],
    "rates": {name: {"ordinary": RATE, "rare": RATE} for name in ("expert", "baseline", "cql")},
    "critics": {"bc": [None, None], "baseline": [[], []], "cql": [["Q is off", "Q < 0"], [], ["Q is off"]]},
    "events": {
        "expert": {"cut_in": RATE["collision"]},
        "baseline": dict.fromkeys(("cut_in", "below 3 m/s2"), RATE["collision"]),
    },
    "draws": {"baseline": dict.fromkeys(("effective", "effective_scenarios", "tilt", "largest", "concentration"), 1.0)},
    "rankings": [
        {
            "methods": ["kinematic", "ensemble"], "rho": 0.41, "interval": [0.35, 0.47], "overlap": 0.2,
            "orthogonal": "contradicted",
        }
    ],
    "rule_cost": {"collision": {"difference": 0.2, "interval": [0.1, 0.3]}},
    "validations": [
        {"rule": [1.0, 0.5], "score": [0.25, 0.5], "progress": [0.5, 0.75]},
        {"rule": [0.0, 2.0], "score": [0.5, 0.75], "progress": [0.5, 0.75]},
    ],
}  # fmt: skip


@pytest.fixture
def page(tmp_path):
    rng = np.random.default_rng(0)
    steps = rng.random((20, 91))
    table = ScoreTable(
        "kinematic",
        {},
        "hash",
        tuple(f"drive-{row}" for row in range(20)),
        np.ones((20, 91), bool),
        steps,
        steps.mean(axis=1),
        {"urgency": steps},
    )
    kept = replace(table, method="ensemble", components={})  # of a study that was continued elsewhere
    tables = {"kinematic": table, "ensemble": kept}
    tables |= {name: replace(kept, method=name) for name in ("uniform", "oracle")}
    write_report(LONGTAIL, RESULTS, tables, rng.normal(0, 0.3, (500, 2)), tmp_path / "report.html")
    return tmp_path / "report.html", table


def test_report_shows_the_results(page):
    path, table = page
    text = path.read_text()
    assert "2 claims: 1 supported, 0 contradicted, 1 undecided" in text
    assert "a &lt; b &amp; c" in text and "-0.050 [-0.080, -0.020]" in text and "-30% [-50%, -10%]" in text
    assert "▲ supported" in text and "41 seeds each" in text
    assert "(baseline at 0.84 of the speed limit)" in text and text.count("of the speed limit") == 1
    assert "<h3>Events: collision</h3>" in text
    rows = [["baseline", "2 of 2", ""], ["cql", "1 of 3", "Q is off; Q < 0"]]
    assert [[cell.text for cell in row] for row in critics_table(RESULTS).rows] == rows
    labels = [row[0].text for row in rates_table(RESULTS, "ordinary").rows]
    assert labels == ["expert", "baseline", "cql (unhealthy critics)"]
    assert "Health of the critics" in text and "Q &lt; 0" in text
    rate = "0.123 [0.100, 0.150]"
    rows = [["expert", rate, ""], ["baseline", rate, rate]]
    assert [[cell.text for cell in row] for row in events_table(RESULTS).rows] == rows
    assert "1,126 test scenarios (563 of them rare, labelled)" in text
    assert "The conditions of the comparison are not met" not in text
    assert (
        "kinematic and ensemble" in text
        and "+0.41 [+0.35, +0.47]" in text
        and "the same checkpoint for 1 of the 2 seeds" in text
    )
    rows = [["mean_q, mean over seeds", "0.500", "1.250"], ["score, mean over seeds", "0.375", "0.625"]]
    rows += [["seeds with their highest mean_q", "1", "1"], ["seeds with their highest score", "0", "2"]]
    assert [[cell.text for cell in row] for row in validations_table(RESULTS, "mean_q").rows] == rows
    assert "seeds with their highest mean_q" in text
    assert table.scenario_ids[int(table.scenarios.argmax())] in text
    assert "Play those of kinematic and ensemble in <a href=critical.html>" in text
    assert "oracle: scores" in text and "<th scope=row>oracle" not in text
    assert "ensemble: scores of scenarios" in text and "uniform: scores" not in text
    assert "Better than the matched random control?" in text and "than the baseline?" not in text
    assert "their share of ordinary traffic, 5.0%" in text
    assert "Common scenarios" not in text  # there are none in these results


def test_latest_of_equal_validation_scores_counts():
    results = RESULTS | {"validations": [{"rule": [1.0, 0.0], "score": [0.5, 0.5]}]}
    *_, row = validations_table(results, "mean_q").rows
    assert [cell.text for cell in row] == ["seeds with their highest score", "0", "1"]


def test_rule_may_be_undefined_at_a_validation():
    """A seed without the value at a validation; the others keep their columns."""
    seeds = [
        {"rule": [None, 2.0, 1.0], "score": [0.2, 0.3, 0.5]},
        {"rule": [3.0, 2.0, 4.0], "score": [0.5, 0.3, 0.6]},
    ]
    rows = validations_table(RESULTS | {"validations": seeds}, "mean_q").rows
    assert [[cell.text for cell in row] for row in rows[::2]] == [
        ["mean_q, mean over seeds", "–", "2.000", "2.500"], ["seeds with their highest mean_q", "0", "1", "1"]
    ]  # fmt: skip


def test_method_without_a_ranking_has_no_correlation():
    steps = {"heuristic": np.zeros((20, 91)), "kinematic": np.arange(20.0)[:, None] * np.ones(91)}
    ids = tuple(map(str, range(20)))
    tables = {
        name: ScoreTable(name, {}, "x", ids, np.ones((20, 91), bool), scores, scores[:, 0])
        for name, scores in steps.items()
    }
    rankings = compare_rankings(tables, ids)
    assert json.loads(json.dumps(rankings, allow_nan=False))[0]["rho"] is None
    ((_, rho, *_),) = rankings_table({"rankings": rankings}).rows
    assert rho.text == "–"


@needs_browser
def test_it_fits_a_phone(page, tmp_path):
    path, _ = page
    act = "document.body.dataset.wide = document.documentElement.scrollWidth - innerWidth;"
    dom = browse(acted(path, act), tmp_path, "--dump-dom", "--window-size=500,900")
    assert 'data-wide="0"' in dom
