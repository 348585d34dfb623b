"""Makes the pictures of the page that the docs show: `make screenshots`. Needs Chromium."""

from __future__ import annotations

import re
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, Page, expect, sync_playwright

from tests.page import BROWSER, BROWSER_OPTIONS, Bench, at_work

IMAGES = Path(__file__).parent.parent / "docs/images"
DESKTOP: Any = {"viewport": {"width": 1180, "height": 640}}
PHONE: Any = {"viewport": {"width": 390, "height": 760}, "has_touch": True, "is_mobile": True}


def main() -> None:
    """Make all of them anew."""
    if BROWSER is None:
        sys.exit("no Chromium is here to look at the page with: apt install chromium")
    IMAGES.mkdir(exist_ok=True)
    with (
        tempfile.TemporaryDirectory() as folder,
        at_work(Path(folder)) as bench,
        sync_playwright() as playwright,
    ):
        while not bench.is_ready():
            time.sleep(0.1)
        bench.set("MC_ROLL_P", 7.2)
        bench.set("MC_YAW_P", 2.4)
        browser = playwright.chromium.launch(executable_path=BROWSER, args=BROWSER_OPTIONS)
        _table(browser, bench)
        _review(browser, bench)
        _phone(browser, bench)


def _open(browser: Browser, bench: Bench, scheme: Any, kind: Any) -> Page:
    page = browser.new_context(**kind, color_scheme=scheme).new_page()
    page.goto(bench.url)
    expect(page.locator("#rows .row").first).to_be_visible()
    page.get_by_role("searchbox").fill("MC_")
    return page


def _stage(page: Page, name: str, text: str) -> None:
    page.get_by_role("searchbox").fill(name)
    page.get_by_role("searchbox").press("Enter")
    page.keyboard.press("Enter")
    page.locator("#editor").get_by_role("textbox").fill(text)
    page.keyboard.press("Enter")


def _table(browser: Browser, bench: Bench) -> None:
    page = _open(browser, bench, "light", DESKTOP)
    _stage(page, "MC_ROLLRATE_MAX", "250")
    page.get_by_role("searchbox").fill("MC_ROLL_P")
    page.get_by_role("searchbox").press("Enter")
    page.keyboard.press("Space")
    expect(page.locator(".past")).to_contain_text("→")
    page.get_by_role("searchbox").fill("")
    page.get_by_role("button", name=re.compile("^MC ")).click()
    page.locator("#rail").evaluate("rail => rail.scrollTo(0, 0)")
    page.mouse.move(0, 0)
    _save(page, "page-table.png")


def _review(browser: Browser, bench: Bench) -> None:
    page = _open(browser, bench, "dark", DESKTOP)
    page.get_by_role("navigation").get_by_role("button", name="ArduPilot 2/1").click()
    page.get_by_role("searchbox").fill("RTL_")
    expect(page.locator("#rows .row", has_text="RTL_ALT_FINAL")).to_be_visible()
    for name, text in (("RTL_ALT", "5000"), ("RTL_SPEED", "800"), ("RTL_CLIMB_MIN", "200")):
        _stage(page, name, text)
    page.get_by_role("searchbox").fill("RTL_")
    page.keyboard.press("Control+Enter")
    page.get_by_role("dialog").get_by_role("button", name="Send").click()
    expect(page.get_by_role("dialog").get_by_role("button", name="Done")).to_be_visible()
    _save(page, "page-outcome.png")


def _phone(browser: Browser, bench: Bench) -> None:
    page = _open(browser, bench, "light", PHONE)
    page.get_by_role("searchbox").fill("")
    page.get_by_role("searchbox").blur()
    page.get_by_label("Group", exact=True).select_option("MC")
    _save(page, "page-phone.png")
    page.get_by_role("searchbox").fill("MC_ROLL_P")
    page.locator("#rows .row").first.tap()
    expect(page.locator(".past li").first).to_be_visible()
    _save(page, "page-phone-edit.png")


def _save(page: Page, name: str) -> None:
    """Take the picture when nothing moves any more."""
    page.wait_for_timeout(400)
    page.screenshot(path=IMAGES / name)


if __name__ == "__main__":
    main()
