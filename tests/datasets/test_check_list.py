"""Every item of the check-list for converters has a test that names it."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ITEMS = {
    1: "wrap headings",
    2: "subtract the origin in float64",
    3: "median box sizes, class defaults flagged",
    4: "invalid data stay masked and zero",
    5: "split edges at gaps of clipped maps",
    6: "drop polylines of fewer than two points",
    7: "drivable side of edges on the left, flag of closed rings",
    8: "simplify to 5 cm, at most 4 m",
    9: "crop to the ego's box and 100 m, keep lanes of routes",
    10: "lights by lane, -1 unobserved, yellow mapped",
    11: "dense lane indices, dangling links",
    12: "units of speed limits",
    13: "direction of neighbours",
    14: "nuScenes: heading in the place of the height",
    15: "nuPlan: rear axle to centre, velocity in the ego's frame",
    16: "20 and 2 Hz to 10 Hz, nothing made up over gaps",
    17: "velocities that were zeroed",
    18: "no unpickling, limits of sizes",
    19: "ego first, rows and ids of marks",
    20: "test splits of 11 steps",
    21: "overflow counters",
    22: "ids of lanes never through float32",
    23: "jitter of time stamps",
    24: "no lane graph: chained by geometry, flagged",
}
_IN_TEXT = re.compile(r"(?:check-list|items?)\s+(\d+)", re.IGNORECASE)
_IN_NAME = re.compile(r"(?:^test|_and|_item|_list)_0?(\d{1,2})(?=_)")


def numbers(test: ast.FunctionDef) -> set[int]:
    """The items that a test names, in its name or in its docstring."""
    named = _IN_NAME.findall(test.name) + _IN_TEXT.findall(ast.get_docstring(test) or "")
    return {int(number) for number in named}


def all_tests() -> list[ast.FunctionDef]:
    root = Path(__file__).resolve().parent.parent
    trees = [
        ast.parse(path.read_text())
        for room in ("datasets", "scenario", "real")
        for path in sorted((root / room).glob("test_*.py"))
    ]
    return [
        node
        for tree in trees
        for node in tree.body
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
    ]


@pytest.fixture(scope="module")
def named() -> set[int]:
    return set().union(*map(numbers, all_tests()))


@pytest.mark.parametrize("item", ITEMS)
def test_every_item_is_named_by_a_test(item, named):
    assert item in named, f"no test names item {item}: {ITEMS[item]}"
