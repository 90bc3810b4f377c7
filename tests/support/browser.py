"""The monitor's page in a real Chromium."""

from __future__ import annotations

import shutil
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest

from support.patience import PATIENCE

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no chromium is installed here")


@asynccontextmanager
async def browser_page(width: int = 1280, height: int = 800) -> AsyncIterator[tuple[Any, list[str]]]:
    """A page, and what it should not do: lines on the console, and requests to elsewhere."""
    playwright_of = pytest.importorskip("playwright.async_api", reason="playwright is not installed")
    async with playwright_of.async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = await browser.new_page(viewport={"width": width, "height": height})
        page.set_default_timeout(1e3 * PATIENCE)
        misdeeds: list[str] = []
        page.on("console", lambda message: misdeeds.append(f"console: {message.text}"))
        page.on("pageerror", lambda error: misdeeds.append(f"error: {error}"))
        page.on(
            "request",
            lambda request: (
                None
                if request.url.startswith(("http://127.0.0.1", "data:", "blob:"))
                else misdeeds.append(f"request: {request.url}")
            ),
        )
        try:
            yield page, misdeeds
        finally:
            await browser.close()


async def until_said(page: Any, text: str, kind: str) -> None:
    await page.wait_for_function(
        "([text, kind]) => document.querySelector('#sentence').textContent.includes(text)"
        " && document.querySelector('#light').dataset.kind === kind",
        arg=[text, kind],
    )
