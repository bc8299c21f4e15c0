"""Tables of the measurements of ``targets.py``: all for the terminal, targets in Markdown for the guide."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from drivax.synthetic.expert.violations import EGO_SKIN_M
from experiments.repository import DOCS

GUIDE = DOCS / "guide" / "world.md"
#: The table of targets stands between these lines of the guide.
BEGIN, END = "<!-- targets: python -m experiments.world.targets --table -->\n", "<!-- end of targets -->\n"

Result = dict[str, Any]


@dataclass(frozen=True)
class Target:
    """A target value of the world.

    Attributes:
        what: In words.
        words: The target in words.
        value: The number in a result; a share comes with its interval, as a dictionary.
        met: Whether a number is on target.
    """

    what: str
    words: str
    value: Callable[[Result], Any]
    met: Callable[[float], bool]


def _success(planner: str, where: str) -> Callable[[Result], Any]:
    return lambda result: result["difficulty"][planner][where]


def _outside(result: Result) -> int:
    return sum(one["outside"] for _, one in covered(result))


TARGETS = (
    Target("expert: `accuracy`", "1", lambda r: r["expert"]["accuracy"], lambda x: x == 1.0),
    Target(
        "expert: `comfortable`, common scenarios",
        "at least 0.95",
        lambda r: r["expert_comfortable_common"],
        lambda x: x >= 0.95,
    ),
    Target(
        "scenarios in which two background vehicles overlap",
        "at most 0.005",
        lambda r: r["background_overlap"],
        lambda x: x <= 0.005,
    ),
    Target(
        "`constant_velocity`: `success`",
        "below 0.45",
        _success("constant_velocity", "all"),
        lambda x: x < 0.45,
    ),
    Target("`random`: `success`", "below 0.15", _success("random", "all"), lambda x: x < 0.15),
    Target("`idm`: `success`", "0.60 to 0.80", _success("idm", "all"), lambda x: 0.6 <= x <= 0.8),
    Target(
        "`idm`: failures in rare over common scenarios",
        "at least 3",
        lambda r: r["difficulty"]["idm"]["failure_ratio"] or math.inf,
        lambda x: x >= 3.0,
    ),
    Target(
        "`search`: `success`, common scenarios",
        "at least 0.95",
        _success("search", "common"),
        lambda x: x >= 0.95,
    ),
    Target(
        "`search`: `success`, rare scenarios", "at least 0.5", _success("search", "rare"), lambda x: x >= 0.5
    ),
    Target(
        "rare: at constant speed within 1 s of the actor",
        "at least 0.8",
        lambda r: r["near_at_constant_speed"]["all"],
        lambda x: x >= 0.8,
    ),
    Target("families, events, rate outside their intervals", "0", _outside, lambda x: x == 0),
    Target(
        "scenarios per second, 2 workers",
        "at least 15",
        lambda r: r["speed"]["scenarios_per_second"],
        lambda x: x >= 15.0,
    ),
)


def covered(result: Result) -> list[tuple[str, Result]]:
    """Return every share that has a configured value, with its name."""
    cover = result["coverage"]
    return [
        ("rare events", cover["rare_rate"]),
        *(cover["families"].items()),
        *((f"event {name}", one) for name, one in cover["events"].items()),
    ]


def text(one: Result, digits: int = 4) -> str:
    """Format a share with its interval and the number of trials."""
    return f"{one['share']:.{digits}f} [{one['low']:.{digits}f}, {one['high']:.{digits}f}] of {one['n']}"


def lines(result: Result) -> list[tuple[str, str]]:
    """Names and values of a result."""
    found = [(f"expert {name}", text(one)) for name, one in result["expert"].items()]
    found.append(("expert comfortable, common (0.95)", text(result["expert_comfortable_common"])))
    found += [(f"  within {name}", text(one)) for name, one in result["within_limits_common"].items()]
    found.append(("background overlaps (0.005)", text(result["background_overlap"])))
    found.append(("critical, of the common", text(result["critical"])))
    room = (
        f"{result['largest_noise_m']:.3f} m; ego was judged with {EGO_SKIN_M:.2f} m to spare, without noise"
    )
    found.append(("noise moves a corner at most", room))
    for name, one in result["difficulty"].items():
        ratio = one["failure_ratio"]
        found += [(f"{name} success, {where}", text(one[where])) for where in ("all", "common", "rare")]
        found.append(("  failures, rare over common", "" if ratio is None else f"{ratio:.2f}"))
    near = result["near_at_constant_speed"]
    found += [(f"rare, within 1 s at constant speed (0.8): {name}", text(one)) for name, one in near.items()]
    severity = result["severity_mps2"]
    found += [(f"severity {name} m/s2", text(one)) for name, one in severity["thirds"].items()]
    found += [(f"  median of {name}", f"{value:.1f}") for name, value in severity["medians"].items()]
    return [*found, *_coverage(result), *_generation(result)]


def _coverage(result: Result) -> list[tuple[str, str]]:
    shares = covered(result)
    found = []
    for name, one in shares:
        mark = "  OUTSIDE" if one["outside"] else "  (outside its 95 % interval)" if one["outside_95"] else ""
        found.append((f"{name} (configured {one['configured']:.3f})", text(one) + mark))
    count = f"{sum(one['outside_95'] for _, one in shares)} of {len(shares)}; expected by chance"
    found.append(("outside their 95 % intervals", f"{count} {0.05 * len(shares):.1f}"))
    found.append(("outside Bonferroni's intervals", f"{_outside(result)} of {len(shares)}"))
    for event, families in result["coverage"]["family_by_event"].items():
        found.append((f"  families of {event}", ", ".join(f"{k} {v}" for k, v in sorted(families.items()))))
    return found


def _generation(result: Result) -> list[tuple[str, str]]:
    found = []
    for name, made in result["generation"].items():
        for family, one in made["families"].items():
            causes = ", ".join(f"{k} {v}" for k, v in sorted(one["causes"].items()))
            rejected = f"{one['rejection_rate']:.3f} ({causes}); {one['unsuited']} without occasion"
            found.append((f"{name}: {family} rejected", rejected))
    return found


def markdown(results: dict[str, Result]) -> str:
    """Table with targets in rows and domains in columns; missed targets are bold."""
    head = "".join(
        f" {name}: {result['scenarios']:,} + {result['rare_scenarios']:,} rare |"
        for name, result in results.items()
    )
    rows = [f"| what | target |{head}", "|---|---|" + "---|" * len(results)]
    for target in TARGETS:
        cells = []
        for result in results.values():
            value = target.value(result)
            number = value["share"] if isinstance(value, dict) else value
            if isinstance(value, dict):
                cell = f"{number:.3f} [{value['low']:.3f}, {value['high']:.3f}]"
            else:
                cell = str(number) if isinstance(number, int) else f"{number:.1f}"
            cells.append(cell if target.met(number) else f"**{cell}**")
        rows.append(f"| {target.what} | {target.words} | {' | '.join(cells)} |")
    return "\n".join(rows) + "\n"


def into_guide(results: dict[str, Result]) -> str:
    """Write the table of targets to the guide and return it."""
    table, page = markdown(results), GUIDE.read_text()
    before, rest = page.split(BEGIN)
    _, after = rest.split(END)
    GUIDE.write_text(f"{before}{BEGIN}\n{table}\n{END}{after}")
    return table
