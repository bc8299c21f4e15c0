"""Scores of a recorded drive against NumPy and SciPy on the recording itself."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import savgol_filter

from drivax.cli import main
from drivax.curation.ensemble import EnsembleConfig
from drivax.curation.kinematic import KinematicConfig, PublishedConfig
from drivax.curation.logged import score_bank
from drivax.curation.methods import Request, curate
from drivax.curation.scores import read_scores, top_rows
from drivax.datasets.womd.scenario_reader import WomdScenario
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.scenario.schema import Capacity
from drivax.scenario.store import ScenarioSet, ScenarioWriter
from drivax.stats.clusters import recordings_of


@pytest.fixture(scope="module")
def recording(real_data):
    pytest.importorskip("google.protobuf", reason="needs the extra 'womd'")
    return next(iter(WomdScenario().read(real_data / "womd/motion_data_one_scenario.tfrecord")))


@pytest.fixture(scope="module")
def bank(recording):
    return ScenarioBank.from_scenarios([assemble(recording)])


def test_published_components_of_a_recorded_drive(recording, bank):
    tracks, ego = recording.tracks, recording.ego
    speed, heading = np.hypot(*tracks.velocity[ego].T), np.unwrap(tracks.heading[ego])

    def twice(values):
        first = np.diff(values, prepend=values[0]) / 0.1
        return np.abs(np.diff(first, prepend=first[0])) / 0.1

    components = {name: np.asarray(part[0]) for name, part in score_bank(PublishedConfig(), bank).items()}
    # Headings go through a cosine and a sine in float32, which 1 / dt^2 makes a hundred times larger.
    expected = np.minimum(np.maximum(twice(speed) / 2.5, twice(heading) / 1.5), 1.0)
    np.testing.assert_allclose(components["volatility"], expected, atol=5e-3)
    apart, closing = tracks.xy - tracks.xy[ego], tracks.velocity - tracks.velocity[ego]
    product = np.where(tracks.valid, -(apart * closing).sum(2), 0.0).max(axis=0)
    np.testing.assert_allclose(components["interaction"], np.clip(product / 1000, 0, 1), atol=2e-3)
    np.testing.assert_allclose(
        components["density"], np.minimum(tracks.valid.sum(axis=0) / 50, 1.0), atol=1e-6
    )


def test_jerk_of_a_recorded_drive_is_that_of_scipy(recording, bank):
    tracks, ego = recording.tracks, recording.ego
    heading = np.unwrap(tracks.heading[ego])
    forward = np.stack([np.cos(heading), np.sin(heading)], -1)
    speed = np.maximum((tracks.velocity[ego] * forward).sum(1), 0.0)
    jerk = savgol_filter(np.diff(speed) / 0.1, 15, 2, deriv=1, delta=0.1)
    yaw = savgol_filter((heading[1:] + heading[:-1]) / 2, 15, 3, deriv=2, delta=0.1)
    expected = np.minimum(np.maximum(np.abs(jerk) / 8.26, np.abs(yaw) / 3.86), 1.0)
    volatility = np.asarray(score_bank(KinematicConfig(), bank)["volatility"][0])
    np.testing.assert_allclose(volatility[:-1], expected, atol=2e-3)
    assert volatility[-1] == volatility[-2]


@pytest.mark.parametrize(
    ("recordings", "scenarios", "count"),
    [("womd/motion_data_one_scenario.tfrecord", 1, 1), ("scenarionet", 12, 4)],
    ids=["womd", "scenarionet"],
)
def test_three_commands_find_the_most_critical_scenarios(
    recordings, scenarios, count, real_data, repository, tmp_path, monkeypatch
):
    """The commands of the guide to critical scenarios, on the available recordings."""
    pytest.importorskip("google.protobuf", reason="needs the extra 'womd'")
    page = (repository / "docs/guide/critical-scenarios.md").read_text()
    block = page.split("```bash\n")[1].split("```")[0]
    lines = [line.replace("womd/training", str(real_data / recordings)) for line in block.splitlines()]
    lines = [line.replace(" 500", f" {count}") for line in lines]
    assert len(lines) == 3 and recordings in lines[0] and lines[1].endswith(f"sets/critical {count}")
    monkeypatch.chdir(tmp_path)
    for line in lines:
        assert main(line.split()[1:]) == 0
    whole, critical = ScenarioSet.open("sets/womd"), ScenarioSet.open("sets/critical")
    assert (len(whole), len(critical)) == (scenarios, count)
    table = read_scores(tmp_path / "scores" / "womd.npz", whole)
    order = top_rows(table, count, recordings_of(whole.entries))
    assert [scenario.id for scenario in critical] == [table.scenario_ids[row] for row in order]
    assert len(set(table.scenarios)) == scenarios
    assert critical.manifest["source"]["part_of"]["method"] == "kinematic"
    assert f"rank 1 of {count} by kinematic" in (tmp_path / "critical.html").read_text()


@pytest.mark.slow
def test_members_score_logged_steps(real_data, tmp_path):
    """Two copies of a recorded drive get equal scores from an ensemble of two."""
    pytest.importorskip("google.protobuf", reason="needs the extra 'womd'")
    with ScenarioWriter(tmp_path / "set", Capacity()) as writer:
        recorded = next(iter(WomdScenario().read(real_data / "womd/motion_data_one_scenario.tfrecord")))
        writer.add(assemble(recorded))
        writer.add(assemble(replace(recorded, scenario_id="again", segment="another")))
    data = ScenarioSet.open(tmp_path / "set")
    config = EnsembleConfig(
        folds=2, cloning=replace(EnsembleConfig().cloning, batch=16, updates=5), total_steps=160
    )
    table = curate("ensemble", Request(data, config=config))
    assert table.steps[table.valid].max() > 0.0
    np.testing.assert_allclose(table.steps[0], table.steps[1], atol=1e-5)
