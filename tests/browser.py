"""A headless browser for tests of pages; they skip where there is none."""

from __future__ import annotations

import shutil
import subprocess

import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")


def browse(html, tmp_path, *options, fragment="", budget_ms=3000):
    """Open a page in a headless browser; returns its standard output.

    Its clock runs ahead where nothing happens, up to ``budget_ms``; with 0 it is that of the wall.
    """
    command = [
        CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-quic",
        "--no-first-run", "--disable-component-update", "--disable-sync", "--hide-scrollbars",
        f"--user-data-dir={tmp_path / 'profile'}", *([f"--virtual-time-budget={budget_ms}"] if budget_ms else []),
        *options, html.as_uri() + fragment,
    ]  # fmt: skip
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout


def acted(html, script):
    """The page with a program that acts on it once it is there, and what it leaves behind in ``data-*``."""
    act = f"<script>setTimeout(() => {{ {script} }}, 300)</script></body>"
    html.write_text(html.read_text().replace("</body>", act))
    return html
