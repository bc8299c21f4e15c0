"""One HTML page to browse the logs of a scenario set: a list, the player, and the facts of each scenario."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from drivax.curation.scores import ScoreTable
from drivax.errors import UsageError, did_you_mean
from drivax.files import check_output, write_text
from drivax.report.charts import chart, series_legend
from drivax.report.episodes import logged_motion
from drivax.report.pages.page import asset, page, player_data, player_html, player_scripts
from drivax.report.pictures.drawing import Rollout
from drivax.report.pictures.palette import stroke
from drivax.report.pictures.player_data import pack_episode
from drivax.scenario.schema import DT_S, Scenario
from drivax.scenario.store import ScenarioSet

#: Findings of the audit that are violations, and their text in the list.
_FINDINGS = {"log_collides": "collides", "log_runs_red": "runs red", "log_reverses": "drives backwards"}


def select_rows(
    data: ScenarioSet, limit: int | None = None, ids: Sequence[str] = (), order: Sequence[int] | None = None
) -> list[int]:
    """Return at most ``limit`` rows of a set: those of ``ids``, else the first of ``order`` (default: all, as stored).

    Of scenarios of several data sets with the same id, the first counts.

    Raises:
        UsageError: An id is not in the set, or ``limit`` leaves nothing.
    """
    if limit is not None and limit < 1:
        raise UsageError(f"a limit of {limit} leaves no scenario", cure="use 1 or more")
    row_of: dict[str, int] = {}
    for row, entry in enumerate(data.entries):
        row_of.setdefault(entry["scenario_id"], row)
    for name in ids:
        if name not in row_of:
            cure = did_you_mean(name, row_of, otherwise="list them with `drivax inspect SET --json`")
            raise UsageError("is not in the set", file=data.path, record=name, cure=cure)
    rows = [row_of[name] for name in ids] if ids else list(range(len(data)) if order is None else order)
    return rows[:limit]


def write_player(
    scenarios: Sequence[Scenario], out: Path, overwrite: bool = False, title: str = "scenarios",
    details: Sequence[str] = (),
) -> Path:  # fmt: skip
    """Write a page of logs (some tens of kB each) to the HTML file ``out``.

    ``details`` has HTML for each scenario, or none at all, shown above its facts.

    Raises:
        UsageError: ``out`` exists without ``overwrite`` or is a folder, or there is no scenario.
    """
    check_output(out, overwrite)
    if not scenarios:
        raise UsageError("no scenarios to show", cure="name at least one")
    episodes = [pack_episode(scenario, [_log(scenario)], scenario.id) for scenario in scenarios]
    violation_count = sum(bool(findings(scenario)) for scenario in scenarios)
    audit_count = sum(bool(scenario.audit) for scenario in scenarios)
    audit = (
        f"the audit finds violations in {violation_count} of {audit_count}" if audit_count else "not audited"
    )
    lead = f"<p class=lead><b>{len(scenarios)}</b> recorded scenarios; {audit}.</p>"
    browser = _browser(scenarios, details or [""] * len(scenarios))
    scripts = [*player_scripts(), asset("browser.js")]
    write_text(out, page(title, lead, [browser], asset("browser.css"), player_data(episodes), scripts))
    return out


def findings(scenario: Scenario) -> str:
    """Return the violations that the audit found in a log, as text; empty without any."""
    texts = [text for name, text in _FINDINGS.items() if scenario.audit.get(name)]
    if (scenario.audit.get("log_offroad_fraction") or 0.0) > 0.0:
        texts.append("off-road")
    return ", ".join(texts)


def criticality_html(table: ScoreTable, row: int) -> str:
    """Return a chart of a scenario's criticality and its components over time, with the scenario's score.

    The chart is about the recorded ego.
    """
    log = row * table.egos
    valid = table.valid[log]
    time = np.flatnonzero(valid) * DT_S
    series = {"score": table.steps[log]} | {name: scores[log] for name, scores in table.components.items()}
    lines = {
        name.replace("_", " "): (stroke(index), np.column_stack([time, scores[valid]]))
        for index, (name, scores) in enumerate(series.items())
    }
    rank = int(np.flatnonzero(table.order == row)[0]) + 1
    summary = f"score {table.scenarios[row]:.3f}, rank {rank:,} of {len(table.scenarios):,} by {table.method}"
    return (
        f"<h3>Criticality</h3><p>{escape(summary)}</p>"
        f"{chart('criticality over time', lines, share=True, x_label='s')}{series_legend(list(lines))}"
    )


def _log(scenario: Scenario) -> Rollout:
    """Return the log as a rollout, with the first collision and off-road step that the audit found."""
    steps = {name: scenario.audit.get(f"first_{name}_step") for name in ("collision", "offroad")}
    events = {name: -1 if step is None else int(step) for name, step in steps.items()}
    return Rollout("log", logged_motion(scenario), 0, events, findings(scenario))


def _browser(scenarios: Sequence[Scenario], details: Sequence[str]) -> str:
    buttons = "".join(map(_button, scenarios))
    facts = "".join(_details(*pair) for pair in zip(scenarios, details, strict=True))
    return (
        "<section class=browse><div class=choose><input type=search id=filter placeholder='id, tag or flag' "
        "aria-label='show scenarios with these words'><small id=shown></small>"
        f"<div class=picker role=group aria-label=Scenarios>{buttons}</div></div>"
        f"<div class=watch><h2 data-control=title></h2>{player_html()}</div>"
        f"<aside id=details aria-label='facts of the scenario'>{facts}</aside></section>"
    )


def _button(scenario: Scenario) -> str:
    violations = findings(scenario)
    search_text = (scenario.id, violations, *_flags(scenario), *scenario.tags, *scenario.tags.values())
    violations_html = f"<span class=bad>{escape(violations)}</span>" if violations else ""
    return (
        f'<button type=button data-episode aria-pressed=false data-words="{escape(" ".join(search_text).lower())}">'
        f"{escape(scenario.id)}<small>{escape(' · '.join(scenario.tags.values()))}</small>{violations_html}</button>"
    )


def _details(scenario: Scenario, extra: str) -> str:
    """Return the ``extra`` HTML, tags, flags, audit, counts and overflow; visible while the scenario is selected."""
    source = scenario.source
    counts = {
        "steps": int(scenario.steps), "tracks": source.tracks, "tracks now": source.tracks_valid_now,
        "map points": source.map_points, "lights": source.lights,
    }  # fmt: skip
    # A step is None if its event never happened, or needs a map that is missing.
    audit = {
        name: "none" if name.endswith("_step") and value is None else value
        for name, value in scenario.audit.items()
    }
    sections = (
        ("Tags", _facts(scenario.tags)),
        ("Flags", f"<p>{escape(', '.join(_flags(scenario)) or 'none')}</p>"),
        ("Audit", _facts(audit) if audit else "<p>not audited</p>"),
        ("Source", _facts(counts)),
        ("Did not fit", _facts(scenario.overflow) if scenario.overflow else "<p>nothing</p>"),
    )
    sections_html = "".join(f"<h3>{name}</h3>{text}" for name, text in sections)
    return f"<div hidden>{extra}{sections_html}</div>"


def _facts(values: Mapping[str, Any]) -> str:
    items = ((escape(name.replace("_", " ")), escape(_text(value))) for name, value in values.items())
    return f"<dl>{''.join(f'<dt>{name}</dt><dd>{text}</dd>' for name, text in items)}</dl>"


def _text(value: Any) -> str:
    if value is None:
        return "undefined"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _flags(scenario: Scenario) -> list[str]:
    flags: Iterable[Any] = scenario.has
    return [str(flag.name).replace("_", " ").lower() for flag in flags]
