"""Tables of the measurements of ``targets.py``: all for the terminal, targets in Markdown for the guide."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from drivax.synthetic.expert.violations import EGO_SKIN_M
from experiments.repository import DOCS

GUIDE = DOCS / "guide" / "world.md"
#: Lines of the guide around the table of targets.
BEGIN, END = "<!-- targets: python -m experiments.world.targets --table -->\n", "<!-- end of targets -->\n"

Result = dict[str, Any]


@dataclass(frozen=True)
class Target:
    """A target value of the world.

    Attributes:
        what: Text of the quantity.
        words: Text of the target.
        value: Reads the number from a result; a share comes with its interval, as a dictionary.
        met: Returns whether a number is on target.
    """

    what: str
    words: str
    value: Callable[[Result], Any]
    met: Callable[[float], bool]


def _success(planner: str, stratum: str) -> Callable[[Result], Any]:
    return lambda result: result["difficulty"][planner][stratum]


def _count_outside(result: Result) -> int:
    return sum(share["outside"] for _, share in configured_shares(result))


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
    Target("families, events, rate outside their intervals", "0", _count_outside, lambda x: x == 0),
    Target(
        "scenarios per second, 2 workers",
        "at least 15",
        lambda r: r["speed"]["scenarios_per_second"],
        lambda x: x >= 15.0,
    ),
)


def configured_shares(result: Result) -> list[tuple[str, Result]]:
    """Return every share that has a configured value, with its name."""
    coverage = result["coverage"]
    return [
        ("rare events", coverage["rare_rate"]),
        *(coverage["families"].items()),
        *((f"event {name}", share) for name, share in coverage["events"].items()),
    ]


def text(share: Result, digits: int = 4) -> str:
    """Format a share with its interval and the number of trials."""
    return (
        f"{share['share']:.{digits}f} [{share['low']:.{digits}f}, {share['high']:.{digits}f}] of {share['n']}"
    )


def lines(result: Result) -> list[tuple[str, str]]:
    """Return names and values of a result."""
    pairs = [(f"expert {name}", text(share)) for name, share in result["expert"].items()]
    pairs.append(("expert comfortable, common (0.95)", text(result["expert_comfortable_common"])))
    pairs += [(f"  within {name}", text(share)) for name, share in result["within_limits_common"].items()]
    pairs.append(("background overlaps (0.005)", text(result["background_overlap"])))
    pairs.append(("critical, of the common", text(result["critical"])))
    margin = f"the expert was checked without noise, with a margin of {EGO_SKIN_M:.2f} m"
    noise_text = f"{result['largest_noise_m']:.3f} m; {margin}"
    pairs.append(("noise moves a corner at most", noise_text))
    for name, share in result["difficulty"].items():
        ratio = share["failure_ratio"]
        pairs += [
            (f"{name} success, {stratum}", text(share[stratum])) for stratum in ("all", "common", "rare")
        ]
        pairs.append(("  failures, rare over common", "" if ratio is None else f"{ratio:.2f}"))
    near = result["near_at_constant_speed"]
    pairs += [
        (f"rare, within 1 s at constant speed (0.8): {name}", text(share)) for name, share in near.items()
    ]
    severity = result["severity_mps2"]
    pairs += [(f"severity {name} m/s2", text(share)) for name, share in severity["thirds"].items()]
    pairs += [(f"  median of {name}", f"{value:.1f}") for name, value in severity["medians"].items()]
    return [*pairs, *_coverage(result), *_generation(result)]


def _coverage(result: Result) -> list[tuple[str, str]]:
    shares = configured_shares(result)
    pairs = []
    for name, share in shares:
        mark = (
            "  OUTSIDE"
            if share["outside"]
            else "  (outside its 95 % interval)"
            if share["outside_95"]
            else ""
        )
        pairs.append((f"{name} (configured {share['configured']:.3f})", text(share) + mark))
    count = f"{sum(share['outside_95'] for _, share in shares)} of {len(shares)}; expected by chance"
    pairs.append(("outside their 95 % intervals", f"{count} {0.05 * len(shares):.1f}"))
    pairs.append(("outside Bonferroni's intervals", f"{_count_outside(result)} of {len(shares)}"))
    for event, families in result["coverage"]["family_by_event"].items():
        pairs.append((f"  families of {event}", ", ".join(f"{k} {v}" for k, v in sorted(families.items()))))
    return pairs


def _generation(result: Result) -> list[tuple[str, str]]:
    pairs = []
    for name, generation in result["generation"].items():
        for family, count in generation["families"].items():
            causes = ", ".join(f"{k} {v}" for k, v in sorted(count["causes"].items()))
            rejections = f"{count['rejection_rate']:.3f} ({causes}); {count['unsuited']} without the event"
            pairs.append((f"{name}: {family} rejected", rejections))
    return pairs


def markdown(results: dict[str, Result]) -> str:
    """Return a table with targets in rows and domains in columns; missed targets are bold."""
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


def write_guide(results: dict[str, Result]) -> str:
    """Write the table of targets to the guide and return it."""
    table, page = markdown(results), GUIDE.read_text()
    before, rest = page.split(BEGIN)
    _, after = rest.split(END)
    GUIDE.write_text(f"{before}{BEGIN}\n{table}\n{END}{after}")
    return table
