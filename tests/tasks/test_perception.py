"""Perception: lines of sight against shapely; noise, range and drop-out as of a tracker."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.scenario.schema import AgentKind
from drivax.simulator.simulator import Simulator
from drivax.tasks.example_features import car_following, stop_line
from drivax.tasks.features import Features
from drivax.tasks.observations import ObservationConfig, OwnGroup, observe
from drivax.tasks.perception import Perception, detect_lights, in_view
from drivax.tasks.task import Task
from scenes import RED, bank_of, car, straight_road

BOXES = 12
SMALL = ObservationConfig(
    agents=8, steps=2, road=20, lights=1, route=1, features=Features(agents=("position", "length"), route=())
)


def shown(x, y, heading, length, width):
    return np.array([x, y, np.cos(heading), np.sin(heading), length, width], np.float32)


def some_boxes(rng):
    """Boxes around the origin: vehicles and pedestrians."""
    size = rng.choice([(4.8, 2.0), (12.0, 2.6), (0.6, 0.6)], BOXES)
    place, heading = rng.uniform(-25, 25, (BOXES, 2)), rng.uniform(-np.pi, np.pi, BOXES)
    return np.stack([shown(*p, h, *s) for p, h, s in zip(place, heading, size, strict=True)])


def in_view_by_shapely(eye, boxes, blocks, more):
    """Visibility by shapely, with blocking boxes enlarged by ``more`` on each side."""
    from shapely import affinity, geometry

    def polygon(row, more):
        x, y, cos, sin, length, width = map(float, row)
        box = geometry.box(-length / 2 - more, -width / 2 - more, length / 2 + more, width / 2 + more)
        return affinity.affine_transform(box, [cos, -sin, sin, cos, x, y])

    result = []
    for k, row in enumerate(boxes):
        targets = [*polygon(row, 0.0).exterior.coords[:4], tuple(map(float, row[:2]))]
        others = [polygon(other, more) for j, other in enumerate(boxes) if blocks[j] and j != k]
        others = [box for box in others if not box.contains(geometry.Point(eye))]
        rays = [geometry.LineString([eye, target]) for target in targets]
        result.append(any(not any(ray.intersection(box).length > 0 for box in others) for ray in rays))
    return np.array(result)


def test_visibility_agrees_with_shapely():
    pytest.importorskip("shapely")
    rng = np.random.default_rng(3)
    rule = jax.jit(in_view)
    hidden = clear = 0
    for _ in range(60):
        boxes, blocks = some_boxes(rng), rng.random(BOXES) < 0.8
        eye = rng.uniform(-5, 5, 2).astype(np.float32)
        found = np.asarray(rule(eye, boxes, blocks))
        large, small = (
            in_view_by_shapely(tuple(map(float, eye)), boxes, blocks, more) for more in (1e-3, -1e-3)
        )
        certain = large == small
        np.testing.assert_array_equal(found[certain], small[certain])
        hidden, clear = hidden + (~small & certain).sum(), clear + (small & certain).sum()
    assert hidden > 80 and clear > 80, (hidden, clear)


def test_lines_of_sight_by_hand():
    eye, blocks = jnp.zeros(2), jnp.ones(3, bool)
    bus = shown(10, 0, 0, 10.0, 3.0)
    behind = jnp.stack([bus, shown(25, 0, 0, 4.0, 2.0), shown(25, 3.0, 0, 4.0, 2.0)])
    # The shadow of the bus's near side (x = 5, |y| < 1.5) ends at |y| = 0.3 x, at x = 23 at 6.9, beyond all corners of
    # the two cars (|y| at most 4). With its centre at y = 7 the last car shows a corner.
    assert in_view(eye, behind, blocks).tolist() == [True, False, False]
    behind = behind.at[2, 1].set(7.0)
    assert in_view(eye, behind, blocks).tolist() == [True, False, True]
    assert in_view(eye, behind, blocks.at[0].set(False)).tolist() == [True, True, True]
    # A bus around the eye hides no agent.
    assert in_view(jnp.array([8.0, 0.0]), behind, blocks).tolist() == [True, True, True]


@pytest.fixture(scope="module")
def bank():
    cars = [
        car(0, 0, 0, 4), car(15, 0, 0, 4, 12.0, 2.6), car(32, 0.2, 0, 4, 4.0), car(-20, 3.7, 0, 4, 4.2),
        car(-40, 0, 0, 4, 4.4), car(60, 11, 0, 4, 4.6), car(15, 3.7, 0, 4, 0.6, 0.6, AgentKind.PEDESTRIAN),
    ]  # fmt: skip
    return bank_of(straight_road(cars, light=RED))


FIRST = 15
ALL = Perception(dropout_m=40.0, noise_m=0.1, range_m=50.0, occlusion=True)
ERRORS = {
    "none": Perception(),
    "occlusion": Perception(occlusion=True),
    # With this seed the order of the nearest agents stays; they are compared row by row.
    "noise": Perception(noise_m=0.1, seed=1),
    "all": ALL,
}


@pytest.fixture(scope="module")
def obs(bank):
    """Observations at every step from 15 on with each kind of error, by one program; and the contexts."""
    simulators = {
        name: Simulator(Task(observation=replace(SMALL, perception=one))) for name, one in ERRORS.items()
    }

    def look(bank, step):
        context = simulators["none"].context(bank, 0, step)
        return {name: one.observe(bank, context) for name, one in simulators.items()} | {"context": context}

    return jax.device_get(jax.jit(jax.vmap(look, (None, 0)))(bank, jnp.arange(FIRST, 91)))


def lengths(obs, step=0):
    """Lengths of the observed boxes at a step, m."""
    rows, mask = obs["agents"][step, :, -1], obs["agents_mask"][step, :, -1]
    return sorted(np.round(rows[mask, 2].astype(np.float64) * 5, 1).tolist())


def test_agents_behind_a_bus_are_occluded(obs):
    assert lengths(obs["none"]) == [0.6, 4.0, 4.2, 4.4, 4.6, 12.0]
    # The car at 32 m is hidden by the bus ahead of ego; the one at 60 m, far to the left, is seen past it.
    assert lengths(obs["occlusion"]) == [0.6, 4.2, 4.4, 4.6, 12.0]
    for name in ("occlusion", "all"):
        # An agent that is not seen now has no past, and leaves no gap among the nearest.
        mask = obs[name]["agents_mask"]
        assert not (mask.any(axis=2) & ~mask[..., -1]).any()
        assert (np.sort(mask[..., -1], axis=1)[:, ::-1] == mask[..., -1]).all()
    # Of the agents in view, all but that at 61 m are within 50 m, and each is seen at some steps.
    observed = {length for step in range(76) for length in lengths(obs["all"], step)}
    assert observed == {0.6, 4.2, 4.4, 12.0}


def errors(obs, group="agents"):
    """Position errors, m."""
    return (obs["noise"][group][..., :2] - obs["none"][group][..., :2]) * 50


def test_noise_has_its_standard_deviation_and_is_independent(obs):
    truth, noisy = obs["none"], obs["noise"]
    error = errors(obs)[:, :6, -1]
    count = error.size
    assert truth["agents_mask"][:, :6, -1].all() and not truth["agents_mask"][:, 6:].any() and count > 800
    assert abs(error.mean()) < 4 * 0.1 / np.sqrt(count)
    assert abs(error.std() - 0.1) < 4 * 0.1 / np.sqrt(2 * count)
    for axis in range(3):  # steps, agents, directions
        one = np.delete(error, -1, axis=axis).ravel()
        other = np.delete(error, 0, axis=axis).ravel()
        assert abs(np.corrcoef(one, other)[0, 1]) < 4 / np.sqrt(len(one))
    for group in ("road", "lights"):
        mask, error = truth[f"{group}_mask"], errors(obs, group)
        assert error[mask].all() and not error[~mask].any() and abs(error[mask].std() - 0.1) < 0.02
        np.testing.assert_array_equal(noisy[group][..., 2:], truth[group][..., 2:])
    np.testing.assert_array_equal(noisy["ego"], truth["ego"])


def test_past_steps_keep_their_perception(obs):
    """Ego drives straight on at 4 m/s: what it saw a step ago is 0.4 m further behind now."""
    for name in ("noise", "all"):
        rows, mask = obs[name]["agents"], obs[name]["agents_mask"]
        compared = 0
        for step in range(1, len(rows)):
            for row in np.flatnonzero(mask[step, :, -1]):
                same = np.abs(rows[step - 1, :, -1, 2] - rows[step, row, -1, 2]) < 1e-6
                before = np.flatnonzero(same & mask[step - 1, :, -1])
                # Its past step is shown if and only if it was seen then.
                assert len(before) == mask[step, row, -2]
                if len(before):
                    expected = rows[step - 1, before[0], -1, :2] - np.array([0.4 / 50, 0.0])
                    np.testing.assert_allclose(rows[step, row, -2, :2], expected, atol=1e-5)
                    compared += 1
        assert compared > 60


def test_range_and_dropout_by_distance(bank, obs):
    """Lights are seen at a share exp(-distance / 40 m) of the steps, and never beyond the range."""
    context = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), obs["context"])
    distance = jnp.array([1.0, 15.0, 40.0, 90.0])

    def look(perception):
        return jax.vmap(lambda step: detect_lights(perception, bank, replace(context, step=step), distance))(
            jnp.arange(4000)
        )

    one, other, near = (
        np.asarray(look(Perception(**options)))
        for options in ({"dropout_m": 40.0}, {"dropout_m": 40.0, "seed": 1}, {"range_m": 40.0})
    )
    share = np.exp(-np.asarray(distance) / 40.0)
    np.testing.assert_array_less(np.abs(one.mean(axis=0) - share), 4 * np.sqrt(share * (1 - share) / 4000))
    assert abs(np.corrcoef(one[:, 2], other[:, 2])[0, 1]) < 4 / np.sqrt(4000)
    assert near.all(axis=0).tolist() == [True, True, True, False] and not near[:, 3].any()
    # Agents follow the same rule, independently at every step.
    free = np.linalg.norm(obs["occlusion"]["agents"][:, :5, -1, :2] * 50, axis=-1)
    expected = np.where(free <= 50.0, np.exp(-free / 40.0), 0.0)
    found = obs["all"]["agents_mask"][..., -1].sum(axis=1)
    assert abs(found.sum() - expected.sum()) < 4 * np.sqrt((expected * (1 - expected)).sum())
    assert len(np.unique(found)) > 2


def test_unseen_lights_are_hidden_from_custom_groups():
    """A red light 40 m ahead on an empty road: both examples that read lights miss it out of range."""
    bank = bank_of(straight_road([car(0, 0, 0, 4)], light=RED))
    own = (OwnGroup(stop_line), OwnGroup(car_following))
    near, far = (
        Simulator(Task(observation=replace(SMALL, own=own, perception=Perception(range_m=range_m))))
        for range_m in (5.0, 90.0)
    )

    def look(bank):
        return [one.observe(bank, one.context(bank, 0, FIRST)) for one in (near, far)]

    blind, sighted = jax.device_get(jax.jit(look)(bank))
    assert sighted["lights_mask"].any() and sighted["stop_line"][1:].tolist() == [1.0, 1.0]
    assert sighted["car_following"][3] == 1.0 and sighted["car_following"][0] < 1.0
    assert not blind["lights_mask"].any() and blind["stop_line"].tolist() == [1.0, 0.0, 0.0]
    assert blind["car_following"][3] == 0.0 and blind["car_following"][0] > sighted["car_following"][0]


@pytest.mark.slow
def test_replayed_perception_equals_live_perception(bank, obs):
    """A stored context, observed alone in another program, has the observation of the batch."""
    simulator = Simulator(Task(observation=replace(SMALL, perception=ALL)))
    context = jax.tree.map(lambda leaf: jnp.asarray(leaf[25]), obs["context"])
    for name, value in jax.jit(simulator.observe)(bank, context).items():
        np.testing.assert_allclose(value, obs["all"][name][25], atol=1e-6, err_msg=name)


def test_perception_without_errors_draws_no_random_numbers(bank):
    """The compiled program contains none, whatever the seed."""

    def program(perception):
        config = replace(SMALL, perception=perception)
        simulator = Simulator(Task(observation=config))

        def look(bank):
            context = simulator.context(bank, 0, 20)
            return observe(config, bank, context, partial(simulator.frame, bank, context, _alone(context)))

        return str(jax.make_jaxpr(look)(bank))

    plain = program(Perception())
    assert "random" not in plain and program(Perception(seed=9)) == plain
    for perception in (Perception(noise_m=0.1), Perception(dropout_m=200.0)):
        assert "random" in program(perception)


def _alone(context):
    return jax.tree.map(lambda leaf: leaf[None], context)
