"""Reactive traffic on hand-made roads, against motions computed by hand and the oracle."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.errors import UsageError
from drivax.scenario.build.assemble import assemble
from drivax.scenario.schema import AgentKind, LightState
from drivax.simulator.idm import IdmParameters
from drivax.simulator.simulator import Simulator
from drivax.simulator.traffic.agent_paths import (
    PATH_COS,
    PATH_POINTS,
    PATH_SIN,
    PATH_X,
    PATH_Y,
    PROFILE_SPEED,
    AgentPaths,
)
from drivax.simulator.traffic.bank_data import data_of
from drivax.simulator.traffic.log import alone
from drivax.simulator.traffic.reactive import DRIVES, LEFT, REPLAYS, WAITS, IdmTraffic
from drivax.tasks.task import Task
from scenes import GREEN, RED, SMALL, bank_of, car, straight_road
from traffic_oracle import compare

TRAFFIC = IdmTraffic()
SIMULATOR = Simulator(Task(), TRAFFIC)


@partial(jax.jit, static_argnums=0)
def _drive(traffic_model, bank, index, motions):
    """Return frames and traffic states of all steps while ego follows ``motions``."""
    simulator = Simulator(Task(), traffic_model)
    context = simulator.context(bank, index, 10)

    def one(context, motion):
        out = (simulator.frame(bank, context, alone(context), 0), context.traffic)
        traffic = traffic_model.advance(bank, context, out[0])
        history = jnp.concatenate([context.history[1:], motion[None]])
        return replace(context, step=context.step + 1, history=history, traffic=traffic), out

    return jax.lax.scan(one, context, motions)[1]


class Run:
    """Simulated traffic of a recording: boxes, speeds and validity by car; time 0 is the current step.

    Attributes:
        row: Path of each car, -1 for none.
    """

    def __init__(self, recording, motions=None, traffic=TRAFFIC):
        bank = traffic.prepare(bank_of(recording))
        origin, slots = recording.tracks.xy[0, 10], slots_in(recording)
        if motions is None:
            ego = recording.tracks
            speed = np.hypot(ego.velocity[0, 11:, 0], ego.velocity[0, 11:, 1])
            motions = np.column_stack([ego.xy[0, 11:], ego.heading[0, 11:], speed])
        motions = np.concatenate([motions, np.repeat(motions[-1:], 151 - len(motions), 0)])
        motions[:, :2] -= origin
        frames, self.traffic = _drive(traffic, bank, 0, jnp.asarray(motions, jnp.float32))
        self.bank, self.frames = bank, jax.tree.map(np.asarray, frames)
        self.traffic = jax.tree.map(np.asarray, self.traffic)
        self.box, self.valid = np.array(frames.box)[:, slots], np.asarray(frames.valid)[:, slots]
        self.box[..., :2] += origin
        self.x, self.y = self.box[..., 0], self.box[..., 1]
        self.speed = np.hypot(*np.moveaxis(np.asarray(frames.velocity)[:, slots], -1, 0))
        paths = list(np.asarray(data_of(bank, AgentPaths).slot[0]))
        self.row = [paths.index(slot) if slot in paths else -1 for slot in slots]
        self.slots = slots

    def gap(self, follower, leader, step=-1):
        half = (self.box[step, follower, 4] + self.box[step, leader, 4]) / 2
        return self.x[step, leader] - self.x[step, follower] - half

    def phase(self, number):
        return np.asarray(self.traffic.phase)[:, self.row[number]]


def slots_in(recording):
    """Return the slot of each car of a recording: moving cars by distance to ego, then parked ones."""
    scenario = assemble(recording, SMALL)
    ids = [*scenario.agent_id[scenario.agent_valid.any(axis=0)], *scenario.parked_id]
    return [ids.index(number) for number in recording.tracks.track_id]


def profile(x, y, speeds, **options):
    """A car whose speed at each of the 91 steps is given, at (x, y) at step 10, driving along +x."""
    speeds = np.broadcast_to(np.asarray(speeds, float), (91,)).copy()
    track = car(x, y, 0, 0, **options)
    moved = np.concatenate([[0], np.cumsum((speeds[1:] + speeds[:-1]) / 2 * 0.1)])
    track["xy"] = np.where(
        track["valid"][:, None], np.stack([x + moved - moved[10], np.full(91, y)], -1), 0.0
    )
    track["velocity"] = np.where(track["valid"][:, None], np.stack([speeds, 0 * speeds], -1), 0.0)
    return track


EGO = car(-100, 3.7, 0, 0)  # parked out of the way


def test_a_queue_at_a_red_light_comes_to_rest_two_metres_apart():
    run = Run(straight_road([EGO, car(0, 0, 0, 10), car(-20, 0, 0, 10), car(-40, 0, 0, 10)], light=RED))
    np.testing.assert_allclose(run.speed[-1, 1:4], 0.0, atol=0.02)
    front = run.x[-1, 1] + 2.4
    assert 40.0 - front == pytest.approx(2.0, abs=0.15)
    assert [run.gap(2, 1), run.gap(3, 2)] == pytest.approx([2.0, 2.0], abs=0.15)


def test_a_light_that_turns_green_lets_the_queue_go():
    states = np.full(91, RED)
    states[70:] = GREEN
    run = Run(straight_road([EGO, car(0, 0, 0, 10), car(-20, 0, 0, 10)], light=states))
    assert run.x[59, 1] + 2.4 < 40.0 < run.x[-1, 1]
    assert run.speed[-1, 1] == pytest.approx(10.0, abs=0.5)


def test_vehicle_that_cannot_stop_before_red_drives_on():
    # The front bumper is 5 m before the line at 10 m/s: that takes 10 m/s2, and brakes give 6.
    run = Run(straight_road([EGO, car(40 - 2.4 - 5, 0, 0, 10)], light=RED))
    assert run.speed[:, 1].min() > 9.9


def test_vehicle_with_its_front_over_the_stop_line_waits():
    moves = np.where(np.arange(91) < 60, 0.0, 8.0)
    run = Run(straight_road([EGO, profile(39.0, 0, moves)], light=RED))
    assert np.ptp(run.x[:, 1]) < 0.1


def test_braking_leader_is_not_hit():
    # A pedestrian's track replays whatever it does: here it is a wall that brakes from 12 m/s with 5 m/s2.
    t = np.arange(91) * 0.1
    wall = profile(30, 0, np.clip(12 - 5 * (t - 2), 0, 12), kind=AgentKind.PEDESTRIAN, length=4.8, width=2.0)
    run = Run(straight_road([EGO, wall, car(0, 0, 0, 12)]))
    gaps = np.array([run.gap(2, 1, step) for step in range(81)])
    assert gaps.min() > 0.5 and run.gap(2, 1) == pytest.approx(2.0, abs=0.2)
    assert np.diff(run.speed[:, 2]).min() / 0.1 >= -6.0 - 1e-3


@pytest.mark.parametrize("speed", [4.0, 8.0, 11.0])
def test_equilibrium_gap_equals_the_closed_form(speed):
    # The follower's peak is 13 m/s; the leader, a replay, keeps its speed: (s0 + v T) / sqrt(1 - (v / v0)^4).
    fast = np.where(np.arange(91) < 2, 13.0, speed)
    wanted = (2.0 + 1.5 * speed) / np.sqrt(1 - (speed / 13.0) ** 4)
    leader = profile(0, 0, speed, kind=AgentKind.CYCLIST, length=4.8, width=2.0)
    run = Run(straight_road([EGO, leader, profile(-wanted - 4.8, 0, fast)]))
    assert run.speed[0, 2] == pytest.approx(speed)
    assert run.gap(2, 1, 80) == pytest.approx(wanted, abs=0.1)
    assert run.speed[80, 2] == pytest.approx(speed, abs=0.05)


def test_vehicles_yield_to_ego_that_cuts_in():
    cars = [car(12, 3.7, 0, 6), car(0, 0, 0, 10)]
    t = np.arange(1, 81) * 0.1
    change = np.clip(t / 2.0, 0, 1)
    ego = np.stack([12 + 6 * t, 3.7 * (1 - change), np.zeros(80), np.full(80, 6.0)], -1)
    alone_in_lane, cut_in = Run(straight_road(cars)), Run(straight_road(cars), ego)
    assert alone_in_lane.speed[:81, 1].min() > 9.9
    assert cut_in.speed[60:81, 1].max() < 7.0
    assert min(cut_in.gap(1, 0, step) for step in range(81)) > 0.5


def test_an_occupied_entry_place_delays_entry():
    # The car appears at step 30, where ego, which is elsewhere in the log, stands: always, or until step 50.
    cars = [car(-60, 0, 0, 0), profile(20, 0, 8.0, steps=range(30, 91))]
    at = float(cars[1]["xy"][30, 0])
    ego = np.tile(np.array([at, 0.0, 0.0, 0.0]), (80, 1))
    free, taken = Run(straight_road(cars)), Run(straight_road(cars), ego)
    # Time 0 is step 10.
    assert not free.valid[19, 1] and free.valid[20, 1]
    assert free.x[20, 1] == pytest.approx(at, abs=1e-3) and free.speed[20, 1] == pytest.approx(8.0, abs=1e-3)
    assert not taken.valid[:, 1].any() and (taken.phase(1) == WAITS).all()
    ego[40:] = [-60.0, 3.7, 0.0, 0.0]
    late = Run(straight_road(cars), ego)
    # Ego is gone in the frame of time 41; that frame decides whether the car enters at time 42.
    assert not late.valid[41, 1] and late.valid[42, 1]
    assert late.x[42, 1] == pytest.approx(at, abs=1e-3)


def test_vehicle_enters_no_faster_than_it_can_stop_behind_its_leader():
    cars = [car(-60, 0, 0, 0), profile(20, 0, 12.0, steps=range(30, 91))]
    at = float(cars[1]["xy"][30, 0])
    ego = np.tile(np.array([at + 4.8 + 8.0, 0.0, 0.0, 0.0]), (80, 1))
    run = Run(straight_road(cars), ego)
    # 8 m of gap less 2 m at rest leave 6 m at 3 m/s2: 6 m/s.
    assert run.valid[20, 1] and run.speed[20, 1] == pytest.approx(6.0, abs=1e-2)
    assert min(run.gap(1, 0, step) for step in range(20, 81)) > 1.0


def test_first_of_two_waiting_vehicles_enters_first():
    near = profile(20, 0, 4.0, steps=range(20, 91))
    begin = float(near["xy"][20, 0])
    other = profile(20, 0, 4.0, steps=range(40, 91))
    other["xy"][40:, 0] += begin + 1.0 - other["xy"][40, 0]
    ego = np.tile(np.array([begin, 0.0, 0.0, 0.0]), (80, 1))
    ego[44:] = [-60.0, 3.7, 0.0, 0.0]
    run = Run(straight_road([car(-60, 0, 0, 0), near, other]), ego)
    first, second = (int(np.argmax(run.valid[:, slot])) for slot in (1, 2))
    assert first == 46 and second > first + 5
    both = run.valid[:81, 1] & run.valid[:81, 2]
    assert (np.abs(run.x[:81, 1] - run.x[:81, 2])[both] > 4.8).all()


def test_a_vehicle_leaves_where_its_path_ends():
    # It drives for 3 s, then the log ends: 60 m further it is gone.
    run = Run(straight_road([EGO, profile(0, 0, 12.0, steps=range(0, 41))]))
    gone = int(np.argmax(run.phase(1) == LEFT))
    last = 12 * 3.0 + 60.0
    assert run.x[gone - 1, 1] < last and gone == pytest.approx(last / 12.0 / 0.1, abs=2)
    assert run.valid[:gone, 1].all() and not run.valid[gone:, 1].any()


def circle(radius, speed, kind=AgentKind.VEHICLE):
    """A car on a circle to the left around (0, radius)."""
    track = car(0, 0, 0, speed, kind=kind)
    angle = (np.arange(91) - 10) * 0.1 * speed / radius
    track["xy"] = radius * np.stack([np.sin(angle), 1 - np.cos(angle)], -1)
    track["heading"] = (angle + np.pi) % (2 * np.pi) - np.pi
    track["velocity"] = speed * np.stack([np.cos(angle), np.sin(angle)], -1)
    return track


def test_curves_limit_the_speed():
    run = Run(straight_road([EGO, circle(10.0, 8.0)]))
    logged = 8.0 * 8.0  # m of the path before it goes on straight
    arc = np.asarray(run.traffic.arc)[:, -1, run.row[1]]
    inside = (arc > 20.0) & (arc < logged - 10)
    # sqrt(2.5 m/s2 x 10 m)
    np.testing.assert_allclose(run.speed[inside, 1], 5.0, atol=0.1)
    radius = np.hypot(run.x[inside, 1], run.y[inside, 1] - 10.0)
    np.testing.assert_allclose(radius, 10.0, atol=0.1)


def test_initially_overlapping_pair_is_ignored_until_it_separates():
    slow = profile(1.0, 0.4, 5.0, kind=AgentKind.CYCLIST, length=4.8, width=2.0)
    run = Run(straight_road([EGO, slow, profile(0, 0, np.where(np.arange(91) < 2, 9.0, 6.0))]))
    # Without the rule it would brake hard behind something 1 m ahead; instead it overtakes what it overlaps.
    assert run.speed[:81, 2].min() > 5.9 and run.x[80, 2] > run.x[80, 1] + 4.8
    ignored = np.asarray(run.traffic.ignored)[:, run.row[2]]
    assert run.slots[1] in ignored[0] and (ignored[80] == -1).all()


def test_only_forward_moving_vehicles_react():
    standing = car(60, 0, 0, 0, kind=AgentKind.CYCLIST, length=4.8, width=2.0)
    backing = profile(100, 3.7, -2.0)
    creeping = profile(30, 3.7, np.where(np.arange(91) < 40, 0.0, 0.35))  # 1.8 m
    walker = profile(0, 0, 9.0, kind=AgentKind.PEDESTRIAN)
    cyclist = profile(-30, 0, 9.0, kind=AgentKind.CYCLIST)
    vehicle = profile(-60, 0, 9.0)
    run = Run(straight_road([EGO, standing, backing, creeping, walker, cyclist, vehicle]))
    for number, track in enumerate((standing, backing, creeping, walker, cyclist), 1):
        assert run.row[number] < 0 or (run.phase(number) == REPLAYS).all()
        np.testing.assert_allclose(run.x[:81, number], track["xy"][10:, 0], atol=1e-4)
    assert (run.phase(6)[:81] == DRIVES).all()


def test_agents_that_stop_at_the_start_replay():
    stops = profile(0, 0, np.where(np.arange(91) < 10, 8.0, np.where(np.arange(91) < 12, 2.0, 0.0)))
    run = Run(straight_road([EGO, stops]))
    assert run.row[1] >= 0 and (run.phase(1) == REPLAYS).all()


@pytest.mark.slow
def test_each_class_has_its_own_parameters():
    recording = straight_road([EGO, car(40, 0, 0, 0, kind=AgentKind.OTHER, length=4.8, width=2.0),
                               profile(0, 0, 6.0, kind=AgentKind.CYCLIST), profile(0, 3.7, 6.0)])  # fmt: skip
    careful = IdmParameters(min_gap_m=5.0)
    drivers = ((int(AgentKind.VEHICLE), IdmParameters()), (int(AgentKind.CYCLIST), careful))
    run = Run(recording, traffic=IdmTraffic(drivers=drivers))
    assert run.gap(2, 1) == pytest.approx(5.0, abs=0.5)
    assert run.phase(3)[80] == DRIVES


def test_all_agents_start_at_logged_poses():
    recording = straight_road([car(0, 0, 0, 8), circle(30.0, 8.0), car(-20, 3.7, 0.05, 9)], light=RED)
    bank = TRAFFIC.prepare(bank_of(recording))

    @jax.jit
    def past(bank):
        context = SIMULATOR.context(bank, 0, 10)
        return jnp.stack([TRAFFIC.agents(bank, context, back) for back in range(10)])

    np.testing.assert_array_equal(past(bank), np.asarray(bank.agents[0, 10:0:-1]))


def test_history_of_a_vehicle_is_its_simulated_motion():
    bank = TRAFFIC.prepare(bank_of(straight_road([EGO, car(0, 0, 0, 8)], light=RED)))
    _, traffic = _drive(TRAFFIC, bank, 0, jnp.zeros((151, 4)))

    @jax.jit
    def rows(bank, traffic, step):
        context = replace(SIMULATOR.context(bank, 0, 10), step=10 + step)
        context = replace(context, traffic=jax.tree.map(lambda leaf: leaf[step], traffic))
        return jnp.stack([TRAFFIC.agents(bank, context, back) for back in (0, 1, 4, 9)])

    for place, back in enumerate((1, 4, 9), 1):
        np.testing.assert_array_equal(rows(bank, traffic, 30)[place], rows(bank, traffic, 30 - back)[0])


def test_paths_follow_the_log_and_continue_along_the_lane():
    bank = TRAFFIC.prepare(bank_of(straight_road([EGO, car(0, 0.8, 0, 10)])))
    paths, row = data_of(bank, AgentPaths), list(np.asarray(data_of(bank, AgentPaths).slot[0])).index(1)
    points, spacing = np.array(paths.points[0, row]), float(paths.spacing[0, row])
    points[:, :2] += [-100.0, 3.7]
    assert spacing * (PATH_POINTS - 1) == pytest.approx(90.0 + 60.0, abs=0.1)
    # 90 m as logged, 0.8 m left of the lane; then the offset fades within 20 m.
    np.testing.assert_allclose(points[:57, PATH_Y], 0.8, atol=1e-4)
    np.testing.assert_allclose(points[72:, PATH_Y], 0.0, atol=1e-3)
    np.testing.assert_allclose(points[:, PATH_X], -10 + spacing * np.arange(PATH_POINTS), atol=0.1)
    np.testing.assert_allclose(points[:, PATH_COS] ** 2 + points[:, PATH_SIN] ** 2, 1.0, atol=1e-5)
    np.testing.assert_allclose(paths.profile[0, row, :50, PROFILE_SPEED], 10.0, atol=1e-4)
    np.testing.assert_allclose(np.asarray(paths.log_arc[0, :, row]), np.arange(91) * 1.0, atol=1e-3)


@pytest.mark.parametrize("seed", range(4))
def test_all_agents_follow_idm_in_random_traffic(seed):
    rng = np.random.default_rng(seed)
    colours = np.repeat(rng.choice([RED, GREEN, LightState.CAUTION], 4), 23)[:91]
    cars = [car(rng.uniform(-40, 40), 3.7, 0, rng.uniform(2, 9))]
    for place in rng.permutation(np.arange(-80, 120, 18))[:9]:
        steps = range(int(rng.choice([0, 0, 0, 25])), 91)
        pace = np.clip(rng.uniform(0, 13) + np.cumsum(rng.normal(0, 0.2, 91)), 0, 14)
        lane = rng.choice([0.0, 3.7]) + rng.normal(0, 0.2)
        cars.append(profile(place + rng.uniform(0, 8), lane, pace, steps=steps, length=rng.uniform(4, 9)))
    run = Run(straight_road(cars, light=colours))
    away, acceleration = compare(run.bank, 0, run.frames, run.traffic, every=9).T
    assert len(away) > 20 and (acceleration < 0).any()
    assert away.max() < 1e-3


def test_bank_without_paths_is_refused_and_bank_with_paths_is_kept():
    bank = bank_of(straight_road([EGO, car(0, 0, 0, 8)]))
    with pytest.raises(UsageError, match="no AgentPaths"):
        SIMULATOR.context(bank, 0, 10)
    ready = TRAFFIC.prepare(bank)
    assert TRAFFIC.prepare(ready) is ready


def test_paths_prepared_for_other_classes_are_recomputed():
    bank = bank_of(straight_road([EGO, car(0, 0, 0, 8), car(-30, 0, 0, 5, kind=AgentKind.CYCLIST)]))
    both = IdmTraffic(drivers=((1, IdmParameters()), (int(AgentKind.CYCLIST), IdmParameters())))
    few = TRAFFIC.prepare(bank)
    more = both.prepare(few)
    assert [int((data_of(b, AgentPaths).slot[0] >= 0).sum()) for b in (few, more)] == [1, 2]
    assert both.prepare(more) is more


@pytest.mark.parametrize("kinds", [(), (1, 1)])
def test_missing_or_repeated_classes_are_refused(kinds):
    with pytest.raises(UsageError, match="name one class or more, each once"):
        IdmTraffic(drivers=tuple((kind, IdmParameters()) for kind in kinds))


def test_traffic_with_ego_alone_stays_empty():
    bank = TRAFFIC.prepare(bank_of(straight_road([car(0, 0, 0, 8)])))
    assert int((np.asarray(data_of(bank, AgentPaths).slot) >= 0).sum()) == 1  # ego, when it is not driven
    frames, _ = _drive(TRAFFIC, bank, 0, jnp.zeros((151, 4)))
    assert not np.asarray(frames.valid)[:, 1:].any()
