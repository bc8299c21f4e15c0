"""Agents in the corridor of a path that turns: a straight, a quarter circle to the left, a straight."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.simulator.traffic.agent_paths import PATH_POINTS, AgentPaths
from drivax.simulator.traffic.corridor import FREE_M, SIDE_M, Movers, leaders
from drivax.simulator.types import Frame

RADIUS, BEFORE, LENGTH = 8.0, 20.0, 180.0
QUARTER = RADIUS * np.pi / 2
CAR, PERSON, POST = (4.8, 2.0), (0.6, 0.6), (0.01, 0.01)
#: Slots of every frame; empty ones are not valid.
SLOTS = 12


def pose(arc, left=0.0):
    """Return x, y and heading at an arc length, ``left`` metres to the left of the path."""
    arc = np.asarray(arc, float)
    turn = np.clip((arc - BEFORE) / RADIUS, 0.0, np.pi / 2)
    beyond = np.maximum(arc - BEFORE - QUARTER, 0.0)
    x = np.minimum(arc, BEFORE) + RADIUS * np.sin(turn) - left * np.sin(turn)
    y = RADIUS * (1 - np.cos(turn)) + beyond + left * np.cos(turn)
    return x, y, turn


def thing(arc, left, size):
    x, y, heading = pose(arc, left)
    return [x, y, np.cos(heading), np.sin(heading), *size]


def paths():
    arc = np.linspace(0.0, LENGTH, PATH_POINTS)
    x, y, heading = pose(arc)
    direction = [np.cos(heading), np.sin(heading)]
    points, profile = np.stack([x, y, *direction], -1), np.stack([0 * x, 0 * x + 15.0], -1)
    return AgentPaths(
        slot=jnp.zeros((1, 1), jnp.int16),
        points=jnp.asarray(points, jnp.float32)[None, None],
        profile=jnp.asarray(profile, jnp.float32)[None, None],
        spacing=jnp.full((1, 1), LENGTH / (PATH_POINTS - 1)),
        log_arc=jnp.zeros((1, 91, 1)),
        log_speed=jnp.zeros((1, 91, 1)),
        appears=jnp.zeros((1, 91, 1), jnp.int16),
        stop_arc=jnp.full((1, 1, 4), 1e6),
        stop_light=jnp.zeros((1, 1, 4), jnp.int16),
        overlaps=jnp.full((1, 91, 1, 2), -1, jnp.int16),
        kinds=(1,),
    )


@jax.jit
def _gap(arc, speed, box, valid):
    """The gap that a car at an arc length finds; its own box is the first of the frame."""
    kind, lights = jnp.ones(SLOTS, jnp.int32), jnp.zeros(0, jnp.int32)
    frame = Frame(box, jnp.zeros((SLOTS, 2)), jnp.zeros(SLOTS), valid, kind, lights)
    me = Movers(box[:1], jnp.zeros(1), arc[None], speed[None], jnp.zeros(1, jnp.int32), jnp.full((1, 2), -1))
    return leaders(paths(), jnp.int32(0), me, frame).gap[0]


_gaps = jax.jit(jax.vmap(_gap))


def gaps(cases):
    """Gaps for cases of (arc, speed, things)."""
    box, valid = np.zeros((len(cases), SLOTS, 6), np.float32), np.zeros((len(cases), SLOTS), bool)
    for row, (arc, _, things) in enumerate(cases):
        boxes = np.array([thing(arc, 0.0, CAR), *things])
        box[row, : len(boxes)], valid[row, : len(boxes)] = boxes, True
    arc, speed = (jnp.asarray([case[k] for case in cases], jnp.float32) for k in (0, 1))
    return np.asarray(_gaps(arc, speed, jnp.asarray(box), jnp.asarray(valid)))


@pytest.mark.parametrize("left", [-0.9, -0.5, 0.0, 0.5, 0.9])
@pytest.mark.parametrize("size", [PERSON, CAR])
def test_gap_counts_agents_reaching_into_the_corridor_behind_a_turn(left, size):
    at = BEFORE + QUARTER + 6.0
    arcs = np.array([6.0, 10.0, 14.0, 18.0, 22.0, 26.0])
    found = gaps([(arc, 8.0, [thing(at, left, size)]) for arc in arcs])
    np.testing.assert_allclose(found, at - arcs - 2.4 - size[0] / 2, atol=0.15)


def test_agents_next_to_the_corridor_do_not_hide_obstacles():
    car = thing(BEFORE + 16.0, 0.0, CAR)
    # Nine of them, on the inside of the turn and along the way to it, each nearer than the car.
    people = [thing(arc, 3.0, PERSON) for arc in np.linspace(5.0, 33.0, 9)]
    arcs = np.arange(0.0, 20.0, 2.0)
    crowded, alone = (gaps([(arc, 8.0, [*crowd, car]) for arc in arcs]) for crowd in (people, []))
    np.testing.assert_array_equal(crowded, alone)
    assert (alone < 40.0).all()


def test_corridor_is_as_wide_as_the_vehicle_and_its_margins():
    border = CAR[1] / 2 + SIDE_M + POST[1] / 2
    cases, inside = [], []
    for arc in (0.0, 6.0, 12.0):
        for speed in (2.0, 5.0, 8.0, 11.0):
            for ahead in np.arange(4.0, 20.0, 1.3):
                for left in (*np.arange(border - 0.3, border + 0.4, 0.1) + 0.05, 1.6):
                    for side in (-1.0, 1.0):
                        cases.append((arc, speed, [thing(arc + ahead, side * left, POST)]))
                        inside.append(left < border)
    found, inside = gaps(cases) < FREE_M, np.array(inside)
    assert 300 < inside.sum() < len(inside) - 300
    assert (found == inside).mean() > 0.99
