"""Lane changes and merges on hand-made roads and those of the built-in world: the exact step of each, and no others."""

from __future__ import annotations

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.planners.simple import logged_motion
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.scenario.recording import MapFeature
from drivax.scenario.schema import CAPACITIES, STEPS, RoadKind
from drivax.simulator.simulator import Simulator
from drivax.synthetic.roads.families import Highway, LaneDrop
from drivax.synthetic.roads.network import map_features
from drivax.tasks.rewards import RewardConfig
from drivax.tasks.task import Task
from metric_scenes import two_way_road
from scenes import GLIMPSE, LANE_M, car, line, straight_road

T = (np.arange(STEPS) - 10) * 0.1
SIZE = replace(CAPACITIES["default"], agents=2, parked=2, lights=2)
SIMULATOR = Simulator(Task(rewards=RewardConfig(preset="aggressive"), metrics="none", ends=()))


def along(x, y):
    """A car through given positions, heading where it goes."""
    xy = np.stack(np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float)), -1)
    velocity = np.gradient(xy, 0.1, axis=0)
    heading = np.arctan2(velocity[:, 1], velocity[:, 0])
    return car() | {"xy": xy, "heading": heading, "velocity": velocity}


def aside(start_s, metres, rate=1.0):
    """Offsets to the left at every step, m: 0 until ``start_s``, then ``rate`` m/s up to ``metres``."""
    return np.clip(rate * (T - start_s), 0.0, abs(metres)) * np.sign(metres)


def lanes(ego, *features):
    return replace(straight_road([ego]), features=features, route_lanes=())


def lane(number, points, **links):
    return MapFeature(number, RoadKind.LANE_SURFACE, points, 13.4, LANE_M, **links)


def drop(ego, end):
    """Lane 1 on y = 0 ends, lane 2 on y = 3.7 goes on as lane 3."""
    return lanes(
        ego,
        lane(1, line((-150, 0), (end, 0)), left_neighbours=(2,)),
        lane(2, line((-150, LANE_M), (end, LANE_M)), successors=(3,), right_neighbours=(1,)),
        lane(3, line((end, LANE_M), (400, LANE_M))),
    )


def taper(ego):
    """Lane 1 comes over to lane 2 between x = 30 and 90; both go on as lane 3."""
    return lanes(
        ego,
        lane(1, line((-150, 0), (30, 0), (90, LANE_M)), successors=(3,), left_neighbours=(2,)),
        lane(2, line((-150, LANE_M), (90, LANE_M)), successors=(3,), right_neighbours=(1,)),
        lane(3, line((90, LANE_M), (400, LANE_M))),
    )


def ramp(ego):
    """Lane 1 comes in at 0.2 rad and joins at the origin of lane 3."""
    begin = (-200 * math.cos(0.2), -200 * math.sin(0.2))
    return lanes(
        ego,
        lane(1, line(begin, (0, 0)), successors=(3,)),
        lane(2, line((-200, 0), (0, 0)), successors=(3,)),
        lane(3, line((0, 0), (400, 0))),
    )


def fork(ego):
    """Lane 1 goes on as lane 2, and as lane 3, which goes over to y = 3.7 within 60 m and runs alongside it."""
    return lanes(
        ego,
        lane(1, line((-150, 0), (0, 0)), successors=(2, 3)),
        lane(2, line((0, 0), (300, 0)), left_neighbours=(3,)),
        lane(3, line((0, 0), (60, LANE_M), (300, LANE_M)), right_neighbours=(2,)),
    )


def junction(ego):
    """From the west straight on, from the south right: both into the road to the east."""
    turn = np.linspace(math.pi, math.pi / 2, 20)
    arc = np.stack([10 + 10 * np.cos(turn), -10 + 10 * np.sin(turn), 0 * turn], -1)
    return lanes(
        ego,
        lane(1, line((-150, 0), (-10, 0)), successors=(2,)),
        lane(2, line((-10, 0), (10, 0)), successors=(3,)),
        lane(3, line((10, 0), (200, 0))),
        lane(4, line((0, -150), (0, -10)), successors=(5,)),
        lane(5, arc, successors=(3,)),
    )


def turning():
    """Along lanes 4, 5 and 3 of the junction at 5 m/s, 20 m before the junction at step 10."""
    s, bend = 5.0 * T - 10.0, 5 * math.pi
    angle = math.pi - np.clip(s, 0, bend) / 10
    x = 10 + 10 * np.cos(angle) + np.maximum(s - bend, 0.0)
    return along(x, -10 + 10 * np.sin(angle) + np.minimum(s, 0.0))


def ramping():
    """Along lanes 1 and 3 of the ramp at 15 m/s, 60 m before it ends at step 10."""
    s = 15.0 * T - 60.0
    return along(np.where(s < 0, s * math.cos(0.2), s), np.minimum(s, 0.0) * math.sin(0.2))


def built_in(family, seed):
    """A road of the built-in world with an outer lane that ends or leads off, and ego on it until it changes.

    Ego drives at 20 m/s, 170 m before the end of the lane at step 10, and from 5 s on it goes over to the lane beside
    at 2 m/s.
    """
    network = family.build(np.random.default_rng(seed))
    outer = next(
        i
        for i, one in enumerate(network.lanes)
        if (one.ends or one.exit_only) and (one.left >= 0) != (one.right >= 0) and len(one.predecessors)
        and not any(network.lanes[s].left >= 0 for s in one.successors)
    )  # fmt: skip
    chain = [outer]
    while network.lanes[chain[0]].predecessors and len(chain) < 5:
        chain.insert(0, network.lanes[chain[0]].predecessors[0])
    xy = np.concatenate([network.lanes[i].curve.xy[: None if i == outer else -1] for i in chain])
    arc = np.concatenate([[0.0], np.hypot(*np.diff(xy, axis=0).T).cumsum()])
    at, width = arc[-1] - 170.0 + 20.0 * T, network.lanes[outer].width_m
    centre = np.stack([np.interp(at, arc, xy[:, k]) for k in (0, 1)], -1)
    course = np.unwrap(np.arctan2(*np.gradient(centre, axis=0).T[::-1]))
    counts_at = width / 2 + 0.3
    start_s = 5.05 - counts_at / 2.0 % 0.1  # so that it counts in the middle of a step
    shift = aside(start_s, width if network.lanes[outer].left >= 0 else -width, 2.0)
    ego = along(*(centre + shift[:, None] * np.stack([-np.sin(course), np.cos(course)], -1)).T)
    recording = replace(straight_road([ego]), features=map_features(network), route_lanes=())
    return recording, int(np.argmax(np.abs(shift) > counts_at))


STAYS = aside(1.0, 1.85)
#: Scenes with the steps of lane changes and of merges. The boundary of lanes is at 1.85 m; a change counts at 2.15 m.
SCENES = {
    "left": (straight_road([along(10 * T, aside(1.0, LANE_M))]), [42], []),
    "right": (straight_road([along(10 * T, LANE_M - aside(1.0, LANE_M))]), [42], []),
    "straight on past a successor": (straight_road([along(10 * T, 0.3)]), [], []),
    "left where lanes follow each other": (straight_road([along(10 * T + 9, aside(1.0, LANE_M))]), [42], []),
    "along the line": (straight_road([along(10 * T, STAYS + (T > 4) * 0.2 * np.sin(2 * T))]), [], []),
    "there and back": (
        straight_road([along(10 * T, aside(1.0, LANE_M) - aside(5.0, LANE_M))]), [42, 82], [],
    ),
    "into oncoming traffic": (two_way_road([along(10 * T, aside(1.0, LANE_M))]), [], []),
    "a lane drop": (drop(along(10 * T, aside(1.0, LANE_M)), 60.0), [42], [42]),
    "long before a lane drop": (drop(along(10 * T, aside(1.0, LANE_M)), 200.0), [42], []),
    "past the end of a lane": (drop(along(10 * T, aside(6.0, LANE_M)), 60.0), [], [74]),
    "along a taper": (taper(along(15 * T, LANE_M * np.clip((15 * T - 30) / 60, 0, 1))), [], [71]),
    "to the lane that is joined": (taper(along(10 * T, aside(0.5, LANE_M, 2.0))), [26], [26]),
    "a ramp": (ramp(ramping()), [], [51]),
    "beside a ramp": (ramp(along(15 * T - 60, 0.0)), [], []),
    "a fork": (fork(along(10 * T, LANE_M * np.clip(10 * T / 60, 0, 1))), [], []),
    "a change behind a fork": (fork(along(10 * T, aside(6.5, LANE_M, 2.0))), [86], []),
    "right at a junction": (junction(turning()), [], []),
    "straight on at a junction": (junction(along(8 * T - 20, 0.0)), [], []),
}  # fmt: skip
BUILT_IN = {
    "a highway's on-ramp": (Highway(shares=(1.0, 0.0, 0.0)), 3, True),
    "a highway's weaving lane": (Highway(shares=(0.0, 0.0, 1.0)), 4, False),
    "a road that loses a lane": (LaneDrop(gain_share=0.0), 5, True),
}


def scenes():
    made = dict(SCENES)
    for name, (family, seed, merges) in BUILT_IN.items():
        recording, step = built_in(family, seed)
        made[name] = (recording, [step], [step] if merges else [])
    return made


@jax.jit
def replayed(bank):
    """Facts and reward terms of steps 11 to 90 when ego drives as logged, from step 10 on; rows are scenarios."""

    def one(bank, row):
        def step(state, _):
            now = logged_motion(bank, state.context, 1)
            after, transition = SIMULATOR.replay(bank, state, now, jnp.zeros(2))
            return after, (after.facts, transition.reward_terms)

        return jax.lax.scan(step, SIMULATOR.reset(bank, row), None, 80)[1]

    return jax.vmap(one, (None, 0))(bank, jnp.arange(len(bank)))


@jax.jit
def scored(bank, row):
    """Reward terms of each logged step of a scenario by itself: from a reset at the step before."""

    def one(at):
        state = SIMULATOR.reset(bank, row, at)
        now = logged_motion(bank, state.context, 1)
        return SIMULATOR.replay(bank, state, now, jnp.zeros(2))[1].reward_terms

    return jax.lax.map(one, jnp.arange(10, 90))


def test_episodes_that_start_in_a_lane_change_come_from_the_old_lane():
    """Ego is 2 m aside at the start, 0.15 m beyond the line between the lanes; the change counts two steps later."""
    bank = ScenarioBank.from_scenarios([assemble(straight_road([along(10 * T, aside(-2.0, LANE_M))]), SIZE)])
    task = Task(observation=GLIMPSE, rewards=RewardConfig(preset="safety", lane_change=0.2), metrics="none")
    simulator = Simulator(replace(task, ends=()))

    @jax.jit
    def start(bank, is_reset):
        state = simulator.reset(bank, 0)
        done, fresh = jnp.asarray(True), simulator.new_episode(bank, 0)
        again, _ = simulator.step_or_reset(bank, state, jnp.zeros(2), done, fresh)
        state = jax.tree.map(lambda first, then: jnp.where(is_reset, first, then), state, again)

        def step(state, _):
            state, _ = simulator.replay(bank, state, logged_motion(bank, state.context, 1), jnp.zeros(2))
            return state, state.facts.lane_changed

        return jax.lax.scan(step, state, None, 3)[1]

    for is_reset in (True, False):
        assert start(bank, is_reset).tolist() == [False, True, False]


@pytest.fixture(scope="module")
def driven():
    made = scenes()
    assembled = [assemble(recording, SIZE) for recording, _, _ in made.values()]
    for name, scenario in zip(made, assembled, strict=True):
        # Far ends of long roads lie outside the grid.
        assert not {"lane_run", "lanes", "lane_links"} & set(scenario.overflow), name
    bank = ScenarioBank.from_scenarios(assembled, trim=False)
    return made, bank, jax.device_get(replayed(bank))


def steps_of(flags):
    return (np.flatnonzero(flags) + 11).tolist()


@pytest.mark.slow
def test_every_scene_has_its_lane_changes_and_merges(driven):
    made, _, (facts, _) = driven
    found = {
        name: (steps_of(facts.lane_changed[row]), steps_of(facts.merged[row]))
        for row, name in enumerate(made)
    }
    assert found == {name: (changes, merges) for name, (_, changes, merges) in made.items()}


@pytest.mark.slow
def test_lane_changes_and_merges_are_rewarded_once(driven):
    _, _, (facts, terms) = driven
    np.testing.assert_allclose(terms["lane_change"], 0.2 * facts.lane_changed)
    np.testing.assert_allclose(terms["merge"], 0.2 * facts.merged)


@pytest.mark.slow
def test_logged_steps_have_the_rewards_of_simulated_steps(driven):
    made, bank, (_, terms) = driven
    for name in ("there and back", "a lane drop", "a ramp", "a fork"):
        row = list(made).index(name)
        alone = jax.device_get(scored(bank, row))
        for term, values in alone.items():
            np.testing.assert_allclose(values, terms[term][row], atol=1e-6, err_msg=f"{name}: {term}")


@pytest.mark.slow
def test_the_state_stays_small(driven):
    _, bank, (facts, _) = driven
    assert facts.ignored is None and facts.strand.dtype == np.int16
    state = jax.eval_shape(SIMULATOR.reset, bank, 0)
    assert sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(state)) <= 4096
