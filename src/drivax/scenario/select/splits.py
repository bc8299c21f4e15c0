"""Training, validation and test splits by recording.

Windows of a recording overlap, so all scenarios of a segment belong to the same split. The split depends on the
percentages and on the names of data set and segment only; it does not change when data are added.
"""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivax.errors import UsageError
from drivax.files import write_text
from drivax.seal import seal

NAMES = ("train", "validation", "test")
#: Percentages of recordings for each of :data:`NAMES`.
Shares = tuple[float, float, float]
FOLDER = "splits"
#: Share of a training set to validate on, and the maximum number of scenarios, which bounds the time.
HELD_OUT_SHARE, MOST_HELD_OUT = 0.1, 256


def parse_shares(text: str) -> Shares:
    """Parse three percentages that add up to 100, such as ``80/10/10``."""
    try:
        train, validation, test = (float(part) for part in text.split("/"))
    except ValueError:
        train = validation = test = math.nan
    shares = train, validation, test
    if not all(share >= 0 for share in shares) or abs(sum(shares) - 100.0) > 1e-6:
        cure = "give percentages of train/validation/test that add up to 100: 80/10/10"
        raise UsageError(f"{text!r} is not a split", cure=cure)
    return shares


def split_of(dataset: str, segment: str, shares: Shares) -> str:
    """Return the split of a recording (one of :data:`NAMES`), by its :func:`_hash_fraction`."""
    fraction = _hash_fraction(dataset, segment)
    train, validation, test = shares
    # An empty split gets no recording, even if the percentages add up to slightly less than 100.
    if fraction * 100.0 < train or validation == test == 0:
        return NAMES[0]
    return NAMES[1] if fraction * 100.0 < train + validation or test == 0 else NAMES[2]


def _hash_fraction(dataset: str, segment: str) -> float:
    """Return the SHA-256 of a recording as a number in [0, 1)."""
    digest = hashlib.sha256(f"{dataset}\0{segment}".encode()).digest()
    return int.from_bytes(digest[:8], "big") / 2**64


@dataclass(frozen=True)
class HoldOut:
    """Recordings of a training set that are held out for validation.

    Attributes:
        recordings: Data sets and segments of the recordings; empty if the set is a single recording.
        training: Indices of the scenarios of all other recordings.
        validation: Indices of at most :data:`MOST_HELD_OUT` scenarios of the recordings, evenly spaced.
    """

    recordings: list[list[str]]
    training: list[int]
    validation: list[int]

    def note(self) -> dict[str, Any] | None:
        """Return the entry of ``run.json``."""
        return {"recordings": self.recordings, "scenarios": len(self.validation)} if self.recordings else None

    def text(self, training: int, validation: int) -> str:
        """Return a line for the log, given the numbers of scenarios after filters."""
        if not self.recordings:
            return "no validation: all scenarios are of one recording; pass --validation SET to validate"
        return (
            f"trains on {training} scenarios, validates on {validation} "
            f"(held-out recordings: {len(self.recordings)}); --validation none trains on all"
        )


def hold_out(
    entries: Sequence[Mapping[str, Any]], recordings: Sequence[Sequence[str]] | None = None
) -> HoldOut:
    """Hold out these recordings, or by default a share of the set (:data:`HELD_OUT_SHARE`)."""
    keys = [(entry["dataset"], entry["segment"]) for entry in entries]
    chosen = _choose(Counter(keys)) if recordings is None else {(name, log) for name, log in recordings}
    scenarios = [number for number, key in enumerate(keys) if key in chosen]
    training = [number for number, key in enumerate(keys) if key not in chosen]
    stride = max(-(-len(scenarios) // MOST_HELD_OUT), 1)
    return HoldOut(sorted(map(list, chosen)), training, scenarios[::stride])


def _choose(sizes: Mapping[tuple[str, str], int]) -> set[tuple[str, str]]:
    """Return the recordings that fit into the share, tried in the order of their hashes; the smallest if none fits."""
    if len(sizes) < 2:
        return set()
    order = sorted(sizes, key=lambda recording: _hash_fraction(*recording))
    room, chosen = min(HELD_OUT_SHARE * sum(sizes.values()), MOST_HELD_OUT), set()
    for recording in order:
        if sizes[recording] <= room:
            room -= sizes[recording]
            chosen.add(recording)
    return chosen or {min(order, key=lambda recording: sizes[recording])}


def write_splits(folder: Path, entries: Iterable[Mapping[str, Any]], shares: Shares) -> dict[str, int]:
    """Write ``splits/{train,validation,test}.txt`` and return the number of scenarios per split.

    Each file has one line ``dataset<TAB>scenario_id`` per scenario, in order.
    """
    lines: dict[str, list[str]] = {name: [] for name in NAMES}
    for entry in entries:
        split = split_of(entry["dataset"], entry["segment"], shares)
        lines[split].append(f"{entry['dataset']}\t{entry['scenario_id']}\n")
    for name, members in lines.items():
        write_text(folder / FOLDER / f"{name}.txt", "".join(members))
    seal(folder / FOLDER, *(f"{name}.txt" for name in lines))
    return {name: len(members) for name, members in lines.items()}
