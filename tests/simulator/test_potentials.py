"""Potentials against the metrics of the same name, a separating-axis oracle in float64, and finite differences."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.errors import UsageError
from drivax.geometry.boxes import corners, overlap
from drivax.scenario.bank.queries import OFFROAD_TOLERANCE_M, around_lanes, offroad_distance
from drivax.simulator.potentials import collision_potential, offroad_potential, separation
from drivax.simulator.types import Frame
from scenes import bank_of, car, straight_road

MARGIN_M = 0.5


def boxes(rng, count, spread=8.0):
    heading = rng.uniform(-np.pi, np.pi, count)
    # A third is parallel or at a right angle, where axes coincide.
    heading[::3] = rng.integers(-2, 3, len(heading[::3])) * np.pi / 2
    return np.stack(
        [rng.uniform(-spread, spread, count), rng.uniform(-spread, spread, count), np.cos(heading),
         np.sin(heading), rng.uniform(0.5, 12.0, count), rng.uniform(0.5, 2.6, count)], -1,
    )  # fmt: skip


def gap(a, b):
    """Largest separation over the four axes, from corner projections in float64."""
    best = -np.inf
    for box in (a, b):
        for axis in ((box[2], box[3]), (-box[3], box[2])):
            one, other = (corners(c) @ np.array(axis) for c in (a, b))
            best = max(best, one.min() - other.max(), other.min() - one.max())
    return best


def frame_of_boxes(rows, z=0.0):
    rows = jnp.asarray(rows, jnp.float32)
    count = len(rows)
    return Frame(
        box=rows,
        velocity=jnp.zeros((count, 2)),
        z=jnp.zeros(count).at[1:].set(z),
        valid=jnp.ones(count, bool),
        kind=jnp.ones(count, jnp.int32),
        lights=jnp.zeros(0, jnp.int32),
    )


@pytest.fixture(scope="module")
def road():
    """A road from y = -1.85 to y = 5.55."""
    return bank_of(straight_road([car(0, 0, 0, 5)]))


@jax.jit
def offroad(bank, poses):
    """Potential and gradient of poses, and how far the worst corner is beyond the edge."""

    def beyond(pose):
        box = posed(pose)
        points = corners(box)
        near = around_lanes(bank, jnp.int32(0), box[:2], box[2:4], points, jnp.zeros(())).points_near
        return offroad_distance(bank, jnp.int32(0), box[:2], points, near, jnp.zeros(())).max()

    def potential(pose):
        return offroad_potential(bank, jnp.int32(0), posed(pose), jnp.zeros(()), MARGIN_M)

    value, slope = jax.vmap(jax.value_and_grad(potential))(poses)
    return value, slope, jax.vmap(beyond)(poses)


collision = jax.jit(lambda frame: collision_potential(frame, jnp.int32(0), MARGIN_M))


def posed(pose):
    x, y, heading = pose
    return jnp.stack([x, y, jnp.cos(heading), jnp.sin(heading), jnp.full((), 4.8), jnp.full((), 2.0)])


def test_separation_bounds_the_separating_axes_from_above():
    rng = np.random.default_rng(0)
    rows = boxes(rng, 400)
    found = np.asarray(separation(jnp.asarray(rows[0]), jnp.asarray(rows)))[1:]
    exact = np.array([gap(rows[0], row) for row in rows[1:]])
    halves = (rows[0, 4:].sum() + rows[1:, 4:].sum(axis=1)) / 2
    assert (found >= exact - 1e-4).all()
    assert (found <= exact + 0.063 + 0.01 * halves + 1e-4).all()


def test_collision_is_positive_on_overlap_and_zero_beyond_the_margin():
    rng = np.random.default_rng(1)
    rows = boxes(rng, 600, spread=6.0)
    value = np.asarray(collision(frame_of_boxes(rows)))
    hit = np.asarray(overlap(rows[0], rows))
    exact = np.array([gap(rows[0], row) for row in rows])
    others = np.arange(len(rows)) > 0
    assert (hit & others).sum() > 50 and (value[hit & others] > 0).all()
    far = others & (exact > MARGIN_M)
    assert far.sum() > 50 and (value[far] == 0.0).all()
    assert value[0] == 0.0, "an agent does not collide with itself"
    # Nose to tail, 0.25 m apart: half a margin. Blended: two of the axes agree (0.03 ln 2), and half a length counts
    # for 1 % less.
    rows[:2] = [[0, 0, 1, 0, 4.8, 2.0], [5.05, 0, 1, 0, 4.8, 2.0]]
    touching = float(collision(frame_of_boxes(rows))[1])
    apart = 0.25 + 0.03 * np.log(2) + 2.4 * (1.01 - np.sqrt(1 + 1e-4))
    assert touching == pytest.approx((1 - apart / MARGIN_M) ** 2, abs=1e-4)


def test_absent_agents_and_other_levels_have_no_potential_and_no_gradient():
    rows = np.array([[0, 0, 1, 0, 4.8, 2.0], [1, 0.3, 0, 1, 4.8, 2.0]])
    present = frame_of_boxes(rows)
    absent = replace(present, valid=jnp.array([True, False]))

    def total(pose, frame):
        frame = replace(frame, box=frame.box.at[0].set(posed(pose)))
        return collision_potential(frame, jnp.int32(0)).sum()

    sloped = jax.jit(jax.value_and_grad(total))
    for frame, empty in ((present, False), (absent, True), (frame_of_boxes(rows, 6.0), True)):
        value, slope = sloped(jnp.zeros(3), frame)
        assert (float(value) == 0.0) is empty and np.isfinite(slope).all()
        assert (np.asarray(slope) == 0.0).all() == empty


def test_collision_gradient_equals_the_finite_difference():
    with jax.enable_x64(True):
        other = jnp.asarray(boxes(np.random.default_rng(4), 40, spread=4.0))

        @jax.jit
        def total(pose):
            return (jnp.maximum(1 - separation(posed(pose), other) / MARGIN_M, 0.0) ** 2).sum()

        slope, step = jax.jit(jax.grad(total)), 1e-5
        for pose in np.array([[0.2, -0.3, 0.0], [1.0, 0.5, np.pi / 2], [0.0, 0.0, -2.4], [-1.0, 0.0, 0.4]]):
            moved = [(total(pose + step * e) - total(pose - step * e)) / (2 * step) for e in np.eye(3)]
            np.testing.assert_allclose(slope(pose), np.asarray(moved), rtol=1e-5, atol=1e-6)


def test_offroad_is_positive_off_the_road_and_zero_beyond_the_margin(road):
    rng = np.random.default_rng(2)
    poses = np.stack(
        [rng.uniform(-60, 60, 400), rng.uniform(-4, 8, 400), rng.uniform(-np.pi, np.pi, 400)], -1
    )
    # Both right corners of a car at y = -0.9 are at -1.9, 0.05 m beyond the edge: 0.25 m before the tolerance.
    poses[0] = [5.0, -0.9, 0.0]
    value, _, worst = map(np.asarray, offroad(road, jnp.asarray(poses, jnp.float32)))
    off, safe = worst > OFFROAD_TOLERANCE_M, worst <= OFFROAD_TOLERANCE_M - MARGIN_M
    assert off.sum() > 50 and safe.sum() > 50
    assert (value[off] > 0).all() and (value[safe] == 0.0).all()
    assert value[0] == pytest.approx(2 * (1 - 0.25 / MARGIN_M) ** 2, abs=1e-3)


def test_offroad_gradient_equals_the_finite_difference(road):
    rng, step = np.random.default_rng(3), 2e-3
    poses = np.stack([rng.uniform(-60, 60, 400), rng.uniform(-1.6, 5.3, 400), rng.uniform(-1, 1, 400)], -1)
    _, gradients, _ = map(np.asarray, offroad(road, jnp.asarray(poses, jnp.float32)))
    assert np.isfinite(gradients).all() and (np.abs(gradients).max(axis=1) > 0.1).sum() > 50
    for place, axis in enumerate(np.eye(3)):
        after, before = (
            np.asarray(offroad(road, jnp.asarray(poses + sign * step * axis, jnp.float32))[0])
            for sign in (1, -1)
        )
        # A corner that passes the margin within the step bends the potential; float32 adds its own.
        np.testing.assert_allclose(
            gradients[:, place], (after - before) / (2 * step), rtol=0.02, atol=0.1, err_msg=str(place)
        )


def test_without_a_map_nothing_is_off_the_road():
    bank = bank_of(replace(straight_road([car(0, 0, 0, 5)]), features=(), route_lanes=()))
    value, slope, _ = offroad(bank, jnp.full((400, 3), -9.0))
    assert not np.asarray(value).any() and not np.asarray(slope).any()


def test_margins_out_of_bounds_are_refused(road):
    with pytest.raises(UsageError, match=r"margin_m is 3\.5"):
        offroad_potential(road, jnp.int32(0), jnp.zeros(6), jnp.zeros(()), margin_m=3.5)
    with pytest.raises(UsageError, match="margin_m is 0; use more than 0"):
        offroad_potential(road, jnp.int32(0), jnp.zeros(6), jnp.zeros(()), margin_m=0.0)
    with pytest.raises(UsageError, match=r"margin_m is 0\.2; use at least 0\.3"):
        collision_potential(frame_of_boxes(np.zeros((1, 6))), jnp.int32(0), margin_m=0.2)
