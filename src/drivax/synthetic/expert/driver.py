"""The expert that drives ego: the traffic model with a smooth driver, replanned where its motion is rejected."""

from __future__ import annotations

from collections.abc import Generator
from functools import partial

import numpy as np

from drivax.scenario.schema import AgentKind
from drivax.synthetic.expert.plan import plan_ego
from drivax.synthetic.expert.violations import Violation, discomfort, find_violation, is_staged, last_stop
from drivax.synthetic.roads.network import RoadNetwork
from drivax.synthetic.traffic.paths import LaneChange, Path, Sway, lane_path, random_lanes
from drivax.synthetic.traffic.roles import Drivers, Motion, Roles, Staging
from drivax.synthetic.traffic.simulation import Run, WorldTraffic

#: Hardest braking of an accepted expert, m/s2: just within nuPlan's comfort limit, and the IDM's limit in events.
HARDEST_MPS2, HARDEST_IN_EVENT_MPS2 = 4.0, 6.0
#: Position of ego's planned lane change on the old lane, and its length, low and high, m.
_CHANGE_BEGIN_M, _CHANGE_LENGTH_M = (1.0, 12.0), (52.0, 64.0)
#: Causes that no plan can fix, and a cause that a plan rarely fixes unless an event is staged.
_UNFIXABLE, _HARDLY_MOVES = ("ego_leaves_map", "other_runs_red", "others_collide"), "ego_hardly_moves"


def draw_expert(rng: np.random.Generator) -> Drivers:
    """Draw ego's car and driver: below the speed limit and well within comfort limits."""
    uniform = partial(rng.uniform, size=1)
    size = np.array([[rng.uniform(4.5, 5.0), rng.uniform(1.85, 2.05), rng.uniform(1.5, 1.8)]])
    return Drivers(
        kind=np.full(1, AgentKind.VEHICLE, np.int8),
        size_m=size,
        top_speed_mps=np.full(1, np.inf),
        speed_factor=uniform(0.85, 0.98),
        lateral_mps2=uniform(1.8, 2.4),
        slowing_mps2=uniform(1.1, 1.5),
        yellow_mps2=uniform(2.2, 2.6),
        jerk_mps3=uniform(2.0, 2.6),
        headway_s=uniform(1.3, 1.8),
        acceleration_mps2=uniform(1.3, 1.8),
        braking_mps2=uniform(1.8, 2.2),
        politeness=uniform(0.3, 0.5),
        reaction_s=np.zeros(1),
        critical_gap_s=uniform(4.5, 5.5),
    )


def expert_lanes(
    network: RoadNetwork, lane: int, change_share: float, rng: np.random.Generator
) -> tuple[tuple[int, ...], LaneChange | None]:
    """Draw ego's lanes, a predecessor of the first one included, and sometimes a change on the third or fourth lane."""
    lanes = random_lanes(network, lane, rng)
    predecessors = network.lanes[lane].predecessors
    if predecessors:
        lanes = (predecessors[0], *lanes)
    sections = [k for k in range(2, min(4, len(lanes))) if _neighbours(network, lanes[k])]
    if not sections or rng.random() >= change_share:
        return lanes, None
    section = int(rng.choice(sections))
    neighbour = int(rng.choice(_neighbours(network, lanes[section])))
    change = LaneChange(section, float(rng.uniform(*_CHANGE_BEGIN_M)), float(rng.uniform(*_CHANGE_LENGTH_M)))
    return (*lanes[: section + 1], *random_lanes(network, neighbour, rng)), change


def _neighbours(network: RoadNetwork, lane: int) -> list[int]:
    """Return the adjacent lanes of a street's section (70 to 100 m long, no connector); none for other lanes."""
    current = network.lanes[lane]
    if current.connector or not 70.0 < current.length_m < 100.0:
        return []
    return [neighbour for neighbour in (current.left, current.right) if neighbour >= 0]


def expert_path(
    network: RoadNetwork, lanes: tuple[int, ...], change: LaneChange | None, rng: np.random.Generator
) -> Path:
    """Return ego's path, close to the centres of its lanes."""
    return lane_path(network, lanes, Sway.draw(rng, 0.12), change)


def drive_ego(
    traffic: WorldTraffic,
    staging: Staging,
    first_step: int,
    aware_step: int = 0,
    unplanned: Motion | None = None,
) -> Generator[Run, Motion, tuple[Motion, str]]:
    """Drive ego like other traffic if that is acceptable and comfortable, else along a plan.

    A plan knows the motion of the others, but they react to it: each of at most three plans is simulated, checked, and
    replaced by one that begins no later if it fails. A safe but uncomfortable motion without a plan is the last resort.

    Args:
        traffic: All users, and the times of all steps on the clock of the lights.
        staging: The staged event.
        first_step: First step of the recording and, at the earliest, of a plan.
        aware_step: Step from which ego reacts to the event; earlier where that is too late.
        unplanned: The motion without a plan, if known.

    Yields:
        Runs of the traffic; the caller sends back their motion.

    Returns:
        The motion, and the cause of its rejection (empty: accepted).
    """
    roles, times_s = traffic.roles, traffic.times_s
    hardest_mps2, unfixable = HARDEST_MPS2, (*_UNFIXABLE, _HARDLY_MOVES)
    if is_staged(staging):
        hardest_mps2, unfixable = HARDEST_IN_EVENT_MPS2, _UNFIXABLE

    def check_motion(motion: Motion) -> Violation:
        return find_violation(roles, motion, times_s, first_step, staging, hardest_mps2)

    def is_comfortable(motion: Motion) -> bool:
        return not discomfort(motion.heading[0, first_step:], motion.speed[0, first_step:])

    motion = unplanned or (yield Run(traffic, staging))
    violation = check_motion(motion)
    if (not violation.cause and is_comfortable(motion)) or violation.cause in unfixable:
        return motion, violation.cause
    fallback = None if violation.cause else motion
    unreactive: frozenset[int] = frozenset()
    for begin in _first_steps(roles, motion, violation, first_step, aware_step):
        plan = plan_ego(roles, motion, times_s, begin, unreactive)
        motion = yield Run(traffic, staging, plan)
        violation = check_motion(motion)
        unreactive |= set(violation.users)
        if not violation.cause and (fallback is None or is_comfortable(motion)):
            return motion, ""
        if violation.cause in ("", *unfixable):
            break
    return (motion, violation.cause) if fallback is None else (fallback, "")


def _first_steps(
    roles: Roles, motion: Motion, violation: Violation, first_step: int, aware_step: int
) -> tuple[int, int, int]:
    """Return the first steps of three plans, none later than the one before.

    The first two do not precede ego's last stop at a sign, unless ego collides before it stops.
    """
    latest_step = max(first_step, aware_step)
    stop_step = last_stop(roles, motion, first_step)
    if violation.cause == "ego_collides":
        latest_step = latest_step if latest_step < violation.step else first_step
        stop_step = stop_step if stop_step < violation.step else first_step
    return max(latest_step, stop_step), max((first_step + latest_step) // 2, stop_step), first_step
