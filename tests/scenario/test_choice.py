"""Selection of scenarios by filters, names and number."""

from dataclasses import dataclass, field
from pathlib import Path

import pytest

from drivax.api import load
from drivax.errors import DataError, UsageError
from drivax.scenario.build.assemble import assemble
from drivax.scenario.select.selection import select_scenarios
from scenes import car, straight_road


def entry(number, dataset="one", **tags):
    return {
        "scenario_id": f"log-{number}", "dataset": dataset, "segment": f"s{number}", "flags": ["ROUTE"],
        "audit": {"distance_m": 10.0 * number}, "overflow": {}, "source": {}, "segments": 5, "tags": tags,
    }  # fmt: skip


@dataclass
class Set:
    path: Path = Path("sets/made")
    entries: list = field(
        default_factory=lambda: [
            entry(0, type="straight", place="boston", lights="yes"),
            entry(1, type="turn_left", place="boston"),
            entry(2, type="turn_left"),
            entry(3, type="merge", place="singapore"),
            entry(1, "two", type="straight"),
        ]
    )


@pytest.mark.parametrize(
    ("options", "rows"),
    [
        ({}, [0, 1, 2, 3, 4]),
        ({"limit": 2}, [0, 1]),
        ({"filters": ["type=turn_left"]}, [1, 2]),
        ({"filters": ["type=turn_left|merge", "audit.distance_m>10"]}, [2, 3]),
        ({"filters": ["type=turn_left"], "limit": 1}, [1]),  # the limit counts what is left
        ({"names": ["log-3", "log-0"]}, [0, 3]),  # in the order of the set
        ({"names": ["log-1"]}, [1, 4]),
        ({"names": ["two\tlog-1", "log-1"]}, [1, 4]),
        ({"names": ["two\tlog-1"]}, [4]),
        ({"names": ["log-1", "log-2"], "filters": ["type=turn_left"], "limit": 1}, [1]),
        ({"filters": ["scenario_id!=log-1|log-3"]}, [0, 2]),
        ({"filters": ["flag!=NO_FUTURE"], "limit": 9}, [0, 1, 2, 3, 4]),
    ],
)
def test_options_select_the_expected_rows(options, rows):
    assert select_scenarios(Set(), **options) == rows


def test_names_may_include_a_file_of_names(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "some.txt").write_text("log-2\r\n\n two\tlog-1\n")
    (tmp_path / "log-3").write_text("log-0\n")  # what is an id in the set is one
    assert select_scenarios(Set(), names=["some.txt", "log-3"]) == [2, 3, 4]
    assert select_scenarios(Set(), names=[Path("log-3")]) == [0]


def test_names_in_a_file_may_contain_line_breaks_of_unicode(tmp_path):
    data, name = Set(), "log\u20285"
    data.entries[2]["scenario_id"] = name
    (tmp_path / "some.txt").write_text(f"log-3\none\t{name}\n")
    assert select_scenarios(data, names=[tmp_path / "some.txt"]) == [2, 3]


def test_a_file_with_millions_of_names_is_refused_before_they_take_memory(tmp_path):
    file = tmp_path / "some.txt"
    file.write_bytes(b"a\n" * 4_000_001)
    with pytest.raises(DataError, match="has more than 4,000,000 lines; give a file"):
        select_scenarios(Set(), names=[file])


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"names": ["log_3"]}, DataError, "sets/made: 'log_3' is not in the set; did you mean 'log-3'?"),
        ({"names": ["x", "log-1", "y", "z", "w"]}, DataError, "'x', 'y', 'z' and 1 more are not in the set"),
        ({"names": ["two\tlog-0"]}, DataError, "'two / log-0' is not in the set; the set has this id in data set one"),
        ({"names": ["ids.txt"]}, DataError, "ids.txt: 'log-7' (line 2) is not in the set sets/made"),
        ({"names": [Path("none.txt")]}, DataError, "none.txt: file not found"),
        ({"filters": ["typ=turn_left"]}, UsageError, "did you mean 'type'?"),
        ({"filters": ["type=turn_lef"]}, UsageError, "did you mean 'turn_left'?"),
        ({"filters": ["place=bostn"]}, DataError, "no scenario is selected by 'place=bostn'; did you mean 'boston'?"),
        ({"filters": ["type=u_turn"]}, DataError, "by 'type=u_turn'; use one of merge, straight, turn_left"),
        ({"filters": ["type=merge", "place=boston"]}, DataError, "is selected; use fewer filters or other names"),
        ({"filters": ["lights=5"]}, DataError, "no scenario is selected by 'lights=5'; drop this filter"),
        ({"names": ["log-7" * 99]}, DataError, "is not in the set"),  # longer than any path
        ({"filters": "type=merge"}, UsageError, "filters are the text 'type=merge'; give a list: ['type=merge']"),
        ({"names": "log-1"}, UsageError, "scenario names are the text 'log-1'; give a list"),
        ({"limit": 0}, UsageError, "--limit 0 leaves no scenario; use 1 or more"),
    ],
)  # fmt: skip
def test_invalid_selections_give_one_line(options, error, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ids.txt").write_text("log-1\nlog-7\n")
    with pytest.raises(error) as raised:
        select_scenarios(Set(), **options)
    assert words in str(raised.value)


@pytest.mark.parametrize("limit", [0, -1])
def test_impossible_limit_of_own_scenarios_is_refused(limit):
    with pytest.raises(UsageError, match=f"a limit of {limit} leaves no scenario"):
        load([assemble(straight_road([car()]))], limit)
