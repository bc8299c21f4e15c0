"""Training, validation and test splits by recording.

Windows of a recording overlap, so all scenarios of a segment belong to the same split. The split depends on the name of
the segment only; it does not change when data are added.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from drivax.errors import UsageError
from drivax.files import write_text

NAMES = ("train", "validation", "test")
#: Percentages of recordings for each of :data:`NAMES`.
Shares = tuple[float, float, float]
FOLDER = "splits"


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
    """Return the split of a recording, by its SHA-256 as a number in [0, 1)."""
    digest = hashlib.sha256(f"{dataset}\0{segment}".encode()).digest()
    place = int.from_bytes(digest[:8], "big") / 2**64
    train, validation, test = shares
    # An empty split gets no recording, even if the percentages add up to slightly less than 100.
    if place * 100.0 < train or validation == test == 0:
        return NAMES[0]
    return NAMES[1] if place * 100.0 < train + validation or test == 0 else NAMES[2]


def write_splits(folder: Path, entries: Iterable[Mapping[str, Any]], shares: Shares) -> dict[str, int]:
    """Write ``splits/{train,validation,test}.txt`` and return the number of scenarios per split.

    Each has one line ``dataset<TAB>scenario_id`` per scenario, in order.
    """
    lines: dict[str, list[str]] = {name: [] for name in NAMES}
    for entry in entries:
        split = split_of(entry["dataset"], entry["segment"], shares)
        lines[split].append(f"{entry['dataset']}\t{entry['scenario_id']}\n")
    for name, members in lines.items():
        write_text(folder / FOLDER / f"{name}.txt", "".join(members))
    return {name: len(members) for name, members in lines.items()}
