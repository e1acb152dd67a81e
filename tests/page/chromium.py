"""Debian's headless Chromium, without anything that goes to a network."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from selenium import webdriver
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.support.color import Color

DRIVER = shutil.which("chromedriver")
PATIENCE_S = 90.0
ARGUMENTS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--disable-dev-shm-usage",
)  # fmt: skip


@contextmanager
def chromium(
    profile: Path, width: int = 1280, height: int = 900, *, dark: bool = False
) -> Iterator[Any]:
    """Give a browser with a window of this size, and end it."""
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or ""
    for argument in (*ARGUMENTS, f"--user-data-dir={profile}", f"--window-size={width},{height}"):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    browser = webdriver.Chrome(options=options, service=Service(DRIVER))
    try:
        _show_as(browser, width, height, dark)
        yield browser
    finally:
        browser.quit()


@contextmanager
def tab_of(browser: Any) -> Iterator[Any]:
    """Give the browser with a tab of its own, 1280 by 900, and close that tab. Other tests' pages
    have other ports, so that none sees what another has stored."""
    first = browser.current_window_handle
    browser.switch_to.new_window("tab")
    try:
        _show_as(browser, 1280, 900, dark=False)
        browser.get_log("browser")
        yield browser
    finally:
        browser.close()
        browser.switch_to.window(first)


def _show_as(browser: Any, width: int, height: int, dark: bool) -> None:
    size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [scheme]})


SHOWN_TEXT = """
const found = document.querySelector(arguments[0]);
return found && found.checkVisibility() ? found.innerText : "";
"""
LOOK_EVERY_S = 0.1


def wait_for(browser: Any, what: str, until: Callable[[str], bool]) -> str:
    """Wait until the text of an element suits; the text."""
    give_up = time.monotonic() + PATIENCE_S
    text = ""
    while time.monotonic() < give_up:
        # A script, because the driver's own way to a text takes so much of the processor that runs
        # in real time beside it come too late.
        text = browser.execute_script(SHOWN_TEXT, what) or ""
        if until(text):
            return text
        time.sleep(LOOK_EVERY_S)
    raise AssertionError(f"{what} still shows {text!r}")


NOTE_CHANGES = """
const noted = document.querySelector(arguments[0]);
window.seen = [];
const note = () => seen.push([noted.innerText, getComputedStyle(noted).backgroundColor]);
new MutationObserver(note).observe(noted,
  {subtree: true, childList: true, characterData: true, attributes: true});
"""


def note_changes(browser: Any, what: str) -> None:
    """From now on note each text and background colour that an element has, however short it is
    shown: a state may be over before a test looks again. `noted` returns them."""
    browser.execute_script(NOTE_CHANGES, what)


def noted(browser: Any) -> list[tuple[str, str]]:
    """Text and background colour that `note_changes` has noted, in their order."""
    seen = browser.execute_script("return window.seen")
    return [(text, Color.from_string(colour).rgba) for text, colour in seen]
