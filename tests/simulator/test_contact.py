"""Contacts: time to collision against a fine simulation, fault by hand-made scenes, the contact memory."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from shapely.geometry import Polygon

from drivax.geometry.boxes import corners, gap, overlap, time_to_overlap
from drivax.simulator.contact import (
    CollisionType,
    Contact,
    classify_contacts,
    first_contacts,
    nearest_gap,
    next_contacts,
    time_to_collision,
)
from drivax.simulator.types import Frame
from metric_oracle import marched_ttc


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
        lights=jnp.zeros(0, jnp.int32),
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


def random_pairs(count, seed):
    """Poses ``[count, 2, 5]`` and velocities ``[count, 2, 2]``; every other pair is on a course that nearly meets."""
    rng = np.random.default_rng(seed)
    poses = rng.uniform([-30, -30, -np.pi, 0.5, 0.5], [30, 30, np.pi, 12, 3], (count, 2, 5))
    velocities = rng.uniform(-15, 15, (count, 2, 2))
    towards = (poses[:, 0, :2] - poses[:, 1, :2]) / rng.uniform(0.5, 6, (count, 1))
    aimed = velocities[:, 0] + towards + rng.normal(0, 1, (count, 2))
    velocities[::2, 1] = aimed[::2]
    return poses, velocities


def compare_with_simulation(count, seed):
    """Compare the closed form in float32 with the first millisecond at which boxes overlap.

    Return the number of pairs that meet within 5 s.
    """
    poses, velocities = random_pairs(count, seed)
    poses, velocities = (part.astype(np.float32).astype(np.float64) for part in (poses, velocities))
    rows = np.concatenate(
        [poses[..., :2], np.cos(poses[..., 2:3]), np.sin(poses[..., 2:3]), poses[..., 3:]], -1
    )

    @jax.jit
    def closed(rows, velocities):
        return time_to_overlap(rows[:, 0], velocities[:, 0], rows[:, 1], velocities[:, 1], 5.0)

    found = np.asarray(closed(jnp.asarray(rows, jnp.float32), jnp.asarray(velocities, jnp.float32)))
    marched = np.array(
        [marched_ttc(p[0], v[0], p[1:], v[1:])[0] for p, v in zip(poses, velocities, strict=True)]
    )
    differs = np.abs(found - marched) > 2e-3
    # A corner may graze the other box for less than a millisecond, between two steps of the simulation. Boxes that are
    # smaller by the distance that they move in a step do not meet then.
    speed = np.hypot(*(velocities[:, 0] - velocities[:, 1]).T)
    smaller = rows.copy()
    smaller[..., 4:] = np.maximum(smaller[..., 4:] - 2e-3 * speed[:, None, None] - 1e-3, 0.01)
    grazes = time_to_overlap(smaller[:, 0], velocities[:, 0], smaller[:, 1], velocities[:, 1], 5.0) == 5.0
    assert (differs <= grazes).all(), np.flatnonzero(differs & ~grazes)
    assert differs.sum() <= 5e-3 * count
    return int((marched < 5.0).sum())


def test_time_to_overlap_equals_a_simulation_in_steps_of_1_ms():
    assert compare_with_simulation(600, 1) > 150


@pytest.mark.slow
def test_time_to_overlap_of_ten_thousand_pairs():
    assert compare_with_simulation(10_000, 2) > 2500


def test_head_on_pair():
    world = frame([box(0, 0), box(20, 0, np.pi, 4.5)], [[5, 0], [-5, 0]])
    assert float(time_to_collision(world, jnp.array(0), jnp.zeros(2, bool))) == pytest.approx(1.535, abs=1e-4)


def test_crossing_agent_counts_for_ttc_and_follower_does_not():
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
        (box(2.9, 0.0, np.pi / 2), 5.0, 5.0, False, True, CollisionType.SIDE_SWIPE),  # into crossing traffic
        (box(0.0, 2.9, -np.pi / 2), 5.0, 5.0, False, False, CollisionType.SIDE_SWIPE),  # hit by it
        (box(-2.9, 0.3, np.pi / 2), 5.0, 5.0, True, False, CollisionType.REAR_ENDED),  # hit by it from behind
        (box(4.4, 0.0, 0.7), 9.0, 5.0, False, True, CollisionType.REAR_END),  # 40 deg
        (box(4.2, 0.0, 0.9), 9.0, 5.0, False, True, CollisionType.SIDE_SWIPE),  # 52 deg
        (box(-0.5, 1.9), 5.0, 0.04, False, True, CollisionType.SIDE_SWIPE),  # along a car that stands
    ],
)
def test_fault_follows_the_order_of_nuplan(other, ego_speed, other_speed, unlawful, fault, kind):
    world = frame([box(0, 0), other], [[ego_speed, 0], [other_speed, 0]])
    speeds = jnp.array([ego_speed, other_speed])
    found, found_kind = classify_contacts(
        world, jnp.array(0), jnp.array([False, True]), jnp.array(ego_speed), speeds, jnp.array(unlawful)
    )
    assert (bool(found[1]), CollisionType(int(found_kind))) == (fault, kind)
    assert not bool(found[0])


def test_a_pedestrian_who_walks_into_a_stopped_car_is_not_its_fault():
    world = frame([box(0, 0), box(2.5, 0, 0, 0.6, 0.6)], [[0, 0], [-1.5, 0]], [1, 2])
    found, kind = classify_contacts(
        world, jnp.array(0), jnp.array([False, True]), jnp.array(0.0), jnp.array([0.0, 1.5]), jnp.array(False)
    )
    assert not bool(found.any())
    assert CollisionType(int(kind)) == CollisionType.VULNERABLE


def test_contact_codes_follow_the_transition_table():
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
        (c.APART, False, False, False, c.ABSENT),
        (c.AT_FAULT, True, False, False, c.GONE),
        (c.GONE, False, False, False, c.GONE),
        (c.GONE, False, True, False, c.PARTED),  # its fault stays decided
        (c.GONE, True, True, True, c.RETURNED),
        (c.RETURNED, True, True, True, c.RETURNED),
        (c.RETURNED, False, True, False, c.PARTED),  # also after it was ignored
        (c.RETURNED, False, False, False, c.GONE),
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


def test_gaps_agree_with_polygons():
    rng = np.random.default_rng(4)
    pose = rng.uniform([-8, -8, -3, 1, 1], [8, 8, 3, 6, 3], (400, 2, 5))
    rows = np.array([[box(*p) for p in pair] for pair in pose])
    expected = [Polygon(rectangle(*a)).distance(Polygon(rectangle(*b))) for a, b in pose]
    assert min(expected) == 0.0 and max(expected) > 10.0
    np.testing.assert_allclose(gap(rows[:, 0], rows[:, 1]), expected, atol=1e-9)
    np.testing.assert_allclose(gap(rows[:, 1], rows[:, 0]), expected, atol=1e-9)
    cross = np.array(box(0, 0, 0, 10, 1)), np.array(box(0, 0, np.pi / 2, 10, 1))  # no corner in the other
    assert gap(*cross) == 0.0
    fixed = jnp.array(box(0, 0))
    slope = jax.jit(jax.vmap(jax.grad(lambda x: gap(fixed, fixed.at[0].set(x)))))
    slopes = slope(jnp.array([0.0, 4.8, 5.8, -6.0]))
    np.testing.assert_allclose(slopes, [0.0, 0.0, 1.0, -1.0], atol=1e-6)


def test_nearest_gap_skips_ignored_agents():
    rows = [box(0, 0), box(8.8, 0), box(0, 3.5), box(-5.8, 0), box(0, -60)]
    now = frame(rows, [[0, 0]] * 5)
    none, nearest = jnp.zeros(5, bool), jax.jit(nearest_gap)
    assert float(nearest(now, jnp.asarray(0), none)) == pytest.approx(1.0)
    assert float(nearest(now, jnp.asarray(0), none.at[3].set(True))) == pytest.approx(1.5)
    # The car ahead is 4 m from ego. Another level, and empty slots, do not count.
    assert float(nearest(now, jnp.asarray(1), none)) == pytest.approx(4.0)
    above = replace(now, z=now.z.at[3].set(4.0))
    assert float(nearest(above, jnp.asarray(0), none)) == pytest.approx(1.5)
    gone = replace(now, valid=now.valid.at[1:4].set(False), box=now.box.at[1].set(jnp.nan))
    assert float(nearest(gone, jnp.asarray(0), none)) == 50.0
