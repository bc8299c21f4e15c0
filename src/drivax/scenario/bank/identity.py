"""Who a scenario is, as a number that chance follows from: the same in whatever set, order or batch it is driven."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterable

import numpy as np
from jaxtyping import UInt32


def identities(names: Iterable[tuple[str, str]]) -> UInt32[np.ndarray, " n"]:
    """A number for each scenario.

    It is the first four bytes of BLAKE2b over data set, id and how many of the same name came before, so that copies
    of a scenario differ. Two scenarios that share a number by chance share nothing but their random numbers.

    Args:
        names: Data set and id of each.
    """
    seen: Counter[tuple[str, str]] = Counter()
    numbers = []
    for name in names:
        text = "\0".join((*name, str(seen[name])))
        numbers.append(int.from_bytes(hashlib.blake2b(text.encode(), digest_size=4).digest(), "little"))
        seen[name] += 1
    return np.array(numbers, np.uint32)
