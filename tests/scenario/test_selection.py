"""Filters: what they select, what they never select silently, and how wrong ones are refused."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivax.errors import UsageError
from drivax.scenario.build.assemble import assemble
from drivax.scenario.manifest import manifest_entry
from drivax.scenario.schema import CAPACITIES, Flag
from drivax.scenario.select.selection import FINDINGS, OVERFLOWS, Selection, vocabulary
from scenes import GREEN, car, straight_road

ENTRY = {
    "scenario_id": "637",
    "dataset": "womd",
    "segment": "a",
    "flags": ["LIGHTS", "LANE_GRAPH"],
    "segments": 300,
    "source": {
        "steps": 91, "tracks": 83, "tracks_valid_now": 50, "map_points": 19636, "lights": 12,
        "map_features": {"lane": 199, "stop_sign": 8}, "lost": {},
    },
    "overflow": {"agents": 3},
    "audit": {"log_collides": False, "distance_m": 5.0, "velocity": "measured", "route_deviation_max_m": None},
    "tags": {
        "place": "boston", "source_format": "womd-scenario", "fleet": "7", "scenario_types": "stop|left_turn",
        "lights": "yes", "type": "turn_left",
    },
}  # fmt: skip


def chosen(*filters):
    return Selection.parse(filters).matches(ENTRY)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("place=boston", True),
        ("place=boston|pittsburgh", True),
        ("place=pittsburgh", False),
        ("place!=boston", False),
        ("place!=pittsburgh|singapore", True),
        ("dataset=womd", True),
        ("scenario_id=637", True),
        ("scenario_id=637.0", False),
        ("tag.fleet=7", True),
        ("tag.fleet!=7", False),
        ("scenario_types=left_turn", True),
        ("scenario_types=left_turn|starting_left_turn", True),
        ("scenario_types=u_turn|stop", True),
        ("scenario_types!=left_turn", False),
        ("scenario_types=turn", False),
        ("agents>=50", True),
        ("agents>50", False),
        ("agents<=50", True),
        ("agents<50", False),
        ("agents=50|60", True),
        ("agents!=50", False),
        (" agents >= 1e1 ", True),
        ("steps=91", True),
        ("tracks=83", True),
        ("map_points>19635", True),
        ("map_features.stop_sign>=8", True),
        ("map_features.crosswalk=0", True),
        ("segments<301", True),
        ("lights>=12", True),
        ("lights=12|13", True),
        ("lights=yes", True),
        ("lights!=yes", False),
        ("type=turn_left|u_turn", True),
        ("type!=turn_left", False),
        ("flag=LIGHTS", True),
        ("flag=lights", True),
        ("flag=NO_FUTURE|LIGHTS", True),
        ("flag!=LIGHTS", False),
        ("flag!=NO_FUTURE|OVERFLOW", True),
        ("audit.log_collides=false", True),
        ("audit.log_collides=True", False),
        ("audit.log_collides!=true", True),
        ("audit.distance_m>=5", True),
        ("audit.distance_m>5", False),
        ("audit.velocity=measured", True),
        ("overflow.agents=0", False),
        ("overflow.agents<=3", True),
        ("overflow.lanes=0", True),
    ],
)
def test_single_filter_matches(text, expected):
    assert chosen(text) is expected


def test_all_filters_must_hold():
    assert chosen() and chosen("place=boston", "agents>10")
    assert not chosen("place=boston", "agents>100")


@pytest.mark.parametrize(
    "text",
    [
        "audit.log_runs_red=false",
        "audit.log_runs_red!=true",
        "audit.route_deviation_max_m<100",
        "audit.route_deviation_max_m!=1",
        "family=curved_road",
        "family!=curved_road",
        "tag.nothing!=x",
    ],
)
def test_unknown_values_match_nothing_and_are_counted(text):
    selection = Selection.parse([text, "agents>0"])
    assert not selection.matches(ENTRY)
    assert selection.unknown([ENTRY, ENTRY]) == {text: 2}
    assert selection.rows([ENTRY]) == []


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("plac=boston", ["'plac'", "did you mean 'place'?"]),
        ("log_colides=true", ["did you mean 'audit.log_collides'?"]),
        ("audit.log_colides=true", ["did you mean 'audit.log_collides'?"]),
        ("overflow.agent=0", ["did you mean 'overflow.agents'?"]),
        ("fleet=7", ["tag.fleet"]),
        ("tag.=7", ["'tag.'"]),
        ("flag=LIGHT", ["did you mean 'LIGHTS'?"]),
        ("audit.velocity=guessed", ["'guessed'", "measured"]),
        ("agents=many", ["'many' is not a number"]),
        ("agents>=nan", ["'nan' is not a number"]),
        ("agents>=3|4", ["a list cannot be compared by >=", "one number"]),
        ("place>boston", ["cannot be compared"]),
        ("flag>LIGHTS", ["cannot be compared"]),
        ("audit.clean=1", ["audit.clean=true or audit.clean=false"]),
        ("lights>=yes", ["'yes' is not a number"]),
        ("lights=yes|12", ["mixes"]),
        ("type=turn_lft", ["did you mean 'turn_left'?"]),
        ("place=", ["names no value"]),
        ("place=a||b", ["names no value"]),
        ("place==boston", ["is not a filter"]),
        ("boston", ["is not a filter"]),
        ("", ["is not a filter"]),
        ("=5", ["is not a filter"]),
    ],
)
def test_invalid_filters_give_one_line(text, words):
    with pytest.raises(UsageError) as caught:
        Selection.parse([text])
    line = str(caught.value)
    assert "\n" not in line and repr(text) in line
    assert all(word in line for word in words), line


@given(st.text(max_size=30))
def test_any_text_is_a_filter_or_a_usage_error(text):
    try:
        found = Selection.parse([text]).matches(ENTRY)
    except UsageError:
        return
    assert found in (True, False)


@given(
    st.lists(st.integers(0, 6), max_size=8),
    st.sampled_from(["<", "<=", ">", ">=", "=", "!="]),
    st.integers(0, 6),
)
def test_rows_are_those_that_the_operator_selects(counts, sign, number):
    entries = [{**ENTRY, "source": {**ENTRY["source"], "tracks": count}} for count in counts]
    holds = {
        "<": lambda n: n < number, "<=": lambda n: n <= number, ">": lambda n: n > number,
        ">=": lambda n: n >= number, "=": lambda n: n == number, "!=": lambda n: n != number,
    }[sign]  # fmt: skip
    expected = [row for row, count in enumerate(counts) if holds(count)]
    assert Selection.parse([f"tracks{sign}{number}"]).rows(entries) == expected


def test_every_name_has_a_value_in_a_stored_scenario():
    tags = {"place": "here", "source_format": "x", "domain": "x", "family": "x", "event": "x"}
    tags |= {"location": "x", "scenario_types": "x|y"}
    recording = replace(straight_road([car(0, 0, 0, 8)], light=GREEN), tags=tags)
    scenario = assemble(recording)
    findings = {
        name: {"truth": True, "number": 1, "word": "measured"}[q.kind] for name, q in FINDINGS.items()
    }
    entry = manifest_entry(replace(scenario, audit=findings, tags={**scenario.tags, **tags}))
    for name, quantity in vocabulary().items():
        word = {"truth": "true", "number": "1", "word": (*quantity.words, "x")[0]}[quantity.kind]
        selection = Selection.parse([f"{name}={word}"])
        assert selection.filters[0].find(entry) is not None, name
    assert {flag.name for flag in Flag if flag} == set(vocabulary()["flag"].words)


def test_overflow_counters_are_known_to_filters():
    small = replace(
        CAPACITIES["default"], agents=1, parked=1, segments=160, features=1, lanes=1, stops=0, road_rows=1, lights=0,
    )  # fmt: skip
    cars = [
        car(0, 0, 0, 8),
        *(car(12 * k, 3.7, 0, 4) for k in range(1, 4)),
        *(car(50 + 8 * k, 0) for k in range(4)),
    ]
    overflow = assemble(straight_road(cars, light=GREEN), small).overflow
    assert len(overflow) >= 5 and set(overflow) <= set(OVERFLOWS)
