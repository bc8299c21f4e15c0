"""Contacts: time to collision against a fine simulation, fault by hand-made scenes, the contact memory."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.geometry.boxes import corners, overlap, time_to_overlap
from drivax.simulator.contact import (
    CollisionType,
    Contact,
    first_contacts,
    judge_contacts,
    next_contacts,
    time_to_collision,
)
from drivax.simulator.types import Frame


def box(x, y, heading=0.0, length=4.8, width=2.0):
    return [x, y, np.cos(heading), np.sin(heading), length, width]


def frame(rows, velocities, kinds=None):
    n = len(rows)
    return Frame(
        box=jnp.array(rows, jnp.float32),
        velocity=jnp.array(velocities, jnp.float32),
        z=jnp.zeros(n),
        valid=jnp.ones(n, bool),
        kind=jnp.array(kinds or [1] * n, jnp.int32),
    )


def polygons_meet(a, b):
    """Separating axis test on corner lists in float64; an oracle that shares no code with the package."""
    for poly in (a, b):
        for i in range(4):
            edge = poly[(i + 1) % 4] - poly[i]
            axis = np.array([-edge[1], edge[0]])
            pa, pb = a @ axis, b @ axis
            if pa.max() <= pb.min() or pb.max() <= pa.min():
                return False
    return True


def rectangle(x, y, heading, length, width):
    c, s = np.cos(heading), np.sin(heading)
    local = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * [length / 2, width / 2]
    return local @ np.array([[c, s], [-s, c]]) + [x, y]


def test_corners_and_overlap_agree_with_polygons():
    rng = np.random.default_rng(0)
    meets = 0
    for _ in range(400):
        pose = rng.uniform([-4, -4, -3, 1, 1], [4, 4, 3, 6, 3], (2, 5))
        rows = np.array([box(*p) for p in pose])
        polys = [rectangle(*p) for p in pose]
        np.testing.assert_allclose(corners(rows[0]), polys[0], atol=1e-9)
        expected = polygons_meet(*polys)
        meets += expected
        assert bool(overlap(rows[0], rows[1])) == expected
    assert 50 < meets < 350


def test_touching_is_not_overlap():
    assert not overlap(np.array(box(0, 0)), np.array(box(4.8, 0)))
    assert overlap(np.array(box(0, 0)), np.array(box(4.799, 0)))


def test_time_to_overlap_equals_a_fine_simulation():
    rng = np.random.default_rng(1)
    finite = 0
    for _ in range(150):
        pose = rng.uniform([-15, -15, -3, 1, 1], [15, 15, 3, 6, 3], (2, 5))
        velocity = rng.uniform(-12, 12, (2, 2))
        rows = np.array([box(*p) for p in pose])
        found = float(time_to_overlap(rows[0], velocity[0], rows[1], velocity[1], 5.0))
        expected = 5.0
        for t in np.arange(0, 5, 0.002):
            a, b = (rectangle(*np.add(p, [*(v * t), 0, 0, 0])) for p, v in zip(pose, velocity, strict=True))
            if polygons_meet(a, b):
                expected = t
                break
        finite += expected < 5
        # A corner may be grazed between two samples of the simulation.
        assert found == pytest.approx(expected, abs=0.0021) or (
            found < 5 and expected == 5.0 and _grazes(rows, velocity)
        )
    assert finite > 20


def _grazes(rows, velocity):
    shrunk = rows.copy()
    shrunk[:, 4:] *= 0.995
    return float(time_to_overlap(shrunk[0], velocity[0], shrunk[1], velocity[1], 5.0)) == 5.0


def test_head_on_pair():
    world = frame([box(0, 0), box(20, 0, np.pi, 4.5)], [[5, 0], [-5, 0]])
    assert float(time_to_collision(world, jnp.array(0), jnp.zeros(2, bool))) == pytest.approx(1.535, abs=1e-4)


def test_a_crosser_far_to_the_side_counts_and_a_follower_does_not():
    # A car from 60 deg to the left that meets ego after two seconds.
    crossing = frame([box(0, 0), box(10, 17.3, -np.pi / 2)], [[5, 0], [0, -8.65]])
    assert float(time_to_collision(crossing, jnp.array(0), jnp.zeros(2, bool))) < 2.0
    follower = frame([box(0, 0), box(-10, 0)], [[5, 0], [15, 0]])
    assert float(time_to_collision(follower, jnp.array(0), jnp.zeros(2, bool))) == 5.0


def test_ignored_agents_do_not_count_for_ttc():
    world = frame([box(0, 0), box(10, 0)], [[5, 0], [0, 0]])
    ttc = time_to_collision(world, jnp.array(0), jnp.array([False, True]))
    assert float(ttc) == 5.0


@pytest.mark.parametrize(
    ("other", "ego_speed", "other_speed", "unlawful", "fault", "kind"),
    [
        (box(4.5, 0), 5.0, 0.0, False, True, CollisionType.STOPPED_OBJECT),  # into a stopped car
        (box(-4.5, 0), 0.0, 0.0, False, False, CollisionType.REAR_ENDED),  # both stand, the other behind
        (box(-4.5, 0), 0.0, 6.0, False, False, CollisionType.REAR_ENDED),  # rear-ended while standing
        (box(-4.5, 0), 5.0, 9.0, False, False, CollisionType.REAR_ENDED),  # rear-ended while moving
        (box(4.5, 0), 9.0, 5.0, False, True, CollisionType.REAR_END),  # into a slower car
        (box(-0.5, 1.9), 5.0, 5.0, False, False, CollisionType.SIDE_SWIPE),  # swiped inside the own lane
        (box(-0.5, 1.9), 5.0, 5.0, True, True, CollisionType.SIDE_SWIPE),  # swiped while leaving it
        (box(4.5, 0.3, np.pi), 5.0, 5.0, False, True, CollisionType.HEAD_ON),
    ],
)
def test_fault_by_the_order_of_nuplan(other, ego_speed, other_speed, unlawful, fault, kind):
    world = frame([box(0, 0), other], [[ego_speed, 0], [other_speed, 0]])
    speeds = jnp.array([ego_speed, other_speed])
    found, found_kind = judge_contacts(
        world, jnp.array(0), jnp.array([False, True]), jnp.array(ego_speed), speeds, jnp.array(unlawful)
    )
    assert (bool(found[1]), CollisionType(int(found_kind))) == (fault, kind)
    assert not bool(found[0])


def test_a_pedestrian_who_walks_into_a_stopped_car_is_not_its_fault():
    world = frame([box(0, 0), box(2.5, 0, 0, 0.6, 0.6)], [[0, 0], [-1.5, 0]], [1, 2])
    found, kind = judge_contacts(
        world, jnp.array(0), jnp.array([False, True]), jnp.array(0.0), jnp.array([0.0, 1.5]), jnp.array(False)
    )
    assert not bool(found.any())
    assert CollisionType(int(kind)) == CollisionType.VULNERABLE


def test_contact_memory():
    c = Contact
    rows = [  # before, touching, valid, fault -> after
        (c.ABSENT, True, True, False, c.IGNORED),
        (c.ABSENT, False, True, False, c.APART),
        (c.APART, True, True, True, c.AT_FAULT),
        (c.APART, True, True, False, c.HIT),
        (c.AT_FAULT, True, True, False, c.AT_FAULT),
        (c.HIT, True, True, False, c.HIT),
        (c.HIT, False, True, False, c.PARTED),
        (c.PARTED, True, True, True, c.HIT),  # fault was decided at the first contact
        (c.PARTED, False, True, False, c.PARTED),
        (c.IGNORED, True, True, True, c.IGNORED),
        (c.IGNORED, False, True, False, c.APART),
        (c.AT_FAULT, True, False, False, c.ABSENT),
    ]
    before, touching, valid, fault, expected = (np.array(column) for column in zip(*rows, strict=True))
    before = jnp.asarray(before, jnp.int8)
    after = next_contacts(before, jnp.asarray(touching), jnp.asarray(valid), jnp.asarray(fault))
    np.testing.assert_array_equal(np.asarray(after), expected)
    first = first_contacts(before, jnp.asarray(touching))
    np.testing.assert_array_equal(np.asarray(first), (np.array(before) == c.APART) & touching)


def test_gradient_of_time_to_overlap_is_finite():
    a, b = jnp.array(box(0, 0), jnp.float32), jnp.array(box(20, 0), jnp.float32)
    gradient = jax.grad(lambda v: time_to_overlap(a, v, b, jnp.zeros(2), 5.0))(jnp.array([8.0, 0.0]))
    # d/dv of (15.2 / v)
    np.testing.assert_allclose(gradient[0], -15.2 / 64, rtol=1e-4)
