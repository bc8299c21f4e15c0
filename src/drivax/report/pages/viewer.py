"""One HTML page in which the logs of a scenario set are browsed: a list, the player, and what is known of each.

The page is self-contained like the report and plays drives with the report's own player.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from drivax.errors import UsageError
from drivax.report.episodes import logged_drive
from drivax.report.pages.page import asset, page, publish, refuse_page
from drivax.report.pages.player import player_data, player_html, player_scripts
from drivax.report.pictures.episode import Drive, pack_episode
from drivax.scenario.schema import Scenario
from drivax.scenario.store import ScenarioSet

#: Findings of the audit that make a log unclean, and how the list says so.
_FINDINGS = {"log_collides": "collides", "log_runs_red": "runs red"}


def select(data: ScenarioSet, limit: int | None = None, ids: Sequence[str] = ()) -> list[Scenario]:
    """Scenarios to show: those named, in that order, or all; then the first ``limit``.

    Raises:
        UsageError: An id is not in the set, or ``limit`` leaves nothing.
    """
    if limit is not None and limit < 1:
        raise UsageError(f"a limit of {limit} leaves no scenario", cure="use 1 or more")
    known: dict[str, int] = {}
    for row, entry in enumerate(data.entries):
        known.setdefault(entry["scenario_id"], row)
    for name in ids:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            cure = f"did you mean {near[0]!r}?" if near else "list them with `drivax inspect SET --json`"
            raise UsageError("is not in the set", file=data.path, record=name, cure=cure)
    rows = [known[name] for name in ids] if ids else range(len(data))
    return [data[row] for row in rows[:limit]]


def write_player(
    scenarios: Sequence[Scenario],
    out: Path,
    overwrite: bool = False,
    title: str = "scenarios",
    beside: Sequence[str] = (),
) -> Path:
    """Writes the page.

    Args:
        scenarios: What to show; some tens of kB of page each.
        out: The HTML file; it appears when it is complete.
        overwrite: Replace an existing file.
        title: Heading of the page, as the name of the set.
        beside: HTML for each scenario that stands above its facts; nothing where it is empty.

    Returns:
        ``out``.

    Raises:
        UsageError: ``out`` exists or is a folder, or there is no scenario.
    """
    refuse_page(out, overwrite)
    if not scenarios:
        raise UsageError("there is no scenario to show", cure="name at least one")
    publish(out, _page(scenarios, title, beside or [""] * len(scenarios)))
    return out


def findings(scenario: Scenario) -> str:
    """What the audit found wrong with a log, in words; empty where nothing."""
    found = [words for name, words in _FINDINGS.items() if scenario.audit.get(name)]
    if (share := scenario.audit.get("log_offroad_fraction")) is not None and share > 0:
        found.append("off-road")
    return ", ".join(found)


def _page(scenarios: Sequence[Scenario], title: str, beside: Sequence[str]) -> str:
    packed = [pack_episode(scenario, [_log(scenario)], scenario.id) for scenario in scenarios]
    unclean = sum(bool(findings(scenario)) for scenario in scenarios)
    audited = sum(bool(scenario.audit) for scenario in scenarios)
    judged = f"the audit finds fault with {unclean} of {audited}" if audited else "not audited"
    return page(
        title,
        f"<p class=lead><b>{len(scenarios)}</b> recorded drives; {judged}.</p>",
        [_browser(scenarios, beside)],
        asset("browser.css"),
        player_data(packed),
        [*player_scripts(), asset("browser.js")],
    )


def _log(scenario: Scenario) -> Drive:
    """The recorded drive; the audit keeps the step of the first off-road step only."""
    offroad = scenario.audit.get("first_offroad_step")
    events = {"offroad": -1 if offroad is None else int(offroad)}
    return Drive("log", logged_drive(scenario), 0, events, findings(scenario))


def _browser(scenarios: Sequence[Scenario], beside: Sequence[str]) -> str:
    buttons = "".join(map(_button, scenarios))
    details = "".join(map(_details, scenarios, beside))
    return (
        "<section class=browse><div class=choose><input type=search id=filter placeholder='id, tag or flag' "
        "aria-label='show scenarios with these words'><small id=shown></small>"
        f"<div class=picker role=group aria-label=Scenarios>{buttons}</div></div>"
        f"<div class=watch><h2 data-control=title></h2>{player_html()}</div>"
        f"<aside id=details aria-label='about the scenario'>{details}</aside></section>"
    )


def _button(scenario: Scenario) -> str:
    found = findings(scenario)
    words = " ".join((scenario.id, found, *_flags(scenario), *scenario.tags, *scenario.tags.values())).lower()
    bad = f"<span class=bad>{escape(found)}</span>" if found else ""
    return (
        f'<button type=button data-episode aria-pressed=false data-words="{escape(words)}">'
        f"{escape(scenario.id)}<small>{escape(' · '.join(scenario.tags.values()))}</small>{bad}</button>"
    )


def _details(scenario: Scenario, beside: str) -> str:
    """What is to stand there; tags, flags, audit and what did not fit, as lists; shown while the scenario is."""
    source = scenario.source
    about = {
        "steps": int(scenario.steps),
        "tracks": source.tracks,
        "tracks now": source.tracks_valid_now,
        "map points": source.map_points,
        "lights": source.lights,
    }
    parts = (
        ("Tags", _facts(scenario.tags)),
        ("Flags", f"<p>{escape(', '.join(_flags(scenario)) or 'none')}</p>"),
        ("Audit", _facts(_audit(scenario)) if scenario.audit else "<p>not audited</p>"),
        ("Source", _facts(about)),
        ("Did not fit", _facts(scenario.overflow) if scenario.overflow else "<p>nothing</p>"),
    )
    return f"<div hidden>{beside}" + "".join(f"<h3>{name}</h3>{text}" for name, text in parts) + "</div>"


def _audit(scenario: Scenario) -> dict[str, Any]:
    """The audit; the step of a thing that never happened is stored as -1."""
    return {
        name: "never" if name.endswith("_step") and value == -1 else value
        for name, value in scenario.audit.items()
    }


def _facts(values: Mapping[str, Any]) -> str:
    rows = (
        f"<dt>{escape(_words(name))}</dt><dd>{escape(_cell(value))}</dd>" for name, value in values.items()
    )
    return f"<dl>{''.join(rows)}</dl>"


def _words(name: str) -> str:
    return name.replace("_", " ")


def _cell(value: Any) -> str:
    if value is None:
        return "undefined"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _flags(scenario: Scenario) -> list[str]:
    named: Iterable[Any] = scenario.has
    return [_words(str(flag.name)).lower() for flag in named]
