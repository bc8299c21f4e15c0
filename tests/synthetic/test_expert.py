from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivax.synthetic.expert.driver import draw_expert, drive_ego, expert_lanes, expert_path
from drivax.synthetic.expert.violations import first_overlap_step, user_boxes
from drivax.synthetic.roads.families import CurvedRoad
from drivax.synthetic.roads.network import GRID, Control
from drivax.synthetic.traffic.roles import Override, Staging
from drivax.synthetic.traffic.simulation import WorldTraffic

from .staged_scenes import CAR, TIMES, crossed, driven, road, scene, user

EVENT = Staging(overrides=(Override(0, 0, 0, 9.0),))
BARRIER = (1.0, 20.0, 1.5)


class Runs:
    """Traffic in which no user reacts; it remembers the plans."""

    def __init__(self, motion, reaction=None):
        self.motion, self.plans, self.reaction = motion, [], reaction

    def __call__(self, staging, plan):
        if plan is None:
            return self.motion
        self.plans.append(plan)
        motion = driven(self.motion, plan)
        return motion if self.reaction is None else self.reaction(motion, len(self.plans))


def drive(roles, staging, first_step, runs, aware_step=0):
    """The motion of :func:`drive_ego` and its cause of rejection; ``runs`` answers its runs."""
    task = drive_ego(WorldTraffic(roles, TIMES), staging, first_step, aware_step)
    run = next(task)
    while True:
        assert run.staging == staging
        try:
            run = task.send(runs(run.staging, run.ego))
        except StopIteration as end:
            return end.value


def test_good_drive_is_kept():
    roles, motion = scene(road(), 12.0)
    runs = Runs(motion)
    got, cause = drive(roles, Staging(), 0, runs)
    assert (got, cause, runs.plans) == (motion, "", [])


def test_planning_avoids_a_collision():
    roles, motion = scene(road((1,)), 12.0, [user((80.0, 0.0))])
    runs = Runs(motion)
    got, cause = drive(roles, EVENT, 10, runs)
    assert cause == ""
    assert [plan.first_step for plan in runs.plans] == [10]
    assert np.array_equal(got.xy[0, :11], motion.xy[0, :11])
    box = user_boxes(got)
    assert (first_overlap_step(box, got.valid, ~np.eye(2, dtype=bool)) == len(TIMES)).all()


@pytest.mark.parametrize(("aware", "begins"), [(15, [15]), (32, [32, 16])])
def test_ego_reacts_late_where_possible(aware, begins):
    # At 12 m/s bumpers meet during the 38th step; a plan from 3.2 s on cannot avoid it.
    roles, motion = scene(road((1,)), 12.0, [user((80.0, 0.0))])
    runs = Runs(motion)
    assert drive(roles, EVENT, 0, runs, aware)[1] == ""
    assert [plan.first_step for plan in runs.plans] == begins


def test_unavoidable_collisions_are_rejected_by_cause():
    roles, motion = scene(road((1,)), 14.0, [user((40.0, 0.0), size=BARRIER)])
    runs = Runs(motion)
    _, cause = drive(roles, EVENT, 0, runs)
    assert cause == "ego_collides"
    assert len(runs.plans) == 3


def test_common_driving_must_not_brake_hard():
    # 12^2 / (2 x 5.2) m and a metre ahead of the bumper.
    barrier = user((30.0 + 2.3 + 13.8 + 1.5, 0.0), size=BARRIER)
    roles, motion = scene(road((1,)), 12.0, [barrier])
    assert drive(roles, EVENT, 0, Runs(motion))[1] == ""
    assert drive(roles, Staging(), 0, Runs(motion))[1] == "ego_brakes_hard"


@pytest.mark.parametrize(("staging", "cause", "plans"), [(Staging(), "ego_hardly_moves", 0), (EVENT, "", 1)])
def test_standing_ego_is_planned_only_for_staged_events(staging, cause, plans):
    roles, motion = scene(road(), 0.0)
    runs = Runs(motion)
    assert drive(roles, staging, 0, runs)[1] == cause
    assert len(runs.plans) == plans


def test_plans_repeat_after_reactions_of_others():
    """The standing car is 8 m nearer from 3 s on as soon as ego has a plan."""
    roles, motion = scene(road((1,)), 12.0, [user((85.0, 0.0))])

    def reaction(motion, run):
        xy = motion.xy.copy()
        xy[1, 30:, 0] = 77.0
        return replace(motion, xy=xy)

    runs = Runs(motion, reaction)
    got, cause = drive(roles, EVENT, 0, runs)
    assert cause == ""
    assert 1 <= len(runs.plans) <= 3
    assert got.xy[0, -1, 0] < 77.0 - CAR[0]


def test_rough_drive_is_smoothed_or_kept():
    roles, motion = scene(road((1,)), 12.0)
    speed = motion.speed.copy()
    speed[0] = 12.0 - 0.5 * np.sin(2 * np.pi * TIMES / 0.9)
    rough = replace(motion, speed=speed)
    runs = Runs(rough)
    got, cause = drive(roles, EVENT, 0, runs)
    assert cause == ""
    assert np.abs(np.diff(got.speed[0])).max() < np.abs(np.diff(speed[0])).max() / 3


def test_plan_starts_at_the_stop_sign():
    roles, motion = scene(crossed(100.0, Control.STOP), 10.0, [user((140.0, 0.0))], lanes=(0, 1, 2))
    falling = 10.0 - 0.25 * np.arange(41)
    speed = np.concatenate([falling, np.zeros(5), 0.2 * np.arange(1, 46)])
    at = 75.0 + np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) * 0.05)])
    at += 100.0 - 1.0 - CAR[0] / 2 - at[40]
    xy = motion.xy.copy()
    xy[0, :, 0] = at
    speeds = motion.speed.copy()
    speeds[0] = speed
    motion = replace(motion, xy=xy, speed=speeds, distance_m=at[None])
    blocked = motion.xy.copy()
    blocked[1, :, 0] = at[-1] - 1.0
    runs = Runs(replace(motion, xy=blocked))
    got, cause = drive(roles, EVENT, 0, runs)
    assert cause == ""
    assert runs.plans[0].first_step == 47  # 0.4 m/s: still standing
    assert got.xy[0, -1, 0] < blocked[1, 0, 0] - CAR[0]


@pytest.mark.parametrize("seed", range(3))
def test_drawn_experts_prefer_less_than_the_limit_and_have_a_long_path(seed):
    rng = np.random.default_rng(seed)
    network = CurvedRoad().build(rng, GRID)
    driver = draw_expert(rng)
    assert driver.speed_factor[0] < 1.0
    lanes, change = expert_lanes(network, network.starts[0].lane, 1.0, rng)
    path = expert_path(network, lanes, change, rng)
    assert path.length_m > 100.0
