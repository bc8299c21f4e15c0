"""Logs with dropped frames, gaps and jumps: what is kept of them, and what is counted."""

from dataclasses import replace

import numpy as np
import pytest

from drivax.errors import DataError
from drivax.scenario.build.assemble import assemble
from drivax.scenario.recording import Event, differentiate, windows
from drivax.scenario.schema import STEPS, Flag, LightState
from scenes import car, straight_road

from .recordings import driving, light, make_recording, make_tracks

TIMED = ("xy", "z", "heading", "velocity", "size", "valid")


def without(recording, frames):
    """The recording as a logger writes it that drops frames: their time passes, their states are missing."""
    keep = np.setdiff1d(np.arange(len(recording.timestamps_s)), frames)
    tracks = replace(recording.tracks, **{name: getattr(recording.tracks, name)[:, keep] for name in TIMED})
    return replace(
        recording,
        timestamps_s=recording.timestamps_s[keep],
        current_step=int(np.searchsorted(keep, recording.current_step)),
        tracks=tracks,
        seen=None if recording.seen is None else recording.seen[:, keep],
        lights=tuple(replace(each, states=each.states[keep]) for each in recording.lights),
    )


def long_drive(steps=200):
    """A car at 10 m/s on a straight road."""
    return make_recording(tracks=make_tracks([driving(steps=steps)], heading=np.zeros((1, steps))))


@pytest.mark.parametrize("frame", [5, 50, 89])
def test_single_dropped_frame_is_interpolated_for_all_agents(frame):
    whole = straight_road([car(speed=10.0), car(x=30.0, y=3.7, speed=12.0, heading=0.1)], light=LightState.GO)
    turning = np.linspace(3.0, 3.0 + 90 * 0.02, STEPS)  # through pi at step 7
    wrapped = (turning + np.pi) % (2 * np.pi) - np.pi
    whole.tracks.heading[1] = wrapped
    (filled,) = windows(without(whole, [frame]))
    assert filled.lost == {"interpolated_steps": 1}
    assert filled.timestamps_s == pytest.approx(whole.timestamps_s)
    assert (filled.current_step, filled.scenario_id) == (10, "hand-made")
    assert filled.lights[0].states.tolist() == whole.lights[0].states.tolist()
    one, other = assemble(whole), assemble(filled)
    assert other.source.lost == {"interpolated_steps": 1}
    assert Flag.JITTERED_TIME not in other.has
    for name in ("agent_xy", "agent_velocity", "agent_valid", "agent_size"):
        assert np.allclose(getattr(one, name), getattr(other, name), atol=1e-5), name
    turn = one.agent_heading - other.agent_heading
    assert np.abs((turn + np.pi) % (2 * np.pi) - np.pi).max() < 1e-5


def test_interpolated_frame_is_valid_between_valid_frames_only():
    whole = straight_road([car(speed=10.0), car(x=30.0, speed=10.0, steps=range(41)), car(y=3.7)])
    seen = np.ones((3, STEPS), bool)
    seen[2, :40] = False
    events = (Event(1, 20, 39, (100,)), Event(2, 40, 60, (101,)))
    short = without(replace(whole, seen=seen), [40])  # the second car was there at 39 and 40, not at 41
    (filled,) = windows(replace(short, events=events))
    assert filled.tracks.valid[:, 38:43].tolist() == [[True] * 5, [True] * 2 + [False] * 3, [True] * 5]
    assert not filled.tracks.xy[1, 40:].any()
    assert filled.seen[2, 38:43].tolist() == [False, False, False, True, True]
    assert [(event.start, event.end) for event in filled.events] == [(20, 39), (41, 61)]


def test_windows_of_a_long_drive_count_their_own_dropped_frames():
    drive = without(long_drive(), [30, 100])
    cut = list(windows(drive))
    assert [each.scenario_id for each in cut] == [f"hand-made@{start}" for start in (0, 40, 80)]
    assert [each.lost.get("interpolated_steps", 0) for each in cut] == [1, 1, 1]
    assert [each.lost for each in windows(without(long_drive(), [30]))][1:] == [{}, {}]
    for each, plain in zip(cut, windows(long_drive()), strict=True):
        assert each.tracks.xy == pytest.approx(plain.tracks.xy)
        assert (each.segment, each.current_step) == ("hand-made", 10)


def test_no_window_spans_a_longer_gap():
    drive = without(long_drive(), range(50, 55))  # 50 frames, 0.6 s, 145 frames
    cut = list(windows(drive))
    assert [each.scenario_id for each in cut] == [
        "hand-made@55",
        "hand-made@95",
    ]  # 5.5 and 9.5 s after the first frame
    assert [each.lost for each in cut] == [{"time_gaps": 1}] * 2
    for each in cut:
        moved = np.diff(each.tracks.xy[0, :, 0])
        assert moved == pytest.approx(
            np.ones(STEPS - 1)
        )  # 10 m/s throughout, where 6 m at a step were 60 m/s
    assert cut[0].tracks.xy[0, 0] == pytest.approx(long_drive().tracks.xy[0, 55])


def test_longest_side_of_a_gap_is_kept_where_none_fills_a_window():
    whole = straight_road([car(speed=10.0)], light=LightState.GO)
    (side,) = windows(without(whole, range(30, 33)))
    assert (side.scenario_id, side.current_step, side.lost) == ("hand-made@33", 10, {"time_gaps": 1})
    assert len(side.timestamps_s) == len(side.lights[0].states) == STEPS - 33
    assert side.tracks.xy[0] == pytest.approx(whole.tracks.xy[0, 33:])
    assert assemble(side).steps == STEPS - 33


@pytest.mark.parametrize("late_s", [0.05, -0.08, 0.03])
def test_frames_off_their_time_are_resampled_by_time(late_s):
    """One frame late by 50 ms, as where a sweep of 20 Hz is missing in a drive at 10 Hz; one 80 ms early."""
    times = np.arange(200) * 0.1
    times[100:] += late_s
    tracks = make_tracks([np.stack([10.0 * times, 0.2 * times], -1)], heading=np.zeros((1, 200)))
    drive = make_recording(tracks=tracks, timestamps_s=times)
    cut = list(windows(drive))
    assert [each.scenario_id for each in cut] == [f"hand-made@{start}" for start in (0, 40, 80)]
    # From 10.0 s on there is no frame at any step: none of steps 0 to 90, 31 of 40 to 130, 71 of 80 to 170.
    assert [each.lost.get("interpolated_steps", 0) for each in cut] == [0, 31, 71]
    for each in cut:
        assert np.diff(each.tracks.xy[0, :, 0]) == pytest.approx(np.ones(STEPS - 1), abs=1e-9)
        assert each.tracks.xy[0, :, 0] == pytest.approx(10.0 * each.timestamps_s, abs=1e-9)
        assert Flag.JITTERED_TIME not in assemble(each).has


def test_jitter_up_to_twenty_milliseconds_is_played_and_flagged():
    whole = straight_road([car(speed=10.0)])
    times = whole.timestamps_s + np.where(np.arange(STEPS) % 2, 0.019, 0.0)
    late = replace(whole, timestamps_s=times)
    assert [each is late for each in windows(late)] == [True]
    assert Flag.JITTERED_TIME in assemble(late).has


def test_steps_of_half_a_second_are_refused_rather_than_cut():
    slow = replace(long_drive(), timestamps_s=np.arange(200) * 0.5)
    with pytest.raises(DataError, match=r"steps of 0.500 s instead of 0.1 s; resample"):
        assemble(next(iter(windows(slow))))


def with_jump(track, steps, offset=200.0, velocities="measured"):
    """Ego at 10 m/s, a car at 12 m/s next to it; one of them is logged ``offset`` metres to the left at some steps."""
    recording = straight_road([car(speed=10.0), car(x=20.0, y=3.7, speed=12.0)])
    tracks = recording.tracks
    tracks.xy[track, steps, 1] += offset
    if velocities == "differentiated":
        velocity = differentiate(tracks.xy, tracks.valid, recording.timestamps_s)
        flags = recording.flags | Flag.DIFFERENTIATED_VELOCITY
        recording = replace(recording, tracks=replace(tracks, velocity=velocity), flags=flags)
    return recording


@pytest.mark.parametrize(
    ("steps", "velocities", "lost"),
    [
        ([50], "measured", [50]),  # one outlier
        ([50], "differentiated", [49, 50, 51]),  # velocities next to it are of the jump
        (range(50, 91), "measured", range(50, 91)),  # another car gets the id: the longer piece is kept
        (range(41), "measured", range(41)),
        ([20, 50, 51, 70], "measured", [20, 50, 51, 70]),
    ],
)
def test_jump_of_a_bystander_costs_its_steps_and_not_the_window(steps, velocities, lost):
    scenario = assemble(with_jump(1, list(steps), velocities=velocities))
    assert scenario.source.lost == {"jumping_tracks": 1}
    assert np.flatnonzero(~scenario.agent_valid[:, 1]).tolist() == list(lost)
    assert scenario.agent_valid[:, 0].all()
    assert not scenario.agent_xy[list(lost), 1].any()
    assert np.abs(scenario.agent_xy[:, 1, 1]).max() < 4.0


def test_velocities_next_to_a_jump_are_differentiated_without_it():
    scenario = assemble(with_jump(1, [50], offset=15.0, velocities="differentiated"))
    assert np.flatnonzero(~scenario.agent_valid[:, 1]).tolist() == [50]
    np.testing.assert_allclose(scenario.agent_velocity[[49, 51], 1], [[12.0, 0.0]] * 2, atol=1e-5)


@pytest.mark.parametrize(("name", "value"), [("xy", 1e30), ("z", -1e30), ("velocity", 1e30), ("xy", 2e5)])
def test_bystander_beyond_all_bounds_is_left_out(name, value):
    recording = with_jump(1, [])
    getattr(recording.tracks, name)[1] = value
    scenario = assemble(recording)
    assert scenario.source.lost == {"jumping_tracks": 1}
    assert scenario.agent_id[:2].tolist() == [100, -1]


@pytest.mark.parametrize("velocities", ["measured", "differentiated"])
def test_jump_of_ego_is_refused(velocities):
    with pytest.raises(DataError, match=r"m/s at step (49|50)|between steps (49|50)") as caught:
        assemble(with_jump(0, [50], velocities=velocities))
    assert caught.value.record == "hand-made"


def test_fast_car_and_long_absence_are_no_jumps():
    absent = car(x=-20.0, speed=80.0, steps=[*range(20), *range(70, 91)])
    scenario = assemble(straight_road([car(speed=10.0), absent, car(y=3.7, speed=99.0)]))
    assert scenario.source.lost == {}
    assert scenario.agent_valid[:, :3].sum() == 2 * STEPS + 41


def test_lights_of_the_source_keep_their_state_in_the_interpolated_frame():
    states = [LightState.GO] * 50 + [LightState.STOP] * 41
    recording = make_recording(tracks=make_tracks([driving()]), lights=(light(1, 40.0, 0.0, states),))
    (filled,) = windows(without(recording, [50]))
    assert filled.lights[0].states.tolist() == [LightState.GO] * 51 + [LightState.STOP] * 40
