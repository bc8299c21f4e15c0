"""Optional features: values by hand, columns in the order of ``COLUMNS``, presets, error messages."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax import settings
from drivax.errors import UsageError
from drivax.learning.config import TrainConfig
from drivax.scenario.recording import MapFeature
from drivax.scenario.schema import RoadKind
from drivax.simulator.simulator import Simulator
from drivax.tasks import example_features
from drivax.tasks.features import COLUMNS, Features, feature_names
from drivax.tasks.observations import PRESETS, ObservationConfig, OwnGroup
from drivax.tasks.perception import Perception
from drivax.tasks.task import Task
from drivax.testing import check_feature
from scenes import GLIMPSE, LANE_M, RED, bank_of, car, line, straight_road

RADIUS_M, STRAIGHT_M = 50.0, 40.0
EXAMPLES = (
    "relative_velocity",
    "lane_curvature",
    "recommended_speed",
    "time_gap",
    "stop_line",
    "car_following",
    "destination",
)
EVERYTHING = ObservationConfig(
    agents=3, steps=2, road=150, road_ahead_m=100.0, road_side_m=60.0, lights=2, route=16,
    features=Features(**{g: tuple(c) for g, c in COLUMNS.items()}),
    own=tuple(OwnGroup(getattr(example_features, name)) for name in EXAMPLES),
)  # fmt: skip
FEW = replace(
    EVERYTHING,
    features=Features(
        ego=("time", "position"), ego_static=("width",), agents=("type", "velocity"), road=("limit", "direction"),
        lights=(), route=("goal",),
    ),
    own=(),
)  # fmt: skip
CUT = replace(EVERYTHING, road=60, road_cut=5, features=Features(), own=())
UNCUT = replace(CUT, road=12, road_cut=1, edges=False, crosswalks=False)


def bend(cars, **more):
    """The straight road, which from x = 40 m on turns left with a radius of 50 m."""
    recording = straight_road(cars, light=RED, light_x=STRAIGHT_M, **more)
    angle = np.linspace(0.0, np.pi, 80)
    arc = np.stack([STRAIGHT_M + RADIUS_M * np.sin(angle), RADIUS_M * (1 - np.cos(angle))], axis=-1)
    lane = MapFeature(3, RoadKind.LANE_SURFACE, line(*arc), 13.4, LANE_M, (), (1,), (2,))
    features = [lane if feature.feature_id == 3 else feature for feature in recording.features]
    return replace(recording, features=tuple(features))


@pytest.fixture(scope="module")
def obs():
    """Observations at three poses under every configuration of this file, by one program."""
    cars = [car(0, 0, 0, 9), car(20, 0.5, np.pi / 2, 6, 5.0, 2.0), car(-12, 3.7, 0, 3)]
    bank = bank_of(bend(cars))
    configs = {"everything": EVERYTHING, "few": FEW, "cut": CUT, "uncut": UNCUT}

    def look(bank, x, y, heading, route_m):
        results = {}
        for name, config in configs.items():
            simulator = Simulator(Task(observation=config))
            context = simulator.context(bank, 0, 10)
            last = jnp.stack([x, y, heading, context.history[-1, 3]])
            context = replace(
                context, history=context.history.at[-1].set(last), route_m=context.route_m + route_m
            )
            results[name] = simulator.observe(bank, context)
        return results

    # The logged pose; 20 m along the arc, 1 m left of the lane; and facing across the road.
    angle = 20.0 / RADIUS_M
    on_arc = STRAIGHT_M + (RADIUS_M - 1) * np.sin(angle), RADIUS_M - (RADIUS_M - 1) * np.cos(angle)
    places = np.array([(0, 0, 0, 0), (*on_arc, angle, 60.0), (0, 0, np.pi / 2, 0)], np.float32)
    return jax.device_get(jax.jit(jax.vmap(look, (None, 0, 0, 0, 0)))(bank, *places.T))


def column(obs, group, name, place=0, of="everything", config=EVERYTHING):
    shapes = {name: value.shape[1:] for name, value in obs[of].items()}
    return obs[of][group][place][..., feature_names(config.features, shapes)[group].index(name)]


def test_optional_features_of_ego_and_agents(obs):
    np.testing.assert_allclose(column(obs, "ego", "time"), [-0.1, 0.0], atol=1e-6)
    np.testing.assert_allclose(column(obs, "ego_static", "height"), 1.5 / 5)
    # Nearest first: the slower car behind (12.6 m), then the one that crosses (20.0 m).
    np.testing.assert_allclose(
        column(obs, "agents", "relative_velocity ahead")[:2, -1], [-6 / 15, -9 / 15], atol=1e-5
    )
    np.testing.assert_allclose(
        column(obs, "agents", "relative_velocity left")[:2, -1], [0, 6 / 15], atol=1e-5
    )
    np.testing.assert_allclose(column(obs, "agents", "height")[:2], np.full((2, 2), 1.5 / 5))
    np.testing.assert_allclose(column(obs, "agents", "time")[:2], [[-0.1, 0.0]] * 2, atol=1e-6)
    assert not obs["everything"]["agents"][0, 2].any()
    # Seen from an ego that faces across the road at the same speed, everything is turned by 90 degrees.
    relative = obs["everything"]["agents"][2, 1, -1]
    at = feature_names(EVERYTHING.features, {"agents": (13,)})["agents"].index("relative_velocity ahead")
    np.testing.assert_allclose(relative[at : at + 2], [(6 - 9) / 15, 0], atol=1e-5)


def test_agents_relate_to_the_route_and_approach(obs):
    """The car behind is 6 m/s slower; the one that crosses leaves ego's path before ego arrives."""
    along, left = (column(obs, "agents", f"route {part}")[:2, -1] for part in ("along", "left"))
    np.testing.assert_allclose(along * 50, [-12, 20], atol=0.05)
    np.testing.assert_allclose(left * 5, [3.7, 0.5], atol=0.05)
    sine, cosine = (column(obs, "agents", f"route {part}")[:2, -1] for part in ("sin", "cos"))
    np.testing.assert_allclose([sine, cosine], [[0, 1], [1, 0]], atol=1e-3)
    behind, across = np.array([-12.0, 3.7]), np.array([20.0, 0.5])
    speeds = [-behind @ [-6, 0] / np.hypot(*behind), -across @ [-9, 6] / np.hypot(*across)]
    np.testing.assert_allclose(column(obs, "agents", "closing_speed")[:2, -1] * 15, speeds, atol=1e-3)
    # Ego's front is at 2.4 m; the crossing car is 2 m wide and leaves ego's lane after (1 + 2.5 - 0.5) / 6 s.
    assert (20 - 1 - 2.4) / 9 > (1 + 2.5 - 0.5) / 6
    np.testing.assert_array_equal(column(obs, "agents", "time_to_overlap")[:2, -1], 0.0)
    # At the second place, the car behind is not alongside the route.
    assert column(obs, "agents", "route left", place=1)[:2, -1].max() == pytest.approx(20 / 5)


def test_ego_on_its_route(obs):
    """On the straight; 1 m left of the arc; and across the road."""
    left, sine = (obs["everything"]["ego_static"][:, -2 + column] for column in (0, 1))
    np.testing.assert_allclose(left, [0, 1, 0], atol=0.02)
    np.testing.assert_allclose(sine, [0, 0, 1], atol=0.02)


def test_time_to_overlap_of_a_leader():
    """A gap of 15.2 m closes at 4 m/s in 3.8 s; without a route there are no route coordinates."""
    config = replace(EVERYTHING, own=(), agents=1, steps=1)
    recording = straight_road([car(0, 0, 0, 9), car(20, 0, 0, 5)])
    simulator, found = Simulator(Task(observation=config)), {}
    for name, scene in (("route", recording), ("none", replace(recording, route_lanes=()))):
        bank = bank_of(scene)
        observed = jax.device_get(jax.jit(lambda b: simulator.observe(b, simulator.context(b, 0, 10)))(bank))
        names = feature_names(config.features, {n: v.shape for n, v in observed.items()})["agents"]
        found[name] = dict(zip(names, observed["agents"][0, 0], strict=True))
    assert found["route"]["time_to_overlap"] == pytest.approx(1 - 3.8 / 8, abs=1e-3)
    assert found["route"]["route along"] == pytest.approx(0.4, abs=1e-3)
    assert found["none"]["time_to_overlap"] == pytest.approx(1 - 3.8 / 8, abs=1e-3)


def test_curvature_of_road_and_route(obs):
    mask = obs["everything"]["road_mask"][0]
    x, y = (column(obs, "road", f"position {axis}")[mask] * 50 for axis in "xy")
    lane = column(obs, "road", "type lane")[mask] > 0
    curvature = column(obs, "road", "curvature")[mask]
    arc = lane & (np.abs(np.hypot(x - STRAIGHT_M, y - RADIUS_M) - RADIUS_M) < 0.5) & (x > STRAIGHT_M + 5)
    straight = lane & (x < STRAIGHT_M - 5)
    assert arc.sum() >= 5 and straight.sum() >= 5
    assert 75 < x.max() < 100 and 50 < y.max() < 60 and x.min() > -10
    np.testing.assert_allclose(curvature[arc], 1 / RADIUS_M / 0.1, rtol=0.03)
    np.testing.assert_allclose(curvature[straight], 0.0, atol=1e-4)
    along = np.arange(1, 17) * 5.0
    expected = np.where(along > STRAIGHT_M + 2, 1 / RADIUS_M, 0.0)
    clear = np.abs(along - STRAIGHT_M) > 3
    found = column(obs, "route", "curvature")
    np.testing.assert_allclose(found[clear] * 0.1, expected[clear], atol=1e-3)
    speed = column(obs, "route", "recommended_speed")
    np.testing.assert_allclose(speed[clear] * 15, 30 - 25 * expected[clear], atol=0.03)
    np.testing.assert_allclose(obs["everything"]["recommended_speed"][0, :10, 0], speed[:10], rtol=1e-6)


def test_goal_is_in_the_ego_frame(obs):
    goal = np.stack([column(obs, "route", f"goal {axis}") for axis in "xy"], axis=-1)
    assert (goal == goal[:1]).all() and 0 < goal[0, 0] <= 5
    turned = np.stack([column(obs, "route", f"goal {axis}", place=2) for axis in "xy"], axis=-1)
    np.testing.assert_allclose(turned[0], [goal[0, 1], -goal[0, 0]], atol=1e-5)


def test_selected_columns_equal_those_of_all_features(obs):
    names = feature_names(FEW.features, {name: value.shape[1:] for name, value in obs["few"].items()})
    assert names == {
        "ego": ("position x", "position y", "time"),
        "ego_static": ("width",),
        "agents": ("velocity ahead", "velocity left", *(f"type {k}" for k in COLUMNS["agents"]["type"])),
        "road": ("direction cos", "direction sin", "limit", "limit known"),
        "route": ("goal x", "goal y"),
    }
    for group, columns in names.items():
        for number, name in enumerate(columns):
            np.testing.assert_array_equal(
                obs["few"][group][0, ..., number], column(obs, group, name), f"{group} {name}"
            )
    assert obs["few"]["agents_mask"].shape == (3, 3, 2) and "lights_mask" not in obs["few"]


def test_road_pieces_are_cut_into_equal_rows(obs):
    lanes = obs["uncut"]["road"][0]
    assert obs["uncut"]["road_mask"][0].all() and (lanes[:, 5] == 1).all()
    rows = obs["cut"]["road"][0].reshape(12, 5, -1)
    whole = rows.mean(axis=1)
    apart = np.linalg.norm(np.diff(rows[..., :2], axis=1), axis=-1) * 50
    length = whole[:, 4] * 10
    there = obs["cut"]["road_mask"][0].reshape(12, 5)
    assert (there == there[:, :1]).all() and there.any()
    np.testing.assert_allclose(apart, np.broadcast_to(length[:, None], apart.shape), atol=1e-4)
    assert length[there[:, 0]].max() <= 2.0 and length[there[:, 0]].max() > 1.5
    same = np.abs(whole[:, None, :2] - lanes[None, :, :2]).max(axis=-1) < 1e-5
    assert same.any(axis=1).sum() >= 3
    one, other = np.argwhere(same)[0]
    np.testing.assert_allclose(whole[one, 4] * 5, lanes[other, 4], rtol=1e-5)
    np.testing.assert_allclose(rows[one, :, 5:], np.broadcast_to(lanes[other, 5:], (5, 5)))


def test_example_features_equal_hand_computed_values(obs):
    own = obs["everything"]
    at = feature_names(EVERYTHING.features, {"agents": (13,)})["agents"].index("relative_velocity ahead")
    np.testing.assert_allclose(
        own["relative_velocity"][0, :2], own["agents"][0, :2, -1, at : at + 2], atol=1e-6
    )
    assert own["relative_velocity_mask"][0].tolist() == [True, True] + [False] * 6
    # No lane crosses the road; on the arc the lane bends by 1 / 50 m, in units of 0.1 1/m.
    np.testing.assert_allclose(own["lane_curvature"], [[0, 1], [0.2, 1], [0, 0]], atol=0.03)
    # Bumper to flank: 20 m less half of 4.8 m and half the width of the car that stands across, at 9 m/s.
    gap = (20 - 2.4 - 1.0) / 9
    np.testing.assert_allclose(own["time_gap"], [[gap / 10, 1], [1, 0], [1, 0]], atol=1e-5)
    # The line is 40 m ahead, 37.6 m from the bumper; from the arc it is passed.
    np.testing.assert_allclose(own["stop_line"][:2], [[37.6 / 50, 1, 1], [1, 0, 0]], atol=0.02)


def test_car_following_has_the_inputs_of_idm(obs):
    """The car that stands across the route leads, 16.6 m ahead, at no speed along it; nothing leads on the arc."""
    curve = np.sqrt(2.5 * RADIUS_M)
    expected = [[16.6 / 50, 9 / 15, 0, 1, 13.4 / 15], [90 / 50, 0, 0, 0, curve / 15]]
    np.testing.assert_allclose(obs["everything"]["car_following"][:2], expected, atol=0.01)


def test_without_a_route_nothing_shows_the_logged_path():
    """Where the bank stores ego's logged path instead of a route, no leader and no light is on it."""
    own = (OwnGroup(example_features.car_following), OwnGroup(example_features.stop_line))
    simulator = Simulator(Task(observation=replace(GLIMPSE, own=own)))
    bank = bank_of(straight_road([car(0, 0, 0, 9), car(20, 0, 0, 5)], light=RED))
    look, found = jax.jit(lambda b: simulator.observe(b, simulator.context(b, 0, 10))), {}
    for name, on_lanes in (("route", True), ("none", False)):
        found[name] = jax.device_get(look(replace(bank, on_lanes=jnp.array([on_lanes]))))
    np.testing.assert_allclose(found["route"]["car_following"][[0, 3]], [15.2 / 50, 1], atol=1e-3)
    assert found["route"]["lights"][0, -1] == 1.0 and found["route"]["stop_line"][2] == 1.0
    np.testing.assert_allclose(found["none"]["car_following"], [90 / 50, 0, 0, 0, 13.4 / 15], atol=1e-6)
    assert found["none"]["lights"][0, -1] == 0.0 and found["none"]["stop_line"][2] == 0.0


def test_destination_is_what_is_left_of_the_log():
    """A log of 8 s at 9 m/s, one that stands, and one without a route on lanes."""
    own = (OwnGroup(example_features.destination),)
    simulator = Simulator(Task(observation=replace(GLIMPSE, own=own)))
    bank = bank_of(straight_road([car(0, 0, 0, 9)]), straight_road([car(0, 0, 0, 0)]))
    look = jax.jit(
        lambda b, row, step: simulator.observe(b, simulator.context(b, row, step))["destination"],
        static_argnums=(1, 2),
    )
    np.testing.assert_allclose(look(bank, 0, 10), [72 / 50, 0.0, 0.8], atol=0.01)
    np.testing.assert_allclose(look(bank, 0, 50), [36 / 50, 0.5, 0.4], atol=0.01)
    np.testing.assert_allclose(look(bank, 1, 50), [0.0, 1.0, 0.4], atol=1e-6)
    off_lanes = replace(bank, on_lanes=jnp.array([False, False]))
    np.testing.assert_allclose(look(off_lanes, 0, 10), [0.0, 1.0, 0.8], atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", EXAMPLES)
def test_example_features_pass_their_checks(name):
    check_feature(f"drivax.tasks.example_features:{name}")


def load(text):
    return settings.load(TrainConfig, {"task": {"observation": settings.parse_yaml(text)}}).task.observation


def test_presets_by_name_in_yaml():
    assert load("{preset: minimal, agents: 4}") == replace(PRESETS["minimal"], agents=4)
    for name, preset in PRESETS.items():
        config = settings.load(TrainConfig, {}, ["--task.observation.preset", name])
        assert config.task.observation == preset
        assert settings.load(TrainConfig, settings.parse_yaml(settings.dump(config))) == config
    mixed = load("{preset: published, features: {road: [length, position]}, perception: {range_m: 60}}")
    assert mixed.features == replace(PRESETS["published"].features, road=("position", "length"))
    assert mixed.perception == Perception(range_m=60.0) and mixed.road == 2000
    assert load("{features: {ego_static: [width, length]}}") == ObservationConfig(
        features=Features(ego_static=("length", "width"))
    )
    own = load("{own: [{feature: drivax.tasks.example_features:lane_curvature}]}").own
    assert own == (OwnGroup(example_features.lane_curvature),)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "{preset: minimum}",
            "task.observation: unknown observation preset 'minimum'; did you mean 'minimal'?",
        ),
        (
            "{features: {agents: [positon]}}",
            r"features\.agents has no 'positon'; did you mean 'position'\?",
        ),
        ("{features: {agents: [type, type]}}", "features.agents names 'type' twice"),
        ("{lights: -1}", r"observation\.lights is -1; use 0 or more"),
        ("{route_step_m: 0}", r"observation\.route_step_m is 0; use a positive number"),
        ("{road_side_m: .nan}", r"observation\.road_side_m is nan; use 0 or a positive number"),
        ("{road: 12, road_cut: 5}", r"road_cut is 5; use a number that divides road \(12\)"),
        ("{perception: {range_m: 0}}", r"range_m is 0\.0; use a positive number, or null"),
        ("{perception: {noise_m: -1}}", r"noise_m is -1\.0; use 0 or a positive"),
    ],
)
def test_mistakes_are_reported_in_one_line(text, message):
    with pytest.raises(UsageError, match=message) as error:
        load(text)
    assert "\n" not in str(error.value)


def test_unknown_features_from_python():
    with pytest.raises(
        UsageError, match=r"observation\.features\.lights has no 'colour'; use one of position, state, on_"
    ):
        Features(lights=("colour",))
