from __future__ import annotations

import dataclasses
import subprocess
import sys
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from drivax.errors import UsageError
from drivax.scenario.schema import CURRENT_STEP, EDGE_KINDS, STEPS, AgentKind, Flag, LightState
from drivax.synthetic import world
from drivax.synthetic.domains import DOMAINS
from drivax.synthetic.events import SEVERITY_MPS2, EventKind
from drivax.synthetic.events.conflict_start import critical_steps
from drivax.synthetic.roads.signals import Colour
from drivax.synthetic.sensing import NoiseConfig, SensorConfig
from drivax.synthetic.world import WORLD_VERSION, WorldConfig, generate_one, generate_recording

from .oracles import box_corners, shared_area, winding_number

SEED, COUNT = 2, 20
RED = (LightState.ARROW_STOP, LightState.STOP)


#: The truth, without the errors of perception.
EXACT = WorldConfig(noise=NoiseConfig(level=0.0))


@cache
def drawn(index, config=EXACT):
    return generate_one(SEED, index, config)


def fields_of(recording):
    """Id, tracks, lights, map features, route and events of a recording, for comparison."""
    tracks = [getattr(recording.tracks, f.name).tobytes() for f in dataclasses.fields(recording.tracks)]
    lights = [
        (light.lane_id, light.stop_point.tobytes(), light.states.tobytes()) for light in recording.lights
    ]
    features = [(f.feature_id, f.kind, f.points.tobytes(), f.successors) for f in recording.features]
    return [recording.scenario_id, tracks, lights, features, recording.route_lanes, recording.events]


def test_seed_and_index_determine_a_recording():
    again = generate_recording(SEED, 1, EXACT)
    assert fields_of(again) == fields_of(drawn(1).recording)
    assert fields_of(generate_recording(4, 1, EXACT)) != fields_of(again)
    assert fields_of(drawn(2).recording)[1] != fields_of(again)[1]


@pytest.mark.parametrize("index", range(COUNT))
def test_no_users_overlap(index):
    tracks = drawn(index).recording.tracks
    for t in range(0, STEPS, 3):
        present = np.flatnonzero(tracks.valid[:, t])
        corners = {
            i: box_corners(tracks.xy[i, t], tracks.heading[i, t], *tracks.size[i, t, :2]) for i in present
        }
        is_pedestrian = tracks.kind == AgentKind.PEDESTRIAN
        for i in present:
            for j in present[present > i]:
                # Pedestrians may overlap each other.
                if (
                    not (is_pedestrian[i] and is_pedestrian[j])
                    and np.hypot(*(tracks.xy[i, t] - tracks.xy[j, t])) < 11.0
                ):
                    assert shared_area(corners[i], corners[j]) == 0.0, (i, j, t)


@pytest.mark.parametrize("index", range(COUNT))
def test_expert_stays_on_the_road(index):
    recording = drawn(index).recording
    tracks = recording.tracks
    rings = [f.points[:-1, :2] for f in recording.features if f.kind in EDGE_KINDS]
    assert tracks.valid[0].all()
    for t in range(0, STEPS, 6):
        for corner in box_corners(tracks.xy[0, t], tracks.heading[0, t], *tracks.size[0, t, :2]):
            assert sum(winding_number(corner, ring) for ring in rings) == 1


@pytest.mark.parametrize("index", range(COUNT))
def test_no_vehicle_runs_a_red_light(index):
    recording = drawn(index).recording
    tracks = recording.tracks
    lanes = {f.feature_id: f for f in recording.features}
    for light in recording.lights:
        points = lanes[light.lane_id].points[:, :2]
        along = (points[1] - points[0]) / np.hypot(*(points[1] - points[0]))
        for row in range(len(tracks.xy)):
            ahead = np.stack([np.cos(tracks.heading[row]), np.sin(tracks.heading[row])], axis=-1)
            front = tracks.xy[row] + ahead * tracks.size[row, :, :1] / 2 - light.stop_point[:2]
            past, aside = front @ along, np.abs(front @ np.array([-along[1], along[0]]))
            for t in range(STEPS - 1):
                crossed = past[t] <= 0 < past[t + 1] and aside[t] < 1.6 and ahead[t] @ along > 0.7
                if crossed and tracks.valid[row, t : t + 2].all():
                    assert not (light.states[t] in RED and light.states[t + 1] in RED), (row, t)


@pytest.mark.parametrize("index", range(COUNT))
def test_motion_is_that_of_a_bicycle_at_the_box_centre(index):
    tracks = drawn(index).recording.tracks
    for row in np.flatnonzero(np.isin(tracks.kind, (AgentKind.VEHICLE, AgentKind.CYCLIST))):
        ok = tracks.valid[row]
        xy, heading = tracks.xy[row, ok], np.unwrap(tracks.heading[row, ok])
        speed = np.hypot(*tracks.velocity[row, ok].T)
        along = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        assert np.allclose(tracks.velocity[row, ok], speed[:, None] * along, atol=1e-9)
        # One step of the dynamics: the mean speed along the mean heading.
        mean = (heading[1:] + heading[:-1]) / 2
        d = (speed[1:] + speed[:-1]) * 0.05
        step = d[:, None] * np.stack([np.cos(mean), np.sin(mean)], axis=-1)
        assert np.abs(np.diff(xy, axis=0) - step).max(initial=0.0) < 0.03
        turned = np.abs(np.diff(heading))
        assert np.all(turned <= 0.3 * np.maximum(d, 0.0) + 1e-3)


def test_expert_brakes_and_turns_within_comfort_limits_and_moves():
    hardest, turning, moved = [], [], []
    for index in range(COUNT):
        tracks = drawn(index).recording.tracks
        speed = np.hypot(*tracks.velocity[0].T)
        if not drawn(index).recording.events:
            hardest.append(np.diff(speed).min() / 0.1)
        rate = np.diff(np.unwrap(tracks.heading[0])) / 0.1
        turning.append(np.abs(rate * speed[1:]).max())
        moved.append(np.hypot(*np.diff(tracks.xy[0], axis=0).T).sum())
    assert min(hardest) > -4.05
    assert max(turning) < 4.89
    assert min(moved) > 9.9  # 10 m by speeds; here by positions
    assert np.median(moved) > 40.0


def test_constant_velocity_fails_often():
    """Constant velocity leaves the road or collides in at least three of ten scenarios, lights ignored."""
    failed = 0
    for index in range(COUNT):
        recording = drawn(index).recording
        tracks = recording.tracks
        rings = [f.points[:-1, :2] for f in recording.features if f.kind in EDGE_KINDS]
        for t in range(CURRENT_STEP, STEPS, 5):
            xy = tracks.xy[0, CURRENT_STEP] + tracks.velocity[0, CURRENT_STEP] * (t - CURRENT_STEP) * 0.1
            box = box_corners(xy, tracks.heading[0, CURRENT_STEP], *tracks.size[0, 0, :2])
            off = any(sum(winding_number(c, ring) for ring in rings) != 1 for c in box)
            hit = any(
                shared_area(box, box_corners(tracks.xy[i, t], tracks.heading[i, t], *tracks.size[i, t, :2]))
                > 0
                for i in np.flatnonzero(tracks.valid[:, t])[1:]
                if np.hypot(*(tracks.xy[i, t] - xy)) < 10.0
            )
            if off or hit:
                failed += 1
                break
    assert failed >= 0.3 * COUNT


def test_recordings_are_complete():
    families = set()
    for index in range(COUNT):
        generated = drawn(index)
        recording, tracks = generated.recording, generated.recording.tracks
        families.add(generated.family)
        assert recording.dataset == "drivax" and recording.current_step == CURRENT_STEP
        assert recording.scenario_id == f"w{WORLD_VERSION}-grid-s{SEED}-{index:06d}-{generated.family}"
        if not recording.events:
            number = index // EXACT.scenarios_per_map
            assert recording.segment.startswith(f"w{WORLD_VERSION}-grid-s{SEED}-m{number:06d}.")
        assert recording.tags["family"] == generated.family and recording.tags["domain"] == "grid"
        assert np.allclose(np.diff(recording.timestamps_s), 0.1)
        assert tracks.xy.shape == (len(tracks.kind), STEPS, 2) and tracks.valid.any(axis=1).all()
        assert np.all(np.abs(tracks.heading) <= np.pi)
        assert not tracks.xy[~tracks.valid].any() and not tracks.size[~tracks.valid].any()
        assert len(set(tracks.track_id)) == len(tracks.track_id)
        ids = {f.feature_id: f for f in recording.features}
        for a, b in pairwise(recording.route_lanes):
            assert b in ids[a].successors + ids[a].left_neighbours + ids[a].right_neighbours
        # All lights are known, also where there are none.
        assert Flag.LIGHTS in recording.flags
        assert recording.lights or generated.family != "signalised_junction"
        for light in recording.lights:
            assert np.array_equal(light.stop_point, ids[light.lane_id].points[0])
    assert len(families) >= 6 and families <= {family.name for family, _ in DOMAINS["grid"].families}


@pytest.mark.slow
def test_rare_scenarios_have_one_labelled_event():
    config = dataclasses.replace(EXACT, rare_rate=1.0)
    for index in range(6):
        recording = drawn(index, config).recording
        (event,) = recording.events
        assert recording.tags["event"] == EventKind(event.kind).name.lower()
        low, high = SEVERITY_MPS2
        assert low <= float(recording.tags["severity_mps2"]) <= high
        assert CURRENT_STEP < event.start < event.end < STEPS
        for actor in event.actors:
            (row,) = np.flatnonzero(recording.tracks.track_id == actor)
            assert row != recording.ego and recording.tracks.valid[row, event.start]
    assert not drawn(0, WorldConfig(rare_rate=0.0)).recording.events


@pytest.mark.slow
def test_domains_determine_roads():
    ring = dataclasses.replace(EXACT, domain="ring")
    widths = {
        config.domain: np.mean(
            [f.width_m for i in range(4) for f in drawn(i, config).recording.features if f.width_m]
        )
        for config in (EXACT, ring)
    }
    assert widths["ring"] < widths["grid"] - 0.2
    with pytest.raises(UsageError, match="unknown domain 'city'"):
        generate_one(0, 0, WorldConfig(domain="city"))


def test_negative_seeds_and_short_recordings_are_refused():
    with pytest.raises(UsageError, match="must not be negative; choose 0 or more"):
        generate_recording(-1, 0)
    with pytest.raises(UsageError, match="steps is 90; use 91 or more"):
        generate_recording(0, 0, steps=90)


def test_world_needs_no_jax():
    code = (
        "import sys, drivax.synthetic.generate as g;"
        "list(g.generate_many(0, [0], g.WorldConfig())); print('jax' in sys.modules)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "False"


def test_noise_changes_other_agents_only():
    """Noise moves other agents by less than 10 cm, and changes neither ego's positions, validity nor visibility."""
    exact, noisy = drawn(1).recording, generate_recording(SEED, 1)
    assert np.array_equal(exact.tracks.valid, noisy.tracks.valid) and np.array_equal(exact.seen, noisy.seen)
    assert np.array_equal(exact.tracks.xy[0], noisy.tracks.xy[0])
    shift = np.hypot(*np.moveaxis(exact.tracks.xy - noisy.tracks.xy, -1, 0))[1:][exact.tracks.valid[1:]]
    assert 0.003 < shift.std() < 0.03 and shift.max() < 0.1
    assert exact.seen is not None and exact.seen[0].all() and not exact.seen[~exact.tracks.valid].any()


def test_two_shares_of_signal_timing_are_refused():
    config = WorldConfig()
    object.__setattr__(config, "signal_timing", (0.5, 0.5))  # which the type checks of tests refuse earlier
    with pytest.raises(UsageError, match="use three shares"):
        config.check()
    WorldConfig(signal_timing=(0.33333333,) * 3).check()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"critical_share": -0.1}, "critical_share is -0.1; use a share from 0 to 1"),
        ({"lane_change_share": 2.0}, "lane_change_share is 2.0; use a share from 0 to 1"),
        (
            {"signal_timing": (0.5, 0.5, 0.5)},
            "signal_timing is [0.5, 0.5, 0.5]; use three shares that add up to 1",
        ),
        (
            {"signal_timing": (0.3333333,) * 3},
            "signal_timing is [0.3333333, 0.3333333, 0.3333333]; use three",
        ),
        ({"signal_timing": (-0.5, 0.5, 1.0)}, "signal_timing is [-0.5, 0.5, 1.0]"),
        ({"signal_timing": (float("nan"), 0.5, 0.5)}, "signal_timing is [nan, 0.5, 0.5]"),
        ({"sensor": SensorConfig(range_m=-1.0)}, "sensor.range_m is -1.0; use a finite number that is not"),
        (
            {"noise": NoiseConfig(speed_correlation=1.5)},
            "noise.speed_correlation is 1.5; use a number from 0 to",
        ),
        ({"noise": NoiseConfig(level=float("nan"))}, "noise.level is nan; use a finite number"),
        ({"noise": NoiseConfig(level=-3.0)}, "noise.level is -3.0; use a finite number that is not negative"),
        ({"noise": NoiseConfig(level=2.0)}, "(noise.level 2.0) could exceed the margin of 0.1 m around ego"),
    ],
)
def test_invalid_settings_are_refused(settings, message):
    with pytest.raises(UsageError) as error:
        WorldConfig(**settings).check()
    assert message in str(error.value)


@pytest.mark.slow
def test_another_kind_replaces_an_event_that_cannot_be_staged(monkeypatch):
    tried = []

    def refuse(kind, view, severity, rng):
        tried.append(kind)

    monkeypatch.setattr(world, "stage", refuse)
    monkeypatch.setattr(world, "possible", lambda kind, network: True)
    monkeypatch.setattr(world, "_PER_KIND", 1)
    monkeypatch.setattr(world, "_ATTEMPTS", 12)
    with pytest.raises(UsageError, match="no clean expert in 12 attempts"):
        world.generate_one(0, 0, WorldConfig(rare_rate=1.0))
    assert len(tried) == len(set(tried)) == 12


@pytest.mark.slow
def test_critical_recording_is_a_window_of_the_traffic(monkeypatch):
    """The red lights and ego's first pose are those of the traffic from the critical step on."""
    traffic = {}

    def select(network, motion, colour, steps):
        is_critical = critical_steps(network, motion, colour, steps)
        traffic.update(motion=motion, colour=colour, steps=steps[is_critical].tolist())
        return is_critical

    monkeypatch.setattr(world, "critical_steps", select)
    config = dataclasses.replace(EXACT, rare_rate=0.0, critical_share=1.0)
    first_steps, changing_lights = set(), 0
    for index in range(0, 60, 2):
        generated = generate_one(6, index, config)
        if "critical" not in generated.recording.tags or generated.rejected:
            continue
        # No plan of ego begins before the recording, so its first pose is that of a critical step of the traffic.
        distance = np.hypot(*(traffic["motion"].xy[0] - generated.recording.tracks.xy[0, 0]).T)
        first = int(distance.argmin())
        assert distance[first] < 1e-9 and first in traffic["steps"]
        first_steps.add(first)
        for light in generated.recording.lights:
            colour = traffic["colour"][first : first + STEPS, light.lane_id - 1]
            red = np.isin(light.states, [int(state) for state in RED])
            assert np.array_equal(red, colour == Colour.RED)
            changing_lights += len(set(colour.tolist())) > 1
        if len(first_steps) > 2 and changing_lights > 2:
            return
    raise AssertionError(f"first steps {first_steps}, {changing_lights} lights that change")
