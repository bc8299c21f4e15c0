"""Every reward term on hand-made facts, against a NumPy version on random ones, and in presets with options."""

from __future__ import annotations

import math
import re
from dataclasses import fields, replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax import settings
from drivax.errors import UsageError
from drivax.learning.config import TrainConfig
from drivax.scenario.bank.queries import LaneHits, RouteHit
from drivax.simulator.types import FACTS, ON_REQUEST, Facts, Frame, Surroundings
from drivax.tasks.conditions import Condition
from drivax.tasks.rewards import (
    AGGRESSIVE,
    PRESETS,
    PUBLISHED,
    TERMS,
    OwnTerm,
    RewardConfig,
    collision,
)
from drivax.tasks.task import Task

#: Which facts are booleans, which are whole numbers; the others are numbers.
FLAGS = {
    "collision", "at_fault", "offroad", "left_map", "red_light", "ttc_defined", "routed", "logged", "wrong_way",
    "straddling", "off_route", "lane_changed", "merged",
}  # fmt: skip
WHOLE = {"collision_type": np.int8, "ignored": np.int16, "strand": np.int16}
#: A quiet moment: 10 m/s under a limit of 13.4 m/s, on the route, no agent near.
QUIET = {
    "speed_mps": 10.0, "limit_mps": 13.4, "routed": True, "logged": True, "ttc_s": 5.0, "ttc_defined": True,
    "gap_m": 50.0, "progress_m": 20.0, "goal_distance_m": 60.0, "strand": 3, "moved_m": 1.0,
}  # fmt: skip


def facts(**changes):
    values = {field.name: 0.0 for field in fields(Facts)} | QUIET | changes
    typed = {}
    for name, value in values.items():
        kind = bool if name in FLAGS else WHOLE.get(name, np.float32)
        typed[name] = jnp.asarray(value, kind)
    return Facts(**typed)


def around(near=True):
    no, zero = jnp.zeros((), bool), jnp.zeros(())
    hits = LaneHits(jnp.asarray(near), jnp.zeros(4, bool), no, no, no, no, limit=zero, z=zero)
    frame = Frame(
        jnp.zeros((2, 6)), jnp.zeros((2, 2)), jnp.zeros(2), jnp.zeros(2, bool), jnp.zeros(2, jnp.int32),
        jnp.zeros(0, jnp.int32),
    )  # fmt: skip
    return Surroundings(frame, hits, RouteHit(zero, zero, zero, jnp.zeros(2)))


BEFORE = facts(progress_m=19.0, goal_distance_m=61.0)


def value(term, near=True, before=BEFORE, **now):
    """A term at a quiet moment with these changes."""
    found = (TERMS[term] if isinstance(term, str) else term)(before, facts(**now), around(near))
    assert found.dtype == jnp.float32 and found.shape == ()
    return float(found)


#: Scales of ``pace``, m.
LATE_M, EARLY_M = 2.0, 8.0
#: Term, what is different from the quiet moment, and the value by hand.
CASES = [
    ("collision", {}, 0.0),
    ("collision", {"collision": True}, 1.0),
    ("at_fault_collision", {"collision": True}, 0.0),
    ("at_fault_collision", {"collision": True, "at_fault": True}, 1.0),
    ("offroad", {}, 0.0),
    ("offroad", {"offroad": True}, 1.0),
    ("red_light", {}, 0.0),
    ("red_light", {"red_light": True}, 1.0),
    ("off_route", {}, 0.0),
    ("off_route", {"off_route": True}, 1.0),
    ("progress", {}, 1.0 / 1.2),
    ("progress", {"progress_m": 20.5}, 1.0),
    ("progress", {"routed": False}, 0.0),
    ("discomfort", {"acceleration_mps2": 1.2}, 0.25),
    ("discomfort", {"lateral_acceleration_mps2": -9.0}, 1.0),
    ("speeding", {"speed_mps": 15.7}, 1.0),
    ("speeding", {"speed_mps": 15.6}, 0.0),
    ("speeding", {"speed_mps": 40.0, "limit_mps": -1.0}, 0.0),
    ("any_progress", {}, 1.0),
    ("any_progress", {"progress_m": 19.001}, 1.0),
    ("any_progress", {"progress_m": 19.0}, 0.0),
    ("any_progress", {"routed": False}, 0.0),
    ("comfort", {}, 1.0),
    ("comfort", {"jerk_mps3": -6.63}, 0.5),
    ("comfort", {"jerk_mps3": 3.0, "lateral_acceleration_mps2": -3.63}, 0.5),
    ("comfort", {"jerk_mps3": 20.0}, 0.0),
    ("any_speeding", {"speed_mps": 13.4}, 0.0),
    ("any_speeding", {"speed_mps": 13.5}, 1.0),
    ("any_speeding", {"speed_mps": 13.5, "limit_mps": -1.0}, 0.0),
    ("ttc", {"ttc_s": 1.6}, 0.0),
    ("ttc", {"ttc_s": 1.4}, 1.0),
    ("ttc", {"ttc_s": 0.0, "ttc_defined": False}, 0.0),
    ("ttc_shortfall", {"ttc_s": 1.2}, 0.0),
    ("ttc_shortfall", {"ttc_s": 0.25}, 0.75),
    ("ttc_shortfall", {"ttc_s": 0.0, "ttc_defined": False}, 0.0),
    ("close", {"gap_m": 1.1}, 0.0),
    ("close", {"gap_m": 0.9}, 1.0),
    ("wrong_way", {}, 0.0),
    ("wrong_way", {"wrong_way": True}, 1.0),
    ("straddling", {}, 0.0),
    ("straddling", {"straddling": True}, 1.0),
    ("log_divergence", {"log_divergence_m": 2.5}, 2.5),
    ("log_divergence", {"log_divergence_m": 25.0}, 10.0),
    ("log_divergence", {"log_divergence_m": 2.5, "logged": False}, 0.0),
    ("lag", {"lag_m": 2.5}, 2.5),
    ("lag", {"lag_m": 25.0}, 10.0),
    ("lag", {"lag_m": -2.5}, 0.0),
    ("lag", {"lag_m": 2.5, "logged": False}, 0.0),
    ("speed_ratio", {"speed_mps": 6.7}, 0.5),
    ("speed_ratio", {"speed_mps": 20.0}, 1.0),
    ("speed_ratio", {"limit_mps": -1.0}, 0.0),
    ("goal", {}, 0.0),
    ("goal", {"goal_distance_m": 2.9}, 1.0),
    ("goal", {"goal_distance_m": 2.9, "routed": False}, 0.0),
    ("lane_change", {}, 0.0),
    ("lane_change", {"lane_changed": True}, 1.0),
    ("merge", {}, 0.0),
    ("merge", {"merged": True}, 1.0),
    # On time; at the slack ahead; one scale late; one scale early.
    ("pace", {"late_m": -5.0, "early_m": -5.0}, 1.0),
    ("pace", {"late_m": -11.0, "early_m": 1.0}, 1.0),
    ("pace", {"late_m": LATE_M, "early_m": -18.0}, 0.5),
    ("pace", {"late_m": -15.0, "early_m": 1.0 + EARLY_M}, np.exp(-1)),
    ("completion", {"completed": 0.25}, 0.25),
    ("completion", {}, 0.0),
    ("route_offset", {"route_deviation_m": 0.25}, 0.25),
    ("route_offset", {"route_deviation_m": 5.0}, 1.0),
    ("route_offset", {"route_deviation_m": 5.0, "routed": False}, 0.0),
    ("urgency", {"ttc_s": 0.5}, 0.75),
    ("urgency", {"ttc_s": 2.5}, 0.0),
    ("urgency", {"ttc_s": 0.0, "ttc_defined": False}, 0.0),
    ("excess_speed", {}, 0.0),
    ("excess_speed", {"speed_mps": 16.75}, 0.25),
    ("excess_speed", {"speed_mps": 40.0}, 1.0),
    ("excess_speed", {"speed_mps": 40.0, "limit_mps": -1.0}, 0.0),
    ("time_gap_shortfall", {"time_gap_s": 1.6}, 0.0),
    ("time_gap_shortfall", {"time_gap_s": 0.6}, 0.6),
    ("time_gap_shortfall", {"time_gap_s": 0.0, "ttc_defined": False}, 0.0),
]


@pytest.mark.parametrize(("term", "changes", "expected"), CASES)
def test_terms_by_hand(term, changes, expected):
    assert value(term, **changes) == pytest.approx(expected, abs=1e-5)


def test_each_term_has_cases():
    assert {term for term, _, _ in CASES} == set(TERMS)


def test_straddling_is_zero_away_from_lanes():
    assert value("straddling", near=False, straddling=True) == 0.0


def test_goal_counts_once():
    there = facts(goal_distance_m=2.0)
    assert value("goal", before=there, goal_distance_m=1.0) == 0.0


def test_margins_widen_collisions():
    with_margin = partial(collision, collision_margin_m=0.5)
    assert value(with_margin, gap_m=0.6) == 0.0
    assert value(with_margin, gap_m=0.4) == 1.0
    assert value(with_margin, gap_m=0.6, collision=True) == 1.0
    wary = RewardConfig(
        preset="safety", collision_margin_m=0.5, ttc=-0.5, ttc_s=0.95, close=-0.1, close_m=3.0
    )
    found = {
        gap: wary.weigh(BEFORE, facts(gap_m=gap, ttc_s=ttc), around())
        for gap, ttc in ((0.4, 0.9), (2.9, 1.0), (3.1, 5.0))
    }
    assert [float(terms["collision"]) for terms in found.values()] == [-1, 0, 0]
    assert [float(terms["ttc"]) for terms in found.values()] == [-0.5, 0, 0]
    assert [float(terms["close"]) for terms in found.values()] == pytest.approx([-0.1, -0.1, 0])


def test_scale_multiplies_all_terms():
    """The worst step of ``published`` is -3.3 and the best 0.4, by the weights; scaled they are in [-1, 1]."""
    failures = dict.fromkeys(("collision", "offroad", "red_light", "off_route"), True)
    worst = facts(**failures, speed_mps=20.0, jerk_mps3=20.0, progress_m=19.0)
    published = RewardConfig(preset="published")
    for scale in (1.0, 0.3):
        scaled = replace(published, scale=scale)
        for now, whole in ((worst, -3.3), (facts(), 0.4)):
            terms = scaled.weigh(BEFORE, now, around())
            assert float(sum(terms.values())) == pytest.approx(scale * whole, abs=1e-6)
            plain = published.weigh(BEFORE, now, around())
            assert {name: float(term) for name, term in terms.items()} == pytest.approx(
                {name: scale * float(term) for name, term in plain.items()}, abs=1e-6
            )


def in_numpy(before, now, near):
    """All terms once more, row by row from their definitions: NumPy, float64, shares no code with the package."""
    rows = {}
    for i in range(len(near)):
        b, n = ({name: float(column[i]) for name, column in side.items()} for side in (before, now))
        known, defined, routed = n["limit_mps"] > 0, n["ttc_defined"] > 0, n["routed"] > 0
        gained = n["progress_m"] - b["progress_m"]
        hard = [
            n["acceleration_mps2"] / (2.40 if n["acceleration_mps2"] >= 0 else 4.05),
            n["lateral_acceleration_mps2"] / 4.89,
            n["jerk_mps3"] / 8.37,
        ]
        felt = (abs(n["jerk_mps3"]) + abs(n["lateral_acceleration_mps2"])) / 13.26
        row = {
            "collision": n["collision"],
            "at_fault_collision": n["at_fault"],
            "offroad": n["offroad"],
            "red_light": n["red_light"],
            "off_route": n["off_route"],
            "progress": min(max(gained / 1.2, 0), 1) if routed else 0,
            "discomfort": min(1, max(abs(h) for h in hard) ** 2),
            "speeding": known and n["speed_mps"] - n["limit_mps"] > 2.23,
            "any_progress": routed and gained > 0,
            "comfort": 1 - min(1, felt),
            "any_speeding": known and n["speed_mps"] > n["limit_mps"],
            "ttc": defined and n["ttc_s"] < 1.5,
            "ttc_shortfall": max(0, 1 - n["ttc_s"]) if defined else 0,
            "close": n["gap_m"] < 1,
            "wrong_way": n["wrong_way"],
            "straddling": n["straddling"] and near[i],
            "log_divergence": min(n["log_divergence_m"], 10) if n["logged"] else 0,
            "lag": min(max(n["lag_m"], 0), 10) if n["logged"] else 0,
            "speed_ratio": min(n["speed_mps"] / n["limit_mps"], 1) if known else 0,
            "goal": routed and n["goal_distance_m"] <= 3 < b["goal_distance_m"],
            "lane_change": n["lane_changed"],
            "merge": n["merged"],
            "pace": np.exp(-max(n["early_m"] - 1, 0) / EARLY_M) / (1 + max(n["late_m"], 0) / LATE_M),
            "completion": max(n["completed"] - b["completed"], 0),
            "route_offset": min(n["route_deviation_m"], 1) if routed else 0,
            "urgency": max(0, 1 - n["ttc_s"] / 2) if defined else 0,
            "excess_speed": min(max(n["speed_mps"] / n["limit_mps"] - 1, 0), 1) if known else 0,
            "time_gap_shortfall": max(0, 1 - n["time_gap_s"] / 1.5) if defined else 0,
        }
        for name, number in row.items():
            rows.setdefault(name, []).append(float(number))
    return {name: np.array(column) for name, column in rows.items()}


#: Ranges in which thresholds fall both ways; others 0 to 2.
RANGES = {
    "speed_mps": (0, 30), "acceleration_mps2": (-6, 4), "lateral_acceleration_mps2": (-6, 6), "jerk_mps3": (-12, 12),
    "log_divergence_m": (0, 15), "goal_distance_m": (0, 6), "progress_m": (0, 3), "ttc_s": (0, 3), "gap_m": (0, 3),
    "lag_m": (-5, 15), "late_m": (-15, 15), "early_m": (-15, 15), "completed": (0, 1), "route_deviation_m": (0, 3),
    "time_gap_s": (0, 3),
}  # fmt: skip


def random_facts(rng, count):
    columns = {}
    for name in (field.name for field in fields(Facts)):
        if name in FLAGS:
            columns[name] = rng.random(count) < 0.5
        elif name == "limit_mps":
            columns[name] = np.where(rng.random(count) < 0.3, -1.0, rng.uniform(5, 25, count)).astype(
                np.float32
            )
        else:
            columns[name] = rng.uniform(*RANGES.get(name, (0, 2)), count).astype(WHOLE.get(name, np.float32))
    return columns


@cache
def on_random_facts():
    """Return the values of each term on random facts, and those of the NumPy version."""
    rng, count = np.random.default_rng(3), 400
    before, now, near = random_facts(rng, count), random_facts(rng, count), rng.random(count) < 0.5
    once = around()

    @jax.jit
    @jax.vmap
    def every(before, now, near):
        there = replace(once, lanes=replace(once.lanes, near=near))
        return {name: term(before, now, there) for name, term in TERMS.items()}

    as_facts = [
        Facts(**{name: jnp.asarray(column) for name, column in side.items()}) for side in (before, now)
    ]
    return every(*as_facts, jnp.asarray(near)), in_numpy(before, now, near)


def test_terms_agree_with_numpy_on_random_facts():
    found, expected = on_random_facts()
    assert set(found) == set(expected)
    for name, column in expected.items():
        np.testing.assert_allclose(found[name], column, atol=1e-5, err_msg=name)
        assert 0 < np.mean(column != column[0]) < 1, name  # both ways occurred


def test_table_of_the_docs_has_each_term_with_its_range_and_option(repository):
    section = (
        (repository / "docs/guide/rewards.md").read_text().partition("\n## Terms\n")[2].partition("\n#")[0]
    )
    texts = dict(re.findall(r"^\| `(\w+)` \| (.+?) \|", section, re.MULTILINE))
    assert sorted(texts) == sorted(TERMS)
    for name, text in texts.items():
        assert TERMS[name].function.__doc__
        option = re.search(r"`(\w+)` \(([\d.]+)", text)
        assert TERMS[name].option == (option and option[1])
        assert option is None or getattr(RewardConfig(), option[1]) == float(option[2])
        values, most = np.asarray(on_random_facts()[0][name]), re.search(r"(?:at most|0 to) (\d+)", text)
        if re.match("1 (while|at|on) ", text):
            assert set(values) == {0.0, 1.0}, name
        assert (values >= 0).all() and (most is None or (values <= float(most[1])).all()), name


@pytest.mark.parametrize("term", TERMS)
def test_terms_read_only_their_registered_facts(term):
    def lean(whole):
        kept = {field.name: getattr(whole, field.name) for field in fields(Facts)}
        made = object.__new__(Facts)
        for name, fact in kept.items():
            object.__setattr__(made, name, fact if name in TERMS[term].reads else None)
        return made

    assert TERMS[term].reads <= FACTS | ON_REQUEST
    now = facts(lane_changed=True, straddling=True)
    assert float(TERMS[term](lean(BEFORE), lean(now), around())) == value(
        term, lane_changed=True, straddling=True
    )


def test_published_presets_have_the_published_weights():
    assert {"collision": -1, "offroad": -1, "red_light": -1}.items() <= PUBLISHED.items()
    rest = {"off_route": -0.2, "any_progress": 0.2, "comfort": 0.2, "any_speeding": -0.1}
    assert dict(PUBLISHED.items() - PRESETS["safety"].items()) == rest
    more = {"ttc_shortfall": -0.5, "speed_ratio": 0.3, "lane_change": 0.2, "merge": 0.2}
    assert dict(AGGRESSIVE.items() - PUBLISHED.items()) == more


def total(preset, **now):
    return float(sum(RewardConfig(preset=preset).weigh(BEFORE, facts(**now), around()).values()))


def test_published_by_hand():
    """The published ranges: -3.3 at worst, 0.4 at best."""
    assert total("published") == pytest.approx(0.4)
    worst = {
        "collision": True, "offroad": True, "red_light": True, "off_route": True, "progress_m": 19.0, "jerk_mps3": 99.0,
        "speed_mps": 14.0,
    }  # fmt: skip
    assert total("published", **worst) == pytest.approx(-3.3)


def test_aggressive_preset_by_hand():
    # Published 0.4, 10 / 13.4 of the limit; then 0.3 s from a car in front; then into the next lane, which is a merge.
    fast = 0.3 * 10 / 13.4
    assert total("aggressive") == pytest.approx(0.4 + fast)
    assert total("aggressive", ttc_s=0.3) == pytest.approx(0.4 + fast - 0.5 * 0.7)
    assert total("aggressive", lane_changed=True, merged=True) == pytest.approx(0.4 + fast + 0.4)


def test_soft_factors_lower_a_softened_term_one_after_the_other():
    """Each takes its share of what those before it leave, so that the sum is their product."""
    hard = {"ttc_s": 1.0, "acceleration_mps2": 1.2, "speed_mps": 20.0, "route_deviation_m": 0.5}
    terms = RewardConfig(preset="pace", scale=2.0).weigh(BEFORE, facts(**hard), around())
    assert float(terms["pace"]) == pytest.approx(0.2)
    assert float(terms["pace/urgency"]) == pytest.approx(-0.2 * 0.3 * 0.5)
    assert float(terms["pace/discomfort"]) == pytest.approx(-0.2 * 0.85 * 0.2 * 0.25)
    whole = 0.2 * (1 - 0.3 * 0.5) * (1 - 0.2 * 0.25) * (1 - 0.2) * (1 - 0.2 * 0.5)
    assert float(sum(terms.values())) == pytest.approx(whole)
    crash = RewardConfig(preset="pace").weigh(BEFORE, facts(collision=True), around())
    assert float(sum(crash.values())) == pytest.approx(-3.0 + 0.1)


def test_soft_terms_read_the_facts_of_their_factors():
    assert {"late_m", "early_m", "ttc_s", "jerk_mps3", "limit_mps", "route_deviation_m"} < RewardConfig(
        preset="pace"
    ).reads
    assert "early_m" not in RewardConfig(preset="completion").reads


def test_facts_of_disabled_terms_are_not_measured():
    for preset in ("safety", "navigation", "behaviour", "published"):
        assert not RewardConfig(preset=preset).reads & ON_REQUEST
        assert not Task(rewards=RewardConfig(preset=preset)).reads & ON_REQUEST
    assert RewardConfig(preset="aggressive").reads & ON_REQUEST == {"lane_changed", "merged"}
    assert RewardConfig(collision_margin_m=0.5).reads - RewardConfig().reads == {"gap_m"}
    calm = RewardConfig(preset="aggressive", lane_change=0.0, merge=0.0)
    assert set(AGGRESSIVE) - set(calm.weights()) == {"lane_change", "merge"}
    assert not calm.reads & ON_REQUEST


def test_own_terms_get_facts_on_request():
    def alongside(before, now, around):
        return (now.gap_m < 2.0).astype(jnp.float32)

    plain, asking = OwnTerm(alongside, -0.1), OwnTerm(alongside, -0.1, reads=("gap_m",))
    assert RewardConfig(own=(plain,)).reads == FACTS
    config = RewardConfig(preset="safety", own=(asking,))
    assert config.reads == FACTS | {"gap_m"}
    assert float(config.weigh(BEFORE, facts(gap_m=1.0), around())["alongside"]) == pytest.approx(-0.1)
    with pytest.raises(ValueError, match="reads unknown fact 'gap'"):
        OwnTerm(alongside, -0.1, reads=("gap",))
    with pytest.raises(ValueError, match="weight of 'alongside' is nan"):
        OwnTerm(alongside, math.nan)
    with pytest.raises(ValueError, match="weight of collision is nan; choose a finite number"):
        RewardConfig(collision=math.nan)


def conditioned(rewards, conditions, **now):
    """Weighted terms of a task with conditions of these numbers."""
    task = Task(rewards=rewards, conditions=tuple(Condition(name, 0.0, 2.0) for name in conditions))
    terms = task.reward(BEFORE, facts(**now), around(), jnp.array(list(conditions.values()), jnp.float32))
    return {name: float(term) for name, term in terms.items()}


def test_conditioned_rewards_by_hand():
    """10 m/s under a limit of 13.4 m/s: 0.0463 of it above 0.7 x 13.4 m/s. A gap of 1 s is half of 2 s."""
    rewards = RewardConfig(preset="safety", excess_speed=-0.5, time_gap_shortfall=-0.2)
    now = {"collision": True, "time_gap_s": 1.0}
    terms = conditioned(rewards, {"collision": 1.5, "desired_speed": 0.7, "time_gap_s": 2.0}, **now)
    assert terms["collision"] == -1.5 and terms["offroad"] == 0.0
    assert terms["excess_speed"] == pytest.approx(-0.5 * (10 / 13.4 - 0.7))
    assert terms["time_gap_shortfall"] == pytest.approx(-0.2 * 0.5)
    calm = conditioned(rewards, {"collision": 0.5, "desired_speed": 0.8, "time_gap_s": 0.9}, **now)
    assert calm == {
        "collision": -0.5,
        "offroad": 0,
        "red_light": 0,
        "excess_speed": 0,
        "time_gap_shortfall": 0,
    }
    # A gap of 0 s asks for none.
    touching = conditioned(rewards, {"time_gap_s": 0.0}, time_gap_s=0.0)
    assert touching["time_gap_shortfall"] == 0.0


def test_factor_of_a_softened_term_multiplies_what_its_factors_take():
    """A time to collision of 1 s takes 0.15 of ``pace``."""
    terms = conditioned(RewardConfig(preset="pace", scale=2.0), {"pace": 1.5}, ttc_s=1.0)
    assert terms["pace"] == pytest.approx(2.0 * 0.1 * 1.5)
    assert terms["pace/urgency"] == pytest.approx(-2.0 * 0.1 * 1.5 * 0.15)


def test_own_terms_have_factors():
    rewards = RewardConfig(preset="safety", own=(OwnTerm(lambda *_: jnp.ones(()), 0.3, name="alive"),))
    assert conditioned(rewards, {"alive": 0.25})["alive"] == pytest.approx(0.075)


def test_reward_weights_override_presets_and_are_checked():
    rewards = {"preset": "published", "collision_margin_m": 0.5, "ttc": -0.3, "ttc_s": 0.95}
    made = settings.load(TrainConfig, {"task": {"rewards": rewards}}).task.rewards
    assert made.weights() == PUBLISHED | {"ttc": -0.3} and made.ttc_s == 0.95
    for wrong in (
        {"preset": "publishd"},
        {"collision_margin_m": -1.0},
        {"ttc_s": 9.0},
        {"close_m": 99.0},
        {"scale": 0},
    ):
        with pytest.raises(UsageError, match=r"task\.rewards"):
            settings.load(TrainConfig, {"task": {"rewards": wrong}})
