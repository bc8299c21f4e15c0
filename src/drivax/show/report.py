"""One self-contained HTML page from run folders: tables with intervals, drives side by side, learning curves."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Mapping, Sequence
from html import escape
from importlib import metadata, resources
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from jaxtyping import Float

from drivax.errors import DataError, UsageError
from drivax.evaluation.stored import comparable, open_driven_set
from drivax.scenario.schema import Scenario
from drivax.show.comparison import CONFIDENCE, metric_names, summarise
from drivax.show.curves import curve_sections
from drivax.show.episode import Drive, pack_episode
from drivax.show.glossary import headline, ordered
from drivax.show.palette import LEGEND, THEMES
from drivax.show.runs import Evaluation, Training, read_runs
from drivax.show.selection import Choice, choose, outcome
from drivax.show.tables import bounds, difference_table, explanations, number, percent, planner_table

EPISODES = 12
KEYS = (
    ("space", "play or pause"), ("← →", "one step"), ("Home End", "first and last step"), ("[ ]", "speed"),
    ("+ −", "zoom"), ("f", "follow or whole drive"), ("n p", "next and previous episode"),
)  # fmt: skip


def write_report(
    runs: Sequence[Path],
    out: Path,
    data: Path | None = None,
    episodes: int = EPISODES,
    overwrite: bool = False,
) -> Path:
    """Write a report of evaluation and training runs; the last evaluation is the policy in question.

    Args:
        runs: Run folders of ``drivax evaluate`` and ``drivax train``, in the order of the tables.
        out: The HTML file to write; it appears when it is complete.
        data: The scenario set that was driven, where it is not at the place that the policy's run names.
        episodes: How many episodes to show; 0 leaves them out and needs no scenario set.
        overwrite: Replace an existing file.

    Returns:
        ``out``.

    Raises:
        DataError: A run folder or the scenario set is missing, damaged, or not the one that was driven.
        UsageError: ``out`` exists, or the arguments make no sense.
    """
    refuse_page(out, overwrite)
    if episodes < 0:
        raise UsageError(f"cannot show {episodes} episodes", cure="give 0 or more")
    evaluations, trainings = read_runs(runs)
    packed = _packed_episodes(evaluations, data, episodes) if evaluations and episodes else []
    publish(out, _page(evaluations, trainings, packed))
    return out


def _packed_episodes(
    runs: Sequence[Evaluation], data: Path | None, count: int
) -> list[tuple[Choice, dict[str, Any]]]:
    """The chosen episodes with their data for the player."""
    choices = choose(runs, count)
    if not choices:
        return []
    scenarios = open_driven_set(runs[-1], data)
    rows = {(entry["dataset"], entry["scenario_id"]): row for row, entry in enumerate(scenarios.entries)}
    packed = []
    for choice in choices:
        row = rows.get((choice.dataset, choice.scenario_id))
        if row is None:
            raise DataError(
                "is not in the scenario set",
                file=scenarios.path,
                record=choice.scenario_id,
                cure="pass the set that was evaluated with --data SET",
            )
        scenario = scenarios[row]
        drives = [
            _drive(run, place, scenario)
            for run, place in zip(runs, choice.rows, strict=True)
            if place is not None
        ]
        packed.append((choice, pack_episode(scenario, drives, f"{choice.scenario_id}: {choice.outcome}")))
    return packed


def _drive(run: Evaluation, row: int, scenario: Scenario) -> Drive:
    stored = run.trajectories
    place = stored.rows[run.occurrences[row]]
    steps, start = int(scenario.steps), int(stored.start[place])
    ego = np.full((steps, 4), np.nan)
    ego[:start] = logged_drive(scenario)[:start]
    driven = stored.ego[place, : steps - start]
    ego[start : start + len(driven)] = driven
    events = {name: int(at[place]) for name, at in stored.events.items()}
    return Drive(run.name, ego, start, events, outcome(run, row))


def logged_drive(scenario: Scenario) -> Float[np.ndarray[Any, Any], "step 4"]:
    """The logged ego: position, heading, speed; NaN where it was not valid."""
    steps = int(scenario.steps)
    speed = np.linalg.norm(scenario.agent_velocity[:steps, 0], axis=-1)
    pose = np.column_stack((scenario.agent_xy[:steps, 0], scenario.agent_heading[:steps, 0], speed))
    return np.where(scenario.agent_valid[:steps, 0, None], pose, np.nan).astype(np.float64)


def _page(
    runs: Sequence[Evaluation],
    trainings: Sequence[Training],
    packed: Sequence[tuple[Choice, Mapping[str, Any]]],
) -> str:
    sections = []
    if runs:
        sections += [_results(runs), _differences(runs), _player(runs, packed)]
    if trainings:
        sections.append(f"<section><h2>Learning curves</h2>{curve_sections(trainings)}</section>")
    if runs:
        sections.append(_meaning(runs))
    sections.append(_origin([*runs, *trainings]))
    return Template(asset("report.html.template")).substitute(
        title=escape(f"{runs[-1].name}: evaluation report" if runs else "training report"),
        version=escape(metadata.version("drivax")),
        style=colours() + asset("player.css"),
        lead=_lead(runs),
        sections="\n".join(filter(None, sections)),
        data="\n".join(_data(packed)),
        script=asset("player.js") if packed else "",
    )


def _lead(runs: Sequence[Evaluation]) -> str:
    if not runs:
        return "<p class=lead>Training runs only; evaluate one to see how it drives.</p>"
    policy = runs[-1]
    path = Path(str(policy.data.get("path", "its scenario set")))
    where = escape(str(policy.data.get("name") or path.name))
    words = {"success": "succeeds in", "accuracy": "drives without failure in"}
    found = {name: summarise(policy, name) for name in words}
    name = next((name for name in words if found[name].mean is not None), None)
    if name is None:
        return f"<p class=lead><b>{escape(policy.name)}</b> drove {policy.episodes} episodes of {where}.</p>"
    interval = found[name]
    share = number(interval.mean, "rate") + percent("rate")
    return (
        f"<p class=lead><b>{escape(policy.name)}</b> {words[name]} <b>{share}</b> ({bounds(interval, 'rate')}) of "
        f"{interval.n} episodes of {where}, {escape(policy.traffic)} traffic.</p>"
    )


def _results(runs: Sequence[Evaluation]) -> str:
    names = metric_names(runs)
    first = headline(names)
    rest = [name for name in ordered(names) if name not in first]
    more = (
        f"<details><summary>{len(rest)} more metrics</summary>{planner_table(runs, rest)}</details>"
        if rest
        else ""
    )
    hashes = {run.data.get("hash") for run in runs}
    warning = (
        "<p><b>These runs drove different scenarios or traffic;</b> their rows are not comparable.</p>"
        if len(hashes) > 1 or len({run.traffic for run in runs}) > 1
        else ""
    )
    return (
        f"<section><h2>Results</h2>{warning}{planner_table(runs, first) if first else ''}{more}<p><small>"
        f"Mean, {CONFIDENCE:.0%} interval, and n, the number of episodes where the metric is defined; undefined "
        "episodes are left out. The best mean is underlined, whether or not it is clearly best. Intervals: Wilson's "
        "for rates (with the effective number of episodes where some share a recording), a bootstrap over recordings "
        "otherwise.</small></p></section>"
    )


def _differences(runs: Sequence[Evaluation]) -> str:
    policy, others = runs[-1], runs[:-1]
    names = headline(list(policy.metrics)) or ordered(list(policy.metrics))
    if not others or not names:
        return ""
    return (
        f"<section><h2>{escape(policy.name)} against the others</h2>{difference_table(policy, others, names)}<p><small>"
        "Mean of the differences, scenario by scenario, over those where both are defined (n pairs), with a "
        f"{CONFIDENCE:.0%} bootstrap interval over recordings. “Better” and “worse” are said where the interval leaves "
        "out zero; it is not widened for the number of comparisons. “All alike”: no "
        "pair differs from the next, so that a bootstrap cannot tell how sure the mean is.</small></p></section>"
    )


def _player(runs: Sequence[Evaluation], packed: Sequence[tuple[Choice, Mapping[str, Any]]]) -> str:
    if not packed:
        return ""
    buttons = "".join(
        f"<button type=button data-episode aria-pressed=false>"
        f'<span class="{"good" if choice.outcome == "success" else "bad"}">{escape(choice.outcome)}</span>'
        f"<small>{escape(choice.scenario_id)}</small></button>"
        for choice, _ in packed
    )
    legend = "".join(legend_item(name, words) for name, words in LEGEND)
    keys = " ".join(f"<kbd>{escape(key)}</kbd> {escape(words)}" for key, words in KEYS)
    reactive = any(run.traffic != "log" for run in runs if comparable(run, runs[-1]))
    caution = (
        "<p><b>Other agents are drawn as recorded;</b> in this traffic they reacted and moved otherwise.</p>"
        if reactive
        else ""
    )
    return (
        f"<section id=episodes><h2>Episodes</h2><p>Chosen by rule: failures of {escape(runs[-1].name)} first, "
        f"each kind in turn, then successes. All planners start from the same scene at the same time.</p>{caution}"
        f"<div class=picker role=group aria-label=Episodes>{buttons}</div><h3 data-control=title></h3>"
        f"<div id=stage></div>{CONTROLS}<ul class=legend>{legend}</ul><p><small>{keys}</small></p>"
        "<noscript><p>The drives need JavaScript, which this page carries with it.</p></noscript></section>"
    )


CONTROLS = """<div class=controls>
<button type=button data-control=back aria-label="one step back" title="one step back (←)">◂</button>
<button type=button data-control=play aria-label="play" title="play or pause (space)">▶</button>
<button type=button data-control=forward aria-label="one step on" title="one step on (→)">▸</button>
<div class=track><div class=ticks data-control=ticks></div>
<input type=range min=0 max=90 value=0 step=1 data-control=scrub aria-label="time"></div>
<span class=clock data-control=clock></span>
<select data-control=speed aria-label="speed" title="speed ([ and ])">
<option value=0.25>¼×</option><option value=0.5>½×</option><option value=1 selected>1×</option>
<option value=2>2×</option><option value=4>4×</option></select>
<button type=button data-control=follow aria-pressed=true title="follow the ego (f)">follow</button>
<button type=button data-control=fit aria-pressed=false title="show the whole drive (f)">whole</button>
<button type=button data-control=wider aria-label="zoom out" title="zoom out (−)">−</button>
<button type=button data-control=closer aria-label="zoom in" title="zoom in (+)">+</button>
</div>"""


def legend_item(name: str, words: str) -> str:
    """One entry of the legend."""
    sign = "✕" if name == "mark" else ""
    fill = "" if name in ("log", "route", "mark") else f' style="background:var(--{name})"'
    return f'<li><i class="k-{name}"{fill}>{sign}</i>{escape(words)}</li>'


def _meaning(runs: Sequence[Evaluation]) -> str:
    return (
        f"<section><h2>What the metrics mean</h2>{explanations(ordered(metric_names(runs)), runs)}</section>"
    )


def _origin(runs: Sequence[Evaluation | Training]) -> str:
    """Where the numbers come from: commands, data, versions and the whole of every ``run.json``."""
    rows = []
    for run in runs:
        about = run.about
        data = run.data if isinstance(run, Evaluation) else {}
        versions = about.get("versions")
        facts = {
            "command": _words(about.get("command")),
            "data": f"{data.get('path', '')} {str(data.get('hash') or '')[:12]}".strip(),
            "versions": ", ".join(f"{k} {v}" for k, v in versions.items())
            if isinstance(versions, dict)
            else "",
        }
        cells = "".join(f"<td>{escape(text) or '–'}</td>" for text in facts.values())
        rows.append(f"<tr><th scope=row>{escape(run.name)}</th>{cells}</tr>")
    whole = "".join(
        f"<h3>{escape(run.name)}</h3><pre>{escape(json.dumps(dict(run.about), indent=1, ensure_ascii=False))}</pre>"
        for run in runs
    )
    head = "<thead><tr><th>run</th><th>command</th><th>data</th><th>versions</th></tr></thead>"
    return (
        f"<section><h2>How this was made</h2><div class=scroll tabindex=0><table class=facts>{head}"
        f"<tbody>{''.join(rows)}</tbody></table></div><details><summary>all settings</summary>{whole}</details>"
        f"<p><small>drivax {escape(metadata.version('drivax'))}. Every number comes from the episodes.csv of its run."
        "</small></p></section>"
    )


def _words(command: Any) -> str:
    return " ".join(map(str, command)) if isinstance(command, list) else str(command or "")


def _data(packed: Sequence[tuple[Choice, Mapping[str, Any]]]) -> list[str]:
    if not packed:
        return []
    themes = {name: dict(theme) for name, theme in THEMES.items()}
    scripts = [f'<script type="application/json" id="palette">{embedded_json(themes)}</script>']
    return scripts + [
        f'<script type="application/json" class="episode">{embedded_json(data)}</script>'
        for _, data in packed
    ]


def embedded_json(value: Any) -> str:
    """JSON that cannot end the script element that holds it."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def colours() -> str:
    """The palette as CSS variables, light and dark."""
    light, dark = ("".join(f"--{key}:{value};" for key, value in THEMES[name].items() if key != "ink")
                   for name in ("light", "dark"))  # fmt: skip
    return f":root{{{light}}}\n@media (prefers-color-scheme: dark){{:root{{{dark}}}}}\n"


def asset(name: str) -> str:
    """Text of a file of this package."""
    return resources.files("drivax.show").joinpath(name).read_text(encoding="utf-8")


def refuse_page(out: Path, overwrite: bool) -> None:
    """Refuses a page that may not be written, before any work is done.

    Raises:
        UsageError: ``out`` is a folder, or exists and ``overwrite`` is not given.
    """
    if out.is_dir() or (out.exists() and not overwrite):
        cure = "name an HTML file" if out.is_dir() else "choose another name or pass --overwrite"
        raise UsageError("exists already", file=out, cure=cure)


def publish(out: Path, page: str) -> None:
    """Write beside the target, make it durable, then rename: never half a report under its name."""
    out.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{out.name}.", dir=out.parent)
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(page)
            file.flush()
            os.fsync(file.fileno())
        Path(name).chmod(0o644)
        Path(name).replace(out)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise
