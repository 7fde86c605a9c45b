"""A page in a real headless Chromium, for the tests: nothing may be fetched from elsewhere, nothing complained of."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

OPTIONS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
           "--disable-component-update", "--disable-sync"]  # fmt: skip
# On the live page: of each value of the effort, when it had been painted, in ms since 1970, two frames after it came.
WATCH_EFFORT = """
(() => {
  window.seen = {}
  const source = [...Bokeh.documents[0].all_models].find((m) => m.name === "setpoint+output+effort+applied")
  const known = new Set()
  source.streaming.connect(() => {
    const fresh = [...new Set(source.data.effort)].filter((value) => !known.has(value))
    for (const value of fresh) known.add(value)
    const painted = () => { for (const value of fresh) window.seen[value] = Date.now() }
    if (fresh.length) requestAnimationFrame(() => requestAnimationFrame(painted))
  })
})()
"""


def seen_efforts(page: Any) -> dict[float, float]:
    """What WATCH_EFFORT has noted: when each value had been painted, in s since 1970."""
    return {float(value): at / 1000.0 for value, at in page.evaluate("Object.entries(window.seen)")}


@contextmanager
def chromium_page(program: str, width: int = 1280, height: int = 900, **context: Any) -> Iterator[Any]:
    """A Playwright page; at its end, errors in its console and requests beyond this machine fail the test."""
    from playwright.sync_api import sync_playwright

    troubles: list[str] = []
    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as profile:
        browser = playwright.chromium.launch_persistent_context(
            profile,
            executable_path=program,
            headless=True,
            args=OPTIONS,
            viewport={"width": width, "height": height},
            **context,
        )
        page = browser.new_page()

        def complain(of: bool, text: str) -> None:
            if of:
                troubles.append(text)

        page.on("console", lambda message: complain(message.type == "error", message.text))
        page.on("pageerror", lambda error: complain(True, str(error)))
        page.on("request", lambda request: complain(_is_foreign(request.url), f"fetched {request.url}"))
        yield page
        browser.close()
    assert not troubles, troubles


def _is_foreign(url: str) -> bool:
    return not url.startswith(("file:", "data:", "blob:", "about:", "http://127.0.0.1", "ws://127.0.0.1"))
