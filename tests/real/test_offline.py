"""Offline learning from recordings of other sources, from the files to a driver."""

import json

import pytest

from drivax.cli import main
from drivax.evaluation.episode_table import EpisodeTable
from drivax.tracking.sinks import read_rows

TINY = [
    "--total_steps", "64", "--evaluate_every", "2", "--algorithm.batch", "16", "--algorithm.updates", "2",
    "--algorithm.network.encoder.rows", "[4]", "--algorithm.network.encoder.hidden", "[8]",
    "--algorithm.network.head", "[8]",
]  # fmt: skip


@pytest.fixture(scope="module", params=["womd/motion_data_one_scenario.tfrecord", "av2"])
def recorded(request, real_data, tmp_path_factory):
    """A set of recordings, and its scores."""
    pytest.importorskip("google.protobuf", reason="needs the extra 'womd'")
    folder = tmp_path_factory.mktemp("recorded")
    assert main(["convert", str(real_data / request.param), str(folder / "set")]) == 0
    call = ["curate", "kinematic", "--data", str(folder / "set"), "--out", str(folder / "scores.npz")]
    assert main(call) == 0
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["bc", "cql", "iql", "td3_bc"])
def test_policy_learns_from_recordings_weighted_by_scores(recorded, kind, tmp_path):
    data, run, drive = str(recorded / "set"), tmp_path / "run", tmp_path / "drive"
    call = ["train", f"offline/{kind}", "--data", data, "--validation", data, "--out", str(run)]
    assert main([*call, "--scores", str(recorded / "scores.npz"), *TINY]) == 0
    rows = list(read_rows(run / "metrics.jsonl"))
    losses = [value for row in rows for name, value in row.items() if name.startswith("loss/")]
    assert losses and all(value == value and abs(value) < 1e6 for value in losses)
    assert rows[-1]["validation/progress_ratio"] is not None
    assert len(json.loads((run / "run.json").read_text())["weights"]) == 64
    assert main(["evaluate", "--planner", str(run), "--data", data, "--out", str(drive)]) == 0
    assert len(EpisodeTable.read(drive).metrics["collision"]) > 0
