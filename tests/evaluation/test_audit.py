"""The audit against hand-made scenarios and against the evaluation of the exact expert."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from drivax.api import load
from drivax.datasets.formats import detect, survey
from drivax.datasets.reader import BadRecord
from drivax.evaluation.audit import BATCH, audit
from drivax.evaluation.rollout import drive, episode_keys, evaluation_task
from drivax.evaluation.runner import evaluate
from drivax.planners.simple import Expert
from drivax.scenario.build.assemble import assemble
from drivax.scenario.recording import Light, windows
from drivax.scenario.schema import CURRENT_STEP, AgentKind, Flag, LightState
from drivax.scenario.select.selection import FINDINGS
from drivax.simulator.simulator import Simulator
from drivax.synthetic.world import generate_recording
from drivax.tasks.task import Task
from scenes import GREEN, RED, car, straight_road


def audited(*recordings):
    return audit([assemble(recording) for recording in recordings])


@pytest.fixture(scope="module")
def world():
    return load([assemble(generate_recording(9, i)) for i in range(6)])


@pytest.fixture(scope="module")
def findings(world):
    return audit(world.scenarios)


def test_filters_know_every_finding(findings):
    kinds = {"truth": bool, "number": int | float, "word": str}
    for finding in findings:
        assert set(finding) == set(FINDINGS)
        for name, value in finding.items():
            quantity = FINDINGS[name]
            assert value is None or isinstance(value, kinds[quantity.kind])
            assert not quantity.words or value in quantity.words


def offroad_steps(planner, bank):
    index = jnp.arange(len(bank))
    simulator = Simulator(evaluation_task(Task()))
    return np.asarray(drive(simulator, planner, bank, index, episode_keys(bank, index, 0)).offroad_steps)


@pytest.mark.slow
def test_audit_agrees_with_the_evaluation_of_the_expert(world, findings):
    results = evaluate(Expert(), world.bank, world.names)
    offroad = offroad_steps(Expert(), world.bank)
    for row, finding in enumerate(findings):
        metric = {name: values[row] for name, values in results.metrics.items()}
        assert finding["log_collides"] == (metric["collision"] > 0)
        assert finding["log_left_map"] == (metric["left_map"] > 0)
        assert finding["clean"] == (metric["accuracy"] > 0)
        assert finding["log_offroad_fraction"] == pytest.approx(offroad[row] / 80, abs=1e-4)
        assert finding["distance_m"] == pytest.approx(metric["distance"], abs=1e-2)
        assert finding["route_deviation_mean_m"] == pytest.approx(metric["route_deviation_mean"], abs=1e-2)
        assert finding["route_deviation_max_m"] == pytest.approx(metric["route_deviation_max"], abs=1e-2)
        assert finding["route_reaches_goal"] == (metric["goal_distance"] <= 3.0)


@pytest.mark.slow
def test_batch_size_and_other_scenarios_change_no_finding(world, findings):
    scenarios = list(world.scenarios)
    assert audit(scenarios * 12) == findings * 12 and len(findings) * 12 > BATCH
    assert audit(scenarios[::-1]) == findings[::-1]
    assert audit([]) == []


def test_collision_has_its_first_step():
    # Bumper to bumper 30 - 4.8 = 25.2 m at 8 m/s: contact after 3.15 s, so at the 32nd step after the current one.
    (finding,) = audited(straight_road([car(0, 0, 0, 8), car(30, 0, 0, 0)]))
    assert (finding["log_collides"], finding["first_collision_step"]) == (True, CURRENT_STEP + 32)
    assert finding["clean"] is False and finding["log_offroad_fraction"] == 0.0


def test_agents_that_overlap_at_the_start_are_ignored_and_counted():
    (finding,) = audited(straight_road([car(0, 0, 0, 5), car(1, 0.5, 0, 5)]))
    assert finding["ignored_overlaps"] == 1 and finding["clean"] is True


def test_leaving_and_entering_the_road_have_their_first_steps():
    # The edge is at y = -1.85, tolerance 0.3 m. A car of 4.8 x 2.0 m that points along the road and slides across it
    # has its corners at y -+ 1.0: off the road while y < -1.15.
    def slides(y, speed):
        across = car(0, y, np.pi / 2, speed)
        return straight_road([{**across, "heading": np.zeros(91)}])

    # A centre below y = -5.85 has left the map, and is still off the road.
    # y = -0.525 - 0.1 k: off the road from k = 7 on, off the map from 54 on. y = -2.975 + 0.05 k: on the road from 37.
    leaves, enters = audited(slides(-0.525, -1.0), slides(-2.975, 0.5))
    assert leaves["first_offroad_step"] == CURRENT_STEP + 7
    assert leaves["log_offroad_fraction"] == 74 / 80
    assert leaves["first_onroad_step"] == CURRENT_STEP
    assert enters["first_offroad_step"] == CURRENT_STEP + 1
    assert enters["first_onroad_step"] == CURRENT_STEP + 37
    assert enters["log_offroad_fraction"] == 36 / 80
    assert leaves["log_left_map"] is True and enters["log_left_map"] is False
    assert leaves["clean"] is enters["clean"] is False


def turned(track):
    """The same motion with headings off by pi, as in sources that know headings only up to pi."""
    return track | {"heading": (track["heading"] + 2 * np.pi) % (2 * np.pi) - np.pi}


def test_log_with_headings_off_by_pi_is_named():
    right, wrong = audited(straight_road([car(speed=10)]), straight_road([turned(car(speed=10))]))
    assert (right["reverse_m"], right["log_reverses"], right["clean"]) == (0.0, False, True)
    assert wrong["reverse_m"] == pytest.approx(80.0, abs=0.01)  # 8 s at 10 m/s
    assert (wrong["log_reverses"], wrong["clean"], wrong["agents_reversing"]) == (True, False, 0)


def test_manoeuvre_in_reverse_is_measured_and_no_violation():
    # Backs out at 2 m/s until 4 s after the current step, 8 m, then drives forward at up to 3 m/s.
    t = np.arange(91) * 0.1
    speed = np.where(t < 5, -2.0, np.minimum((t - 5) * 1.5, 3.0))
    x = np.cumsum(speed) * 0.1
    backs = car() | {"xy": np.stack([x, 0 * x], -1), "velocity": np.stack([speed, 0 * x], -1)}
    (finding,) = audited(straight_road([backs]))
    assert finding["reverse_m"] == pytest.approx(7.8, abs=0.01)  # steps 11 to 49
    assert (finding["log_reverses"], finding["clean"]) == (False, True)


def test_other_agents_with_headings_off_by_pi_are_counted():
    kinds = (AgentKind.VEHICLE, AgentKind.CYCLIST, AgentKind.PEDESTRIAN)
    others = [turned(car(30 + 20 * i, 3.7, speed=6, kind=kind)) for i, kind in enumerate(kinds)]
    gap = turned(car(120, 3.7, speed=6, steps=[*range(30), *range(70, 91)]))  # 39 moves of 0.6 m: 23.4 m
    slow = turned(car(150, 3.7, speed=2))  # 16 m
    (finding,) = audited(straight_road([car(speed=6), *others, gap, slow]))
    assert finding["agents_reversing"] == 4  # whichever way pedestrians look
    assert (finding["log_reverses"], finding["clean"]) == (False, True)


def test_jitter_of_a_parked_car_is_not_driving_backwards():
    noise = np.random.default_rng(0).normal(
        0, 0.03, (91, 2)
    )  # about 1 m of motion per second, back and forth
    parked = car()
    (finding,) = audited(straight_road([parked | {"xy": parked["xy"] + noise}]))
    assert finding["reverse_m"] < 5.0 and finding["clean"] is True


def test_distance_and_distance_to_the_route():
    (finding,) = audited(straight_road([car(0, 0.6, 0, 10)]))
    assert finding["distance_m"] == pytest.approx(80.0, abs=0.05)
    assert finding["route_deviation_mean_m"] == pytest.approx(0.6, abs=0.02)
    assert finding["route_deviation_max_m"] == pytest.approx(0.6, abs=0.02)
    assert finding["route_reaches_goal"] is True


def test_route_that_ends_elsewhere_does_not_reach_the_goal():
    # The route is given along lanes 1 and 3; the log drives away from them at 45 degrees for 8 s.
    recording = straight_road([car(0, 0, np.pi / 4, 6)])
    (finding,) = audited(recording)
    assert finding["route_reaches_goal"] is False
    assert finding["route_deviation_max_m"] == pytest.approx(8 * 6 * np.sin(np.pi / 4), abs=0.2)


def test_steps_without_a_logged_ego_are_not_evaluated():
    # Ego is lost after step 30; another car later drives through its last position.
    complete = straight_road([car(0, 0, 0, 8), car(-60, 0, 0, 20)])
    lost = straight_road([car(0, 0, 0, 8, steps=range(31)), car(-60, 0, 0, 20, steps=range(91))])
    whole, part = audited(complete, lost)
    assert whole["log_collides"] is True
    assert part["log_collides"] is False and part["clean"] is True
    assert part["distance_m"] == pytest.approx(16.0, abs=0.05)


def test_red_lights_count_only_where_lights_are_known():
    red, green, none = (straight_road([car(0, 0, 0, 10)], light=state) for state in (RED, GREEN, None))
    findings = audited(red, green, replace(none, flags=none.flags & ~Flag.LIGHTS))
    assert [finding["log_runs_red"] for finding in findings] == [True, False, None]
    assert [finding["lights_seen"] for finding in findings] == [1, 1, 0]
    assert [finding["clean"] for finding in findings] == [False, True, True]


def test_unobserved_lights_are_not_seen():
    recording = straight_road([car(0, 0, 0, 0)], light=GREEN)
    unseen = Light(1, np.array([20.0, 0.0, 0.0]), np.full(91, LightState.UNOBSERVED, np.int8))
    (finding,) = audited(replace(recording, lights=(*recording.lights, unseen)))
    assert finding["lights_seen"] == 1


def test_sources_of_sizes_velocities_and_time():
    plain = straight_road([car(0, 0, 0, 8)])
    flags = Flag.DEFAULT_SIZES | Flag.DIFFERENTIATED_VELOCITY
    times = np.arange(91) * 0.1
    times[40] += 0.003
    rough = replace(plain, flags=plain.flags | flags, timestamps_s=times)
    one, other = audited(plain, rough)
    names = ("default_sizes", "velocity", "dt_jitter")
    assert [one[name] for name in names] == [False, "measured", False]
    assert [other[name] for name in names] == [True, "differentiated", True]


def test_findings_about_the_map_are_none_without_a_map():
    recording = straight_road([car(0, 0, 0, 8)])
    (finding,) = audited(replace(recording, features=(), route_lanes=(), flags=Flag.NONE))
    unknown = {name for name, value in finding.items() if value is None and not name.startswith("first_coll")}
    assert unknown == {
        "log_offroad_fraction", "first_offroad_step", "first_onroad_step", "log_left_map", "log_runs_red", "clean",
        "route_deviation_mean_m", "route_deviation_max_m", "route_reaches_goal",
    }  # fmt: skip
    assert finding["log_collides"] is False and finding["distance_m"] == pytest.approx(64.0, abs=0.05)


def test_scenarios_without_future_get_findings_that_need_no_replay():
    recording = straight_road([car(0, 0, 0, 8)], light=GREEN)
    tracks = recording.tracks
    part = {
        name: getattr(tracks, name)[:, :11] for name in ("xy", "z", "heading", "velocity", "size", "valid")
    }
    lights = tuple(replace(light, states=light.states[:11]) for light in recording.lights)
    short = replace(
        recording, scenario_id="short", timestamps_s=recording.timestamps_s[:11], tracks=replace(tracks, **part),
        lights=lights,
    )  # fmt: skip
    one, other = audited(short, recording)
    assert one == {"lights_seen": 1, "default_sizes": False, "velocity": "measured", "dt_jitter": False}
    assert set(other) == set(FINDINGS)


def test_agents_on_another_level_do_not_collide():
    # The overpass: another car crosses ego's way 6 m higher.
    recording = straight_road([car(0, 0, 0, 8), car(32, -32, np.pi / 2, 8)])
    z = np.zeros((2, 91))
    z[1] = 6.0
    above = replace(recording, tracks=replace(recording.tracks, z=z))
    same, other = audited(recording, above)
    assert same["log_collides"] is True and other["log_collides"] is False


@pytest.mark.slow
def test_logged_ego_of_every_real_file_is_clean(real_data):
    """No collision, at most 1 % of the steps off the road, and no false finding on the overpass (by heights)."""
    scenarios = []
    for file in survey(real_data).paths():
        for recording in detect(file).read(file):
            assert not isinstance(recording, BadRecord), recording
            scenarios += [assemble(window) for window in windows(recording)]
    assert len({bytes(scenario.segment[()]) for scenario in scenarios}) >= 10
    for scenario, finding in zip(scenarios, audit(scenarios), strict=True):
        assert finding["log_collides"] is False, scenario.id
        assert finding["log_offroad_fraction"] <= 0.01, scenario.id
        assert finding["clean"] is True and finding["log_left_map"] is False, scenario.id
        assert finding["first_onroad_step"] == CURRENT_STEP, scenario.id


@pytest.mark.slow
def test_clipped_shares_count_logged_actions_beyond_the_bounds():
    # Braking at 5 m/s2 from step 20 to 29 is within `physical` and beyond `published`; at 9 m/s2 beyond both.
    def braking(deceleration):
        speed = 16.0 - deceleration * 0.1 * np.clip(np.arange(91) - 20, 0, 10)
        x = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * 0.1)])
        still = np.zeros(91)
        return car() | {"xy": np.stack([x, still], -1), "velocity": np.stack([speed, still], -1)}

    soft, hard = audited(straight_road([braking(5.0)]), straight_road([braking(9.0)]))
    assert (soft["clipped_physical"], soft["clipped_published"]) == (0.0, 10 / 80)
    assert (hard["clipped_physical"], hard["clipped_published"]) == (10 / 80, 10 / 80)
    # Steps without a logged ego (40 to 49) and the action into the step after them do not count.
    gap = car(0, 0, 0, 5, steps=[*range(40), *range(50, 91)])
    (finding,) = audited(straight_road([gap]))
    assert (finding["clipped_physical"], finding["clipped_published"]) == (0.0, 0.0)
