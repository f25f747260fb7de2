"""Headless Chromium for the tests that are marked `browser`."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

FLAGS = [
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--autoplay-policy=no-user-gesture-required",
]  # fmt: skip


@contextmanager
def chromium(extra: tuple[str, ...] = ()) -> Iterator[Any]:
    """A browser with an empty profile; the test is skipped where there is none."""
    sync_api = pytest.importorskip("playwright.sync_api")
    path = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if path is None:
        pytest.skip("needs Chromium: apt-get install chromium")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, headless=True, args=[*FLAGS, *extra])
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def page_of(browser: Any, width: int, height: int = 900, scheme: str = "light") -> Iterator[tuple[Any, list[str]]]:
    """A page and the list of its console errors, uncaught exceptions and requests that leave the machine."""
    context = browser.new_context(viewport={"width": width, "height": height}, color_scheme=scheme)
    page, troubles = context.new_page(), []
    page.on("console", lambda m: troubles.append(f"console {m.type}: {m.text}") if m.type == "error" else None)
    page.on("pageerror", lambda e: troubles.append(f"exception: {e}"))
    local = ("file:", "data:", "blob:", "http://127.0.0.1", "ws://127.0.0.1", "http://localhost", "ws://localhost")
    page.on("request", lambda r: None if r.url.startswith(local) else troubles.append(f"request: {r.url}"))
    try:
        yield page, troubles
    finally:
        context.close()
