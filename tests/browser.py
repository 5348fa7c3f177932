"""A headless Chromium for tests of pages, where it is installed; elsewhere a skip that says why."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_PATIENCE_MS = 120_000  # a busy machine draws slowly


@cache
def _chromium() -> tuple[str, str]:
    """The program, or "" and why there is none."""
    if find_spec("playwright") is None:
        return "", "playwright is not installed"
    for name in _NAMES:
        # Ubuntu's package without snap is a script that only prints an error.
        if (path := shutil.which(name)) and not subprocess.run(
            [path, "--version"], capture_output=True, check=False
        ).returncode:
            return path, ""
    return "", "no chromium here: apt-get install chromium"


class Watched:
    """What happened in a page: messages of the console, errors, and requests other than for the page."""

    def __init__(self, page: Any, address: str) -> None:
        self.console: list[str] = []
        self.requests: list[str] = []
        page.on("console", lambda message: self.console.append(f"{message.type}: {message.text}"))
        page.on("pageerror", lambda error: self.console.append(f"error: {error}"))
        page.on("dialog", lambda dialog: (self.console.append(f"dialog: {dialog.message}"), dialog.dismiss()))
        page.on("request", lambda request: self._request(request.url, address))

    def _request(self, url: str, address: str) -> None:
        if url != address and not url.startswith("data:"):
            self.requests.append(url[:200])


@contextmanager
def browser() -> Iterator[Any]:
    """Playwright's browser; a skip where there is none."""
    path, why = _chromium()
    if not path:
        pytest.skip(why)
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        # Without the sandbox, which root and containers lack: pages of tests alone are opened.
        opened = driver.chromium.launch(
            executable_path=path, args=["--no-sandbox", "--disable-dev-shm-usage"], timeout=_PATIENCE_MS
        )
        try:
            yield opened
        finally:
            opened.close()


def open_page(opened: Any, file: Path, **options: Any) -> tuple[Any, Watched]:
    """A page with a file, and what happens in it."""
    page = opened.new_page(**options)
    page.set_default_timeout(_PATIENCE_MS)
    watched = Watched(page, file.as_uri())
    page.goto(file.as_uri())
    return page, watched
