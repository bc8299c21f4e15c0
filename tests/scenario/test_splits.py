"""Split files: by recording, stable, and near the shares that were asked for."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivax.errors import UsageError
from drivax.scenario.select.splits import NAMES, hold_out, parse_shares, split_of, write_splits


def entries(recordings: int, windows: int = 3) -> list[dict[str, str]]:
    return [
        {"dataset": "womd", "segment": f"log{log}", "scenario_id": f"log{log}@{40 * window}"}
        for window in range(windows)
        for log in range(recordings)
    ]


def read(folder: Path) -> dict[str, list[tuple[str, str]]]:
    return {
        name: [
            tuple(line.split("\t")) for line in (folder / "splits" / f"{name}.txt").read_text().splitlines()
        ]
        for name in NAMES
    }


@pytest.mark.parametrize(
    ("text", "shares"), [("80/10/10", (80, 10, 10)), ("100/0/0", (100, 0, 0)), ("99.5/0.5/0", (99.5, 0.5, 0))]
)
def test_shares_are_parsed_from_percentages(text, shares):
    assert parse_shares(text) == shares


@pytest.mark.parametrize(
    "text", ["", "80", "80/20", "80/10/20", "90/-10/20", "a/b/c", "nan/50/50", "1/1/1/97"]
)
def test_invalid_shares_are_refused(text):
    with pytest.raises(UsageError, match="is not a split; give percentages"):
        parse_shares(text)


def test_split_follows_the_sha_256_of_data_set_and_segment():
    """Computed here from the definition: the first 64 bits of the digest as a fraction of one."""
    for segment in map(str, range(50)):
        place = int(hashlib.sha256(b"nuplan\0" + segment.encode()).hexdigest()[:16], 16) / 16**16
        expected = "train" if place < 0.5 else "validation" if place < 0.7 else "test"
        assert split_of("nuplan", segment, (50, 20, 30)) == expected


def test_windows_of_a_recording_share_a_split(tmp_path):
    counts = write_splits(tmp_path, entries(400), (60, 20, 20))
    found = read(tmp_path)
    logs = {name: {scenario.split("@")[0] for _, scenario in rows} for name, rows in found.items()}
    assert not (
        logs["train"] & logs["validation"]
        or logs["train"] & logs["test"]
        or logs["test"] & logs["validation"]
    )
    assert {name: len(rows) for name, rows in found.items()} == counts
    assert sum(counts.values()) == 1200
    assert {dataset for rows in found.values() for dataset, _ in rows} == {"womd"}
    # 400 recordings: three standard deviations of a binomial share are 0.073 and 0.06.
    assert abs(len(logs["train"]) / 400 - 0.6) < 0.08 and abs(len(logs["test"]) / 400 - 0.2) < 0.07


def test_more_data_changes_no_split(tmp_path):
    (tmp_path / "few").mkdir()
    (tmp_path / "many").mkdir()
    write_splits(tmp_path / "few", entries(50), (80, 10, 10))
    write_splits(tmp_path / "many", entries(300)[::-1], (80, 10, 10))
    few, many = read(tmp_path / "few"), read(tmp_path / "many")
    assert all(set(few[name]) <= set(many[name]) for name in NAMES)


def test_same_name_in_another_data_set_is_another_recording():
    segments = [str(number) for number in range(200)]
    places = [[split_of(name, segment, (50, 0, 50)) for segment in segments] for name in ("womd", "av2")]
    assert places[0] != places[1]


@given(st.text(min_size=1), st.sampled_from([(100, 0, 0), (0, 100, 0), (0, 0, 100)]))
def test_a_share_of_everything_takes_everything(segment, shares):
    assert split_of("any", segment, shares) == NAMES[shares.index(100)]


def test_empty_splits_are_empty_files(tmp_path):
    assert write_splits(tmp_path, entries(20), (100, 0, 0)) == {"train": 60, "validation": 0, "test": 0}
    assert (tmp_path / "splits" / "test.txt").read_text() == ""
    assert sorted(path.name for path in (tmp_path / "splits").glob("*.txt")) == [
        "test.txt",
        "train.txt",
        "validation.txt",
    ]


def test_a_tenth_is_held_out_in_the_order_of_the_digests():
    """40 recordings of 3 windows: 12 scenarios are the share, so the first 4 recordings by SHA-256."""
    rows = entries(40)
    first = sorted(
        {row["segment"] for row in rows},
        key=lambda segment: hashlib.sha256(f"womd\0{segment}".encode()).digest(),
    )[:4]
    split = hold_out(rows)
    assert split.recordings == sorted(["womd", segment] for segment in first)
    assert split.validation == [i for i, row in enumerate(rows) if row["segment"] in first]
    assert split.training == [i for i, row in enumerate(rows) if row["segment"] not in first]
    assert split.text(108, 12).startswith(
        "trains on 108 scenarios, validates on 12 (held-out recordings: 4);"
    )
    assert split.note() == {"recordings": split.recordings, "scenarios": 12}
    assert hold_out(rows, split.recordings) == split, "recordings of run.json give the same split"
    same = hold_out(rows[::-1])
    assert same.recordings == split.recordings, "the order of scenarios does not matter"


@given(st.lists(st.integers(1, 400), min_size=2, max_size=12), st.integers(0, 99))
def test_no_recording_is_divided_and_both_sides_have_some(sizes, name):
    rows = [
        {"dataset": "d", "segment": f"{name}-{number}"}
        for number, size in enumerate(sizes)
        for _ in range(size)
    ]
    split = hold_out(rows)
    trained, validated = (
        {rows[index]["segment"] for index in indices} for indices in (split.training, split.validation)
    )
    assert trained and validated and not trained & validated
    assert trained | validated == {row["segment"] for row in rows}
    assert len(split.validation) <= 256
    held_out = len(rows) - len(split.training)
    assert held_out <= max(0.1 * len(rows), min(sizes))


def test_long_recording_is_validated_on_evenly_spaced_windows():
    rows = [{"dataset": "d", "segment": name} for name in "ab" for _ in range(600)]
    split = hold_out(rows)
    first = split.validation[0]
    assert first in (0, 600) and split.validation == list(range(first, first + 600, 3))
    assert len(split.training) == 600 and first not in split.training


def test_single_recording_is_trained_on():
    split = hold_out(entries(1))
    assert (split.recordings, split.training, split.validation) == ([], [0, 1, 2], [])
    assert split.note() is None
    assert split.text(108, 12).startswith(
        "no validation: all scenarios are of one recording; pass --validation SET"
    )
