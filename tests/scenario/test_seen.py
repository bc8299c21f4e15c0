"""What ego's sensors would see: stored next to the truth, cut and restored with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivax.datasets.export.recording import restore
from drivax.errors import DataError
from drivax.scenario.build.assemble import assemble
from drivax.scenario.recording import windows, with_ego
from scenario.recordings import driving, make_recording, make_tracks, straight_road


@pytest.fixture
def recording():
    """Ego, a car next to it, and a parked one that appears at step 5."""
    valid = np.ones((3, 91), bool)
    valid[2, :5] = False
    parked = np.tile([30.0, 3.5], (91, 1))
    tracks = make_tracks([driving(), driving(8.0, y=3.5), parked], valid=valid)
    return make_recording(straight_road(), tracks)


def test_all_logged_steps_are_seen_by_default(recording):
    scenario = assemble(recording)
    assert np.array_equal(scenario.agent_seen, scenario.agent_valid)
    assert np.array_equal(scenario.parked_seen, scenario.parked_valid)
    assert scenario.parked_seen.sum() == 86
    assert restore(scenario).seen is None


def test_seen_mask_moves_with_its_track_and_implies_validity(recording):
    seen = np.ones((3, 91), bool)
    seen[1, 20:40] = False
    seen[2, :50] = False
    scenario = assemble(replace(recording, seen=seen))
    assert np.array_equal(scenario.agent_seen[:, 0], scenario.agent_valid[:, 0])
    assert np.array_equal(np.flatnonzero(~scenario.agent_seen[:, 1]), np.arange(20, 40))
    assert np.array_equal(np.flatnonzero(scenario.parked_seen[:, 0]), np.arange(50, 91))
    # The truth is what it was.
    plain = assemble(recording)
    for name in ("agent_valid", "agent_xy", "parked_valid", "parked_xy"):
        assert np.array_equal(getattr(scenario, name), getattr(plain, name)), name
    # A mask that claims more than was valid is cut to it.
    assert assemble(replace(recording, seen=np.ones((3, 91), bool))).parked_seen.sum() == 86
    back = restore(scenario)
    assert back.seen is not None and np.array_equal(back.seen, seen & recording.tracks.valid)
    again = assemble(back)
    assert np.array_equal(again.agent_seen, scenario.agent_seen)
    assert np.array_equal(again.parked_seen, scenario.parked_seen)


def test_windows_cut_the_seen_mask_and_another_ego_drops_it(recording):
    long = make_recording(
        straight_road(),
        make_tracks([driving(5.0, steps=140), driving(5.0, y=3.5, steps=140)]),
        timestamps_s=np.arange(140) * 0.1,
    )
    seen = np.ones((2, 140), bool)
    seen[1, 60] = False
    first, second = windows(replace(long, seen=seen))
    assert first.seen is not None and np.flatnonzero(~first.seen[1]).tolist() == [60]
    assert second.seen is not None and np.flatnonzero(~second.seen[1]).tolist() == [20]
    assert with_ego(first, 1).seen is None


def test_a_mask_of_another_shape_is_refused(recording):
    # Past the constructor: tests run with checked constructors, users do not.
    object.__setattr__(recording, "seen", np.ones((3, 90), bool))
    with pytest.raises(DataError, match=r"seen has shape \(3, 90\), not \(3, 91\)"):
        assemble(recording)
