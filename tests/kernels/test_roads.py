"""Native queries of lanes and edges equal those of XLA, on generated worlds and on random maps.

Booleans are equal and floats within 1e-5 (absolute, or relative if larger). Where a comparison sits on a threshold,
rounding decides: such differences count only if XLA in double precision, with inputs that vary by 1e-5 m, returns only
one of both values.
"""

from dataclasses import fields, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax import kernels
from drivax.geometry.boxes import corners
from drivax.planners.pdm.scoring import ground_along
from drivax.scenario.bank.columns import AgentColumn, LaneRow
from drivax.scenario.bank.queries import LaneHits, around_lanes, offroad_distance
from drivax.scenario.bank.scenario_bank import PER_EGO, ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.scenario.build.grid import SPLIT, Grid
from drivax.synthetic.world import generate_recording
from kernels.compare import TARGETS, needs_kernels, run_on_target
from scenes import bank_of, car, straight_road

pytestmark = needs_kernels

CELL_M, SEGMENT_M, TOLERANCE = 10.0, 4.0, 1e-5
#: Values that rows outside of all runs may hold.
GARBAGE = (np.nan, np.inf, -np.inf, 0.0, 1e38)


class Maps(NamedTuple):
    """Shape of random maps: cells along the grid, segments of a kind, longest run, egos, and length of vehicles."""

    side: int
    segments: int
    run: int
    egos: int = 1
    length_m: float = 4.8


#: A grid, a single cell with a number of rows that fits no vector, and long vehicles of several egos.
SHAPES = [Maps(5, 90, 40), Maps(1, 37, 37, egos=3), Maps(6, 130, 16, egos=2, length_m=19.0)]


class Poses(NamedTuple):
    """Arguments of the queries, with axes of maps and of poses."""

    index: jax.Array
    row: jax.Array
    centre: jax.Array
    heading: jax.Array
    corners: jax.Array
    ground: jax.Array
    routed: jax.Array
    near_lane: jax.Array


class Found(NamedTuple):
    lanes: LaneHits
    offroad_m: jax.Array


def query(bank, pose):
    """Both queries at one pose."""
    box = pose.centre, pose.heading, pose.corners, pose.ground
    lanes = around_lanes(bank, pose.index, *box, pose.routed, pose.row)
    edges = (pose.centre, pose.corners, pose.near_lane, pose.ground)
    return Found(lanes, offroad_distance(bank, pose.index, *edges))


def look_up(bank, poses):
    axes = partial(jax.vmap, in_axes=(None, 0))
    return jax.device_get(jax.jit(axes(axes(query)))(bank, poses))


def native(bank, poses):
    assert kernels.in_use()
    return look_up(bank, poses)


def by_xla(bank, poses):
    with kernels.without_kernels():
        return look_up(bank, poses)


# Random maps -----------------------------------------------------------------------------------------------------


def random_lines(rng, count, width_m):
    """Both ends of segments: streets of several segments that share vertices, and single ones."""
    ends = np.empty((0, 4))
    while len(ends) < count:
        steps, heading = int(rng.integers(1, 12)), rng.uniform(-np.pi, np.pi)
        headings = heading + np.cumsum(rng.normal(0.0, rng.choice([0.0, 0.1, 1.0]), steps))
        length = rng.choice([0.0, 1.0, SEGMENT_M * 0.999]) * rng.uniform(0.5, 1.0)
        moves = length * np.stack([np.cos(headings), np.sin(headings)], axis=1)
        points = rng.uniform(0.0, width_m, 2) + np.concatenate([np.zeros((1, 2)), np.cumsum(moves, axis=0)])
        street = np.concatenate([points[:-1], points[1:]], axis=1)
        inside = ((street[:, :2] + street[:, 2:]) / 2 > 0).all(1) & (
            (street[:, :2] + street[:, 2:]) / 2 < width_m
        ).all(1)
        ends = np.concatenate([ends, street[inside]])
    return ends[:count]


def random_segments(rng, maps, grid, features):
    """One map: segments sorted by cell, `features` behind their ends, and the starts of cells."""
    count = int(rng.choice([0, 1, 2, maps.segments // 2, maps.segments]))
    ends = grid.origin[[0, 1, 0, 1]] + random_lines(rng, count, maps.side * CELL_M)
    rows = np.concatenate([ends, features(count)], axis=1).astype(np.float32)
    middle = (rows[:, :2].astype(np.float64) + rows[:, 2:4]) / 2
    keep = grid.contains(middle)
    rows, cell = rows[keep], grid.cell(middle[keep])
    drop = grid.excess_entries(cell, rng.random(len(rows)), maps.run) if maps.side > 2 else []
    rows, cell = np.delete(rows, drop, axis=0), np.delete(cell, drop)
    order = np.argsort(cell, kind="stable")
    return rows[order], grid.starts(cell[order], 0)


def random_bank(maps, count, rng):
    """Random maps, twice: unused rows far away, as in real banks, and with garbage in them."""
    features = {
        "edges": lambda n: rng.choice([0.0, 0.0, 2.5, 7.0], (n, 1)),
        "lanes": lambda n: np.stack(
            [
                rng.choice([0.0, 0.0, 2.5, 7.0], n),
                rng.uniform(0.5, 3.0, n),
                rng.choice([-1.0, 4.0, 13.4, 29.1], n),
                rng.integers(0, 99, n) + rng.integers(0, 2**maps.egos, n) / 2**maps.egos,
            ],
            axis=1,
        ),
    }
    arrays = {"grid_origin": np.round(rng.uniform(-200, 200, (count, 2)), 2).astype(np.float32)}
    boxes = np.tile(np.array([np.inf, np.inf, -np.inf, -np.inf]), (count, 1))
    for kind, size in (("edges", 5), ("lanes", 8)):
        arrays[kind] = np.full((count, size, maps.segments + maps.run), 1e6, np.float32)
        arrays[f"grid_{kind[:-1]}"] = np.zeros((count, maps.side**2 + 1), np.int16)
        for number in range(count):
            grid = Grid(arrays["grid_origin"][number].astype(np.float64), CELL_M, maps.side)
            rows, start = random_segments(rng, maps, grid, features[kind])
            arrays[kind][number, :, : len(rows)] = rows.T
            arrays[f"grid_{kind[:-1]}"][number] = start
            for ends in (rows[:, :2], rows[:, 2:4]) if len(rows) else ():
                boxes[number, :2] = np.minimum(boxes[number, :2], ends.min(0))
                boxes[number, 2:] = np.maximum(boxes[number, 2:], ends.max(0))
    arrays["map_box"] = np.where(np.isfinite(boxes), boxes, 0.0).astype(np.float32)
    sides = rng.integers(0, 3, (count, maps.side**2, SPLIT**2))
    arrays["grid_side"] = (sides << np.arange(0, 2 * SPLIT**2, 2)).sum(-1).astype(np.int32)
    bank = base_bank().part(jnp.zeros(count, jnp.int32))
    per_ego = {name: jnp.repeat(getattr(bank, name), maps.egos, axis=0) for name in PER_EGO}
    constants = {
        "cell_m": CELL_M, "edge_run": maps.run, "lane_run": maps.run, "long_ego": maps.length_m > 8.0,
    }  # fmt: skip
    egos = jnp.zeros((count, maps.egos), bank.egos.dtype)

    def complete(arrays):
        return replace(bank, **per_ego, egos=egos, **constants, **jax.tree.map(jnp.asarray, arrays))

    dirty = arrays | {kind: arrays[kind].copy() for kind in ("edges", "lanes")}
    for kind in ("edges", "lanes"):
        unused = np.arange(maps.segments + maps.run) >= arrays[f"grid_{kind[:-1]}"][:, -1:]
        garbage = rng.choice(np.array(GARBAGE, np.float32), dirty[kind].shape)
        dirty[kind] = np.where(unused[:, None], garbage, dirty[kind])
    return complete(arrays), complete(dirty)


def base_bank():
    return bank_of(straight_road([car(0, 0, 0, 5)]))


def poses_near(bank, count, rng, length_m=4.8):
    """Poses near the segments of each map, most of them along a lane, some beyond the map."""
    maps, egos = len(bank), bank.most_egos
    lanes, ends = np.asarray(bank.lanes, np.float64), np.asarray(bank.grid_lane)[:, -1].astype(int)
    pick = (rng.random((maps, count)) * np.maximum(ends, 1)[:, None]).astype(int)
    start = lanes[np.arange(maps)[:, None], :, pick]
    known = (ends > 0)[:, None] & (rng.random((maps, count)) < 0.9)
    middle = np.asarray(bank.grid_origin, np.float64)[:, None] + rng.uniform(-9, 60, (maps, count, 2))
    xy = np.where(known[..., None], start[..., :2], middle)
    xy += rng.normal(size=xy.shape) * rng.choice([0.3, 0.8, 2.0, 8.0], (maps, count, 1))
    along = np.arctan2(start[..., 3] - start[..., 1], start[..., 2] - start[..., 0])
    turn = rng.choice([0.0, 0.3, 3.0], (maps, count)) * rng.normal(size=(maps, count))
    heading = along + turn + rng.choice([0.0, np.pi], (maps, count), p=[0.8, 0.2])
    size = np.broadcast_to([length_m, 2.0], (maps, count, 2))
    direction = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    box = jnp.asarray(np.concatenate([xy, direction, size], axis=-1), jnp.float32)
    index = np.broadcast_to(np.arange(maps, dtype=np.int32)[:, None], (maps, count))
    ground = rng.choice([0.0, 0.3, 2.5, 7.0], (maps, count), p=[0.7, 0.1, 0.1, 0.1])
    ground = ground + np.where(known & (rng.random((maps, count)) < 0.8), start[..., LaneRow.Z], 0.0)
    return Poses(
        index=jnp.asarray(index),
        row=jnp.asarray(index * egos + rng.integers(0, egos, (maps, count)), jnp.int32),
        centre=box[..., :2],
        heading=box[..., 2:4],
        corners=jax.vmap(jax.vmap(corners))(box),
        ground=jnp.asarray(ground, jnp.float32),
        routed=jnp.asarray(rng.random((maps, count)) < 0.7),
        near_lane=jnp.asarray(rng.random((maps, count, 4)) < 0.5),
    )


# Comparison ------------------------------------------------------------------------------------------------------


def values(found):
    """All results by name, with an axis of maps and one of poses."""
    return {field.name: getattr(found.lanes, field.name) for field in fields(LaneHits)} | {
        "offroad_m": found.offroad_m
    }


def differs(actual, expected):
    """Mask of the poses at which a result differs."""
    if actual.dtype == bool:
        mask = actual != expected
    else:
        mask = ~(np.abs(actual - expected) <= TOLERANCE * np.maximum(np.abs(expected), 1.0))
    return mask.reshape(*mask.shape[:2], -1).any(axis=-1)


def vary(pose, rng, count=256):
    """Copies of one pose in double precision that vary by rounding."""
    copies = jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf)[None, None], count, axis=1), pose)
    wide = {name: getattr(copies, name).astype(np.float64) for name in ("centre", "corners", "ground")}
    wide |= {"heading": copies.heading.astype(np.float64)}
    shift = {name: 1e-5 if name != "heading" else 1e-6 for name in wide}
    return copies._replace(**{
        name: value + rng.uniform(-shift[name], shift[name], value.shape) for name, value in wide.items()
    })  # fmt: skip


def compare(actual, expected, bank, poses):
    """Compare all results; return the number of poses where rounding decided."""
    actual, expected = values(actual), values(expected)
    mask = np.any([differs(actual[name], expected[name]) for name in expected], axis=0)
    for place in zip(*np.nonzero(mask), strict=True):
        pose = jax.tree.map(lambda leaf, place=place: np.asarray(leaf)[place], poses)
        with jax.enable_x64(True):
            wide = jax.tree.map(lambda v: v.astype(jnp.float64) if v.dtype == jnp.float32 else v, bank)
            varied = values(by_xla(wide, vary(pose, np.random.default_rng(0))))
        for name in expected:
            for value in (actual[name][place], expected[name][place]):
                is_possible = ~differs(varied[name], np.broadcast_to(value, varied[name].shape)).all()
                is_possible |= np.array_equal(actual[name][place], expected[name][place])
                assert is_possible, (name, place, value, actual[name][place], expected[name][place])
    return int(mask.sum())


def fuzz(maps, count, poses_per_map, seed):
    """Compare the queries of random maps; return numbers of poses, and of those where rounding decided."""
    rng = np.random.default_rng(seed)
    clean, dirty = random_bank(maps, count, rng)
    poses = poses_near(clean, poses_per_map, rng, maps.length_m)
    expected = by_xla(clean, poses)
    excluded = compare(native(dirty, poses), expected, clean, poses)
    return values(expected), excluded


@pytest.mark.parametrize("maps", SHAPES, ids=str)
def test_queries_of_random_maps_equal_those_of_xla(maps):
    results, excluded = fuzz(maps, 120, 8, 0)
    assert excluded <= 2
    for name in ("near", "points_near", "on_corridor", "wrong_way", "straddling", "leaving_lane"):
        assert 0.002 < results[name].mean() < 0.998, name
    assert len(np.unique(results["limit"])) == 4 and len(np.unique(results["offroad_m"])) > 100


@pytest.mark.slow
@pytest.mark.parametrize("maps", SHAPES, ids=str)
def test_queries_of_many_random_maps_equal_those_of_xla(maps):
    excluded = sum(fuzz(maps, 425, 16, seed)[1] for seed in range(1, 9))
    assert excluded <= 8 * 425 * 16 // 5000


@pytest.fixture(scope="module")
def worlds():
    return ScenarioBank.from_scenarios([assemble(generate_recording(5, index)) for index in range(3)])


def test_queries_of_generated_worlds_equal_those_of_xla(worlds):
    poses = poses_near(worlds, 500, np.random.default_rng(3))
    assert compare(native(worlds, poses), by_xla(worlds, poses), worlds, poses) <= 3


# Batches, derivatives, precision ---------------------------------------------------------------------------------


def test_single_calls_nested_batches_and_batches_of_banks_equal_one_batch(worlds):
    poses = poses_near(worlds, 4, np.random.default_rng(4))
    expected = native(worlds, poses)

    def at(place):
        return jax.tree.map(lambda leaf: leaf[place], poses)

    for place in ((0, 0), (1, 3), (2, 1)):
        single = query(worlds, at(place))
        jax.tree.map(lambda a, b, p=place: np.testing.assert_array_equal(a, b[p]), single, expected)
    banks = jax.tree.map(lambda leaf: leaf[:, None], worlds)
    local = poses._replace(index=jnp.zeros_like(poses.index), row=jnp.zeros_like(poses.row))
    each = jax.jit(jax.vmap(jax.vmap(query, (None, 0))))(banks, local)
    jax.tree.map(np.testing.assert_array_equal, each, expected)
    one = jax.jit(jax.vmap(lambda ground: query(worlds, at((0, 0))._replace(ground=ground))))(poses.ground[0])
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[0], b[0, 0]), one, expected)


def test_derivatives_are_those_of_xla(worlds):
    poses = poses_near(worlds, 40, np.random.default_rng(5))

    def total(shift, bank, poses):
        moved = poses._replace(centre=poses.centre + shift, corners=poses.corners + shift)
        axes = partial(jax.vmap, in_axes=(None, 0))
        found = axes(axes(query))(bank, moved._replace(ground=moved.ground + shift[0]))
        return found.offroad_m.sum() + found.lanes.z.sum() + found.lanes.limit.sum()

    actual = jax.jit(jax.grad(lambda shift: total(shift, worlds, poses)))(jnp.zeros(2))
    with kernels.without_kernels():
        expected = jax.jit(jax.grad(lambda shift: total(shift, worlds, poses)))(jnp.zeros(2))
    assert np.abs(expected).max() > 1.0
    np.testing.assert_allclose(actual, expected, rtol=1e-4)


def test_double_precision_is_left_to_xla(worlds):
    poses = poses_near(worlds, 2, np.random.default_rng(6))
    with jax.enable_x64(True):
        wide = jax.tree.map(lambda v: v.astype(jnp.float64) if v.dtype == jnp.float32 else v, (worlds, poses))
        assert look_up(*wide).offroad_m.dtype == np.float64


@pytest.mark.parametrize("every", [1, 5])
def test_ground_along_proposals_equals_that_of_xla(worlds, every):
    rng, size = np.random.default_rng(7), jnp.asarray([4.8, 2.0])
    start = np.asarray(worlds.agents)[:, 10, 0]
    curvature, speed = rng.normal(0.0, 0.02, (3, 6, 1)), rng.uniform(2.0, 15.0, (3, 6, 1))
    time = np.arange(41) * 0.1
    heading = np.arctan2(start[:, AgentColumn.SIN], start[:, AgentColumn.COS])[:, None, None]
    heading = heading + curvature * speed * time
    steps = 0.1 * speed[..., None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    xy = start[:, None, None, AgentColumn.XY] + np.cumsum(steps, axis=2)
    motion = np.concatenate(
        [xy, heading[..., None], np.broadcast_to(speed[..., None], (3, 6, 41, 1))], axis=-1
    )
    z = np.broadcast_to(start[:, None, None, AgentColumn.Z] - 0.75, (3, 6, 41)).astype(np.float32)
    on_route, needs_lanes = rng.random((3, 6, 41)) < 0.9, rng.random((3, 6, 41)) < 0.1
    arguments = jnp.arange(3), motion.astype(np.float32), z, on_route, needs_lanes

    def along(index, motion, *others):
        return ground_along(worlds, index, motion, size, *others, every)

    actual = jax.device_get(jax.jit(jax.vmap(lambda *each: along(*each)))(*arguments))
    with kernels.without_kernels():
        expected = jax.device_get(jax.jit(jax.vmap(lambda *each: along(*each)))(*arguments))
    assert expected.is_offroad.any() and expected.is_astray.any() and expected.is_in_several_lanes.any()
    np.testing.assert_array_equal(actual.is_offroad, expected.is_offroad)
    np.testing.assert_array_equal(actual.is_astray, expected.is_astray)
    # Steps that need no lanes may count as being in a single lane.
    assert (actual.is_in_several_lanes >= expected.is_in_several_lanes).all()
    if every == 1:
        several = [ground.is_in_several_lanes[needs_lanes] for ground in (actual, expected)]
        np.testing.assert_array_equal(*several)


@pytest.mark.parametrize("target", TARGETS)
def test_older_instruction_sets_pass_the_same_tests(target):
    run_on_target(target, __file__)
