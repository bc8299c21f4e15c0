"""The frame of every page: one HTML file that carries its styles, scripts and data."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from html import escape
from importlib import metadata, resources
from string import Template
from typing import Any

from drivax.report.pictures.palette import THEMES
from drivax.table import Cell, Column, Table


def page(
    title: str,
    lead: str,
    sections: Iterable[str],
    style: str = "",
    data: Iterable[str] = (),
    scripts: Iterable[str] = (),
) -> str:
    """Return a whole page.

    Args:
        title: Its heading, as plain text.
        lead: HTML below the heading.
        sections: HTML of its parts; empty ones are left out.
        style: CSS in addition to that of all pages.
        data: Script elements that hold data.
        scripts: Programs, in order.
    """
    return Template(asset("report.html.template")).substitute(
        title=escape(title),
        version=escape(metadata.version("drivax")),
        style=_colours() + asset("player.css") + style,
        lead=lead,
        sections="\n".join(filter(None, sections)),
        data="\n".join(data),
        script="\n".join(scripts),
    )


def data_element(value: Any, **attributes: str) -> str:
    """Return a script element that holds JSON, with every ``<`` escaped."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    named = "".join(f' {name}="{escape(words)}"' for name, words in attributes.items())
    return f'<script type="application/json"{named}>{text}</script>'


def facts_html(headings: Sequence[str], rows: Iterable[tuple[str, Sequence[str]]]) -> str:
    """Return a table of texts: a label and the facts about it in each row."""
    columns = tuple(Column(heading, label=not place) for place, heading in enumerate(headings))
    return Table("facts", columns, tuple((Cell(label), *map(Cell, facts)) for label, facts in rows)).html()


def asset(name: str) -> str:
    """Return the text of a file in ``assets``."""
    return resources.files("drivax.report.pages").joinpath("assets", name).read_text(encoding="utf-8")


def _colours() -> str:
    """Return the palette as CSS variables, light and dark."""
    light, dark = ("".join(f"--{key}:{value};" for key, value in THEMES[name].items() if key != "ink")
                   for name in ("light", "dark"))  # fmt: skip
    return f":root{{{light}}}\n@media (prefers-color-scheme: dark){{:root{{{dark}}}}}\n"
