"""Chromium with software WebGL for tests."""

from __future__ import annotations

import io
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import cv2
import numpy as np
import pytest

FLAGS = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)


@contextmanager
def chromium(*flags: str) -> Iterator[Any]:
    """Start Chromium; skips the test where it or playwright is missing."""
    playwright = pytest.importorskip("playwright.sync_api")
    path = shutil.which("chromium")
    if path is None:
        pytest.skip("chromium is not installed (apt-get install chromium)")
    with playwright.sync_playwright() as session:
        browser = session.chromium.launch(executable_path=path, args=[*FLAGS, *flags])
        yield browser
        browser.close()


class WatchedPage:
    """A page that records its errors and requests.

    Args:
        browser: from `chromium`.
        evaluate: allow the test to run scripts, which the policy of the page forbids.
    """

    def __init__(self, browser: Any, evaluate: bool = False) -> None:
        self.page = browser.new_page(viewport={"width": 900, "height": 500}, bypass_csp=evaluate)
        self.errors: list[str] = []
        self.requests: list[str] = []
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.on("console", self._logged)

    def _logged(self, message: Any) -> None:
        if message.type == "error":
            self.errors.append(message.text)

    def picture(self) -> np.ndarray:
        """Return a screenshot [H, W, 3] as signed RGB."""
        content = np.frombuffer(io.BytesIO(self.page.screenshot()).read(), np.uint8)
        return cv2.imdecode(content, cv2.IMREAD_COLOR)[..., ::-1].astype(int)


def mean_colour(picture: np.ndarray, x: int, y: int, half: int = 12) -> np.ndarray:
    """Return the mean colour around a pixel."""
    return picture[y - half : y + half, x - half : x + half].reshape(-1, 3).mean(axis=0)
