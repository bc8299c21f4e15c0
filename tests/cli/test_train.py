"""Training by scores of criticality, through the command line."""

from __future__ import annotations

import json
import types

import pytest

from drivax.cli import main
from drivax.curation import methods
from drivax.errors import UsageError
from drivax.scenario.store import ScenarioSet
from drivax.synthetic.generate import Generation, generate
from drivax.tracking.progress import Progress
from drivax.tracking.sinks import read_rows

TINY = {
    "total_steps": 8,
    "task": {
        "observation": {"agents": 1, "steps": 1, "road": 0, "lights": 1, "route": 2},
        "metrics": "none",
    },
    "algorithm": {
        "kind": "bc", "network": {"encoder": {"rows": [4], "hidden": [4]}, "head": [4]}, "batch": 4, "updates": 2,
    },
}  # fmt: skip


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Two sets, a tiny configuration, and scores of the first set."""
    place = tmp_path_factory.mktemp("train")
    for seed in (3, 4):
        generate(place / f"set-{seed}", 2, seed, Generation(workers=0))
    (place / "tiny.yaml").write_text(json.dumps(TINY))
    call = ["curate", "uniform", "--data", str(place / "set-3"), "--out", str(place / "scores.npz")]
    assert main(call) == 0
    return place


def trained(place, data, out, *more):
    call = ["train", str(place / "tiny.yaml"), "--data", str(place / data), "--out", str(place / out)]
    return main([*call, *more])


@pytest.mark.slow
def test_scores_weight_the_training_data(place, capsys):
    scores = ("--scores", str(place / "scores.npz"), "--scale", "scenario")
    assert trained(place, "set-3", "weighted", *scores) == 0
    assert len(json.loads((place / "weighted" / "run.json").read_text())["weights"]) == 64
    capsys.readouterr()
    assert trained(place, "set-4", "other", *scores) != 0
    assert "scores belong to another set" in capsys.readouterr().err and not (place / "other").exists()
    assert trained(place, "set-3", "missing", "--scores", str(place / "none.npz")) != 0
    assert "score table not found" in capsys.readouterr().err


@pytest.mark.slow
def test_subset_trains_with_its_own_scores(place):
    curate = ["curate", "uniform", "--data", str(place / "set-3"), "--out", str(place / "whole.npz")]
    assert main([*curate, "--export", str(place / "top"), "1"]) == 0
    assert trained(place, "top", "by-own", "--scores", str(place / "top" / "scores.npz")) == 0
    assert len(json.loads((place / "by-own" / "run.json").read_text())["weights"]) == 64


def test_incompatible_flags_are_refused(place, capsys):
    assert trained(place, "set-3", "none", "--weighting.temperature", "2") == 2
    assert "--weighting without scores to weight; pass --scores or --arm" in capsys.readouterr().err
    assert trained(place, "set-3", "none", "--arm", "heuristic") == 2
    assert "arm heuristic is trained by cql, not " in capsys.readouterr().err
    rest = ["--data", str(place / "set-3"), "--out", str(place / "none")]
    call = ["train", "offline/cql", *rest]
    assert main([*call, "--arm", "cql_bc"]) == 2
    told = "arm cql_bc is trained by cql with imitation, not cql; use offline/cql_bc"
    assert told in capsys.readouterr().err
    assert main(["train", "offline/cql_bc", *rest, "--arm", "baseline"]) == 2
    assert "trained by cql, not cql with imitation; use offline/cql" in capsys.readouterr().err
    assert main([*call, "--scale", "scenario"]) == 2
    assert "--scale without scores to weight; pass --scores" in capsys.readouterr().err
    assert main([*call, "--arm", "heuristic", "--scale", "scenario"]) == 2
    assert "arm heuristic has its own scale; leave out --scale" in capsys.readouterr().err
    assert main([*call, "--arm", "oracle", "--weighting.uniform", "0"]) == 2
    assert "arm oracle has its own weights; leave out --weighting" in capsys.readouterr().err
    assert main([*call, "--arm", "random_matched", "--seeds", "2"]) == 2
    assert "2 seeds of random_matched in one program would share one permutation" in capsys.readouterr().err
    other = place / "braking.npz"
    curate = ["curate", "kinematic", "--data", str(place / "set-3"), "--out", str(other)]
    assert main([*curate, "--weights", "braking", "1", "--overwrite"]) == 0
    assert main([*call, "--arm", "heuristic", "--scores", str(other)]) == 1
    assert "scores of 'kinematic' have combination" in capsys.readouterr().err
    assert not (place / "none").exists()


def test_scoring_for_training_shows_progress(place, monkeypatch, capsys):
    monkeypatch.setattr("drivax.cli.train.train", lambda *_, **__: types.SimpleNamespace(path="a-run"))
    call = ["train", "offline/cql", "--data", str(place / "set-3"), "--out", str(place / "none")]
    assert main([*call, "--arm", "heuristic"]) == 0
    told = capsys.readouterr()
    assert "scoring: 2 scenarios in" in told.err and told.out == "wrote a-run\n"

    def fail(config, data, say, egos):
        say(3, 7)
        raise UsageError("no training today", cure="stop here")

    notes = []
    monkeypatch.setattr(methods, "train_ensemble", fail)
    monkeypatch.setattr(Progress, "update", lambda _, done, note="": notes.append((done, note)))
    assert main([*call, "--arm", "ensemble"]) == 2
    assert notes == [(0, "training the ensemble, 3 of 7 iterations")]
    assert "no training today" in capsys.readouterr().err


@pytest.mark.slow
def test_weights_change_the_draws(place):
    """Kinematic scores, evened out or not: all equal where the whole mixture is uniform."""
    effective = []
    curate = ["curate", "kinematic", "--data", str(place / "set-3"), "--out", str(place / "kinematic.npz")]
    assert main([*curate, "--overwrite"]) == 0
    for name, share in (("even", "1"), ("steep", "0")):
        scores = ("--scores", str(place / "kinematic.npz"), "--weighting.uniform", share)
        assert trained(place, "set-3", name, *scores) == 0
        effective.append(next(read_rows(place / name / "metrics.jsonl"))["sampler/critic_effective"])
    # Squares of ranks: an effective share of (2k + 1) / (k + 1)^2 with k = 2.
    assert effective[1] / effective[0] == pytest.approx(5 / 9, rel=0.05)


def test_validation_flag_chooses_held_out_none_or_a_set(place, monkeypatch):
    calls = []

    def note(*_, validation, **__):
        calls.append(validation)
        return types.SimpleNamespace(path="a-run")

    monkeypatch.setattr("drivax.cli.train.train", note)
    for flags in ((), ("--validation", "none"), ("--validation", str(place / "set-4"))):
        assert trained(place, "set-3", "none", *flags) == 0
    assert calls[:2] == ["held_out", None]
    assert calls[2].hash == ScenarioSet.open(place / "set-4").hash


def test_single_recording_trains_without_validation(place, capsys):
    """Both scenarios of the set are windows of one recording."""
    assert trained(place, "set-3", "single") == 0
    assert (
        "no validation: all scenarios are of one recording; pass --validation SET" in capsys.readouterr().err
    )
    assert json.loads((place / "single" / "run.json").read_text())["validation"] is None
