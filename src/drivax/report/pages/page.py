"""The frame of every page, one HTML file with its styles, scripts and data, and the player as HTML."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib import metadata, resources
from string import Template
from typing import Any

from drivax.report.charts import COMMANDS, SIGNALS
from drivax.report.pictures.drawing import EVENT_WORDS, GOAL_M, LIGHTS, STOP_M, WIDTHS
from drivax.report.pictures.palette import LEGEND, STROKES, THEMES
from drivax.seal import edited_files
from drivax.table import Cell, Column, Table

KEYS = (
    ("space", "play or pause"), ("← →", "one step"), ("Home End", "first and last step"), ("[ ]", "speed"),
    ("+ −", "zoom"), ("f", "follow or whole episode"), ("n p", "next and previous episode"),
)  # fmt: skip


def page(
    title: str, lead: str, sections: Iterable[str], style: str = "", data: Iterable[str] = (),
    scripts: Iterable[str] = (),
) -> str:  # fmt: skip
    """Return a page as HTML.

    Args:
        title: Title, plain text.
        lead: HTML below the title.
        sections: HTML of the sections; empty ones are skipped.
        style: CSS in addition to the player's.
        data: Script elements that hold data.
        scripts: Programs in order.
    """
    return Template(asset("report.html.template")).substitute(
        title=escape(title),
        version=escape(metadata.version("drivax")),
        style=_colours() + asset("player.css") + style,
        lead=lead + _edited_html(),
        sections="\n".join(filter(None, sections)),
        data="\n".join(data),
        script="\n".join(scripts),
    )


def _edited_html() -> str:
    """Return the warning of a page that is made with edited files, or "" without any."""
    warning, files = "Made with files that were edited after drivax wrote them:", edited_files()
    return f"<p><b>{warning}</b> {', '.join(map(escape, files))}.</p>" if files else ""


def section(title: str, *parts: str, note: str = "", attributes: str = "") -> str:
    """Return a section of HTML: title, parts, and a note below; "" if all parts are empty."""
    if not any(parts):
        return ""
    note_html = f"<p><small>{note}</small></p>" if note else ""
    return f"<section{attributes}><h2>{title}</h2>{''.join(parts)}{note_html}</section>"


def data_element(value: Any, **attributes: str) -> str:
    """Return a script element that holds JSON; every ``<`` is escaped, so that no text ends the element."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    attributes_text = "".join(f' {name}="{escape(content)}"' for name, content in attributes.items())
    return f'<script type="application/json"{attributes_text}>{text}</script>'


def facts_html(headings: Sequence[str], rows: Iterable[tuple[str, Sequence[str]]]) -> str:
    """Return an HTML table with a label and its facts in each row."""
    columns = tuple(Column(heading, label=index == 0) for index, heading in enumerate(headings))
    return Table("facts", columns, tuple((Cell(label), *map(Cell, facts)) for label, facts in rows)).html()


def definitions(items: Iterable[tuple[str, str]]) -> str:
    """Return a list of terms with their explanations."""
    rows = (f"<div><dt>{escape(term)}</dt><dd>{escape(text)}</dd></div>" for term, text in items)
    return f"<dl class=metrics>{''.join(rows)}</dl>"


def asset(name: str) -> str:
    """Return the text of a file in ``assets``."""
    return resources.files("drivax.report.pages").joinpath("assets", name).read_text(encoding="utf-8")


def _colours() -> str:
    """Return the palette as CSS variables, light and dark, without ``ink``, which ``player.css`` defines."""
    light, dark = (
        "".join(f"--{key}:{value};" for key, value in THEMES[name].items() if key != "ink")
        for name in ("light", "dark")
    )
    return f":root{{{light}}}\n@media (prefers-color-scheme: dark){{:root{{{dark}}}}}\n"


def player_html() -> str:
    """Return the player: stage, controls, legend, keys and plots."""
    legend = ""
    for name, words in LEGEND:
        fill = "" if name in ("log", "route", "mark", "goal") else f' style="background:var(--{name})"'
        legend += f'<li><i class="k-{name}"{fill}>{"✕" if name == "mark" else ""}</i>{escape(words)}</li>'
    controls = asset("controls.html").rstrip()
    keys = " ".join(f"<kbd>{escape(key)}</kbd> {escape(words)}" for key, words in KEYS)
    return (
        f"<div id=stage></div>{controls}<ul class=legend>{legend}</ul><p><small>{keys}</small></p>"
        "<noscript><p>The player needs JavaScript; its code is part of this page.</p></noscript>"
        "<h3>Motion and commands</h3><div id=plots class=charts></div><p><small>From the stored motion, with the "
        "filters of the comfort metrics; dashed lines are nuPlan's limits, crosses the first failures. Commands are "
        "the executed ones: acceleration (or metres ahead) and steering (or metres to the left), as shares of the "
        "maximum of the action space; of trajectories in m/s² and rad, of direct states x and y, cut at 32 m."
        "</small></p>"
    )


def player_data(episodes: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return script elements with styles, signals and packed episodes (``report.pictures.player_data``)."""
    style = {
        "themes": {name: dict(theme) for name, theme in THEMES.items()},
        "widths": dict(WIDTHS),
        "radii": {"stop": STOP_M, "goal": GOAL_M},
        "lights": LIGHTS,
        "events": dict(EVENT_WORDS),
        "signals": [
            {"words": signal.title, "unit": signal.unit, "step": signal.step, "limits": signal.limits}
            for signal in (*SIGNALS, *COMMANDS)
        ],
        "strokes": [[stroke.colour, stroke.dash, stroke.key] for stroke in STROKES],
    }
    packed = (data_element(episode, **{"class": "episode"}) for episode in episodes)
    return [data_element(style, id="style"), *packed]


def player_scripts() -> list[str]:
    """Return the programs of plots and player; plots come first because they listen to the player."""
    return [asset("plots.js"), asset("player.js")]
