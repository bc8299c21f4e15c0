"""Training by scores of criticality, through the command line."""

from __future__ import annotations

import json

import pytest

from drivax.cli import main
from drivax.synthetic.generate import Generation, generate

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
        generate(place / f"set-{seed}", 2, seed, Generation(workers=1))
    (place / "tiny.yaml").write_text(json.dumps(TINY))
    call = ["curate", "uniform", "--data", str(place / "set-3"), "--out", str(place / "scores.npz")]
    assert main(call) == 0
    return place


def trained(place, data, out, *more):
    call = ["train", str(place / "tiny.yaml"), "--data", str(place / data), "--out", str(place / out)]
    return main([*call, *more])


@pytest.mark.slow
def test_scores_weigh_what_is_learned_from(place, capsys):
    scores = ("--scores", str(place / "scores.npz"), "--scale", "scenario")
    assert trained(place, "set-3", "weighted", *scores) == 0
    assert len(json.loads((place / "weighted" / "run.json").read_text())["weights"]) == 64
    capsys.readouterr()
    assert trained(place, "set-4", "other", *scores) != 0
    assert "is of other data" in capsys.readouterr().err and not (place / "other").exists()
    assert trained(place, "set-3", "missing", "--scores", str(place / "none.npz")) != 0
    assert "there are no scores" in capsys.readouterr().err
