"""The frame of every page: one HTML file that carries its styles, scripts and data, written whole or not at all."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterable
from html import escape
from importlib import metadata, resources
from pathlib import Path
from string import Template
from typing import Any

from drivax.errors import UsageError
from drivax.report.pictures.palette import THEMES


def page(
    title: str,
    lead: str,
    sections: Iterable[str],
    style: str = "",
    data: Iterable[str] = (),
    scripts: Iterable[str] = (),
) -> str:
    """A whole page.

    Args:
        title: Its heading, as plain text.
        lead: HTML below the heading.
        sections: HTML of its parts; empty ones are left out.
        style: CSS beside that of all pages.
        data: Script elements that hold data.
        scripts: Programs, in order.
    """
    return Template(asset("report.html.template")).substitute(
        title=escape(title),
        version=escape(metadata.version("drivax")),
        style=colours() + asset("player.css") + style,
        lead=lead,
        sections="\n".join(filter(None, sections)),
        data="\n".join(data),
        script="\n".join(scripts),
    )


def data_element(value: Any, **attributes: str) -> str:
    """A script element that holds JSON and cannot be ended by it."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    named = "".join(f' {name}="{escape(words)}"' for name, words in attributes.items())
    return f'<script type="application/json"{named}>{text}</script>'


def colours() -> str:
    """The palette as CSS variables, light and dark."""
    light, dark = ("".join(f"--{key}:{value};" for key, value in THEMES[name].items() if key != "ink")
                   for name in ("light", "dark"))  # fmt: skip
    return f":root{{{light}}}\n@media (prefers-color-scheme: dark){{:root{{{dark}}}}}\n"


def asset(name: str) -> str:
    """Return the text of a file in ``assets``."""
    return resources.files("drivax.report.pages").joinpath("assets", name).read_text(encoding="utf-8")


def refuse_page(out: Path, overwrite: bool) -> None:
    """Refuses a page that may not be written, before any work is done.

    Raises:
        UsageError: ``out`` is a folder, or exists and ``overwrite`` is not given.
    """
    if out.is_dir() or (out.exists() and not overwrite):
        cure = "name a file in it" if out.is_dir() else "choose another name or pass --overwrite"
        raise UsageError("exists already", file=out, cure=cure)


def publish(out: Path, text: str) -> None:
    """Write beside the target, make it durable, then rename: never half a page under its name."""
    out.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{out.name}.", dir=out.parent)
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        Path(name).chmod(0o644)
        Path(name).replace(out)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise
