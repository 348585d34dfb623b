"""The page, used as a person does: in a browser, over a service with simulated vehicles."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Browser, Locator, Page, expect, sync_playwright
from pymavlink import mavutil

from paramclient.files import read_file
from paramclient.service import add_token, read_tokens
from tests.page import BROWSER, BROWSER_OPTIONS, HIGHEST, HOSTILE, Bench, at_work

DESKTOP = {"width": 1280, "height": 800}
PHONE: Any = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
TIMEOUT = 60_000.0
EXPECTED = re.compile(r"the server responded with a status of (4\d\d|503)|ERR_(CONNECTION_|INCOMPLETE)")
"""What the browser itself says of answers that are problems, and of a service that is gone."""
SCROLLED = """grid => new Promise(done => {
    const drawn = () => requestAnimationFrame(() => requestAnimationFrame(done));
    grid.addEventListener("scroll", drawn, {once: true});
    grid.scrollTop = 4000;
})"""
"""Scrolls, and returns when the rows there have been drawn: a press between the two would be beside them."""

expect.set_options(timeout=TIMEOUT)
pytestmark = pytest.mark.skipif(BROWSER is None, reason="no Chromium is here: apt install chromium")


class Sight:
    """The page in a browser, with what a person does there by name."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self.grid = page.get_by_role("grid", name="Parameters")
        self.search = page.get_by_role("searchbox")
        self.dialog = page.get_by_role("dialog")
        self.details = page.get_by_role("complementary", name="The parameter")
        self.editor = page.locator("#editor")
        self.bar = page.get_by_role("contentinfo")

    def choose(self, vehicle: str) -> None:
        self.page.get_by_role("navigation").get_by_role("button", name=vehicle).click()
        expect(self.page.get_by_role("heading", level=1)).to_have_text(vehicle)
        expect(self.page.locator("#rows .row").first).to_be_visible()

    def act(self, name: str) -> None:
        self.page.locator("#actions").get_by_role("button", name=name).click()

    def row(self, name: str) -> Locator:
        label = self.page.locator(".label").get_by_text(name, exact=True)
        return self.grid.get_by_role("row").filter(has=label)

    def value(self, name: str) -> Locator:
        return self.row(name).get_by_role("gridcell").nth(1)

    def stage(self, name: str, text: str) -> None:
        self.search.fill(name)
        self.value(name).click()
        self.editor.get_by_role("textbox").fill(text)
        self.editor.get_by_role("button", name="Stage").click()
        expect(self.editor).to_be_hidden()

    def send(self) -> None:
        self.bar.get_by_role("button", name="Review").click()
        self.dialog.get_by_role("button", name="Send").click()
        expect(self.dialog.get_by_role("button", name="Done")).to_be_visible()

    def sign_in(self, token: str) -> None:
        self.dialog.get_by_label("Token").fill(token)
        self.dialog.get_by_role("button", name="Sign in").click()

    def line(self, name: str) -> Locator:
        return self.dialog.get_by_role("row").filter(has=self.page.get_by_role("rowheader", name=name))

    def done(self) -> None:
        self.dialog.get_by_role("button", name="Done").click()


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    with at_work(tmp_path_factory.mktemp("service")) as bench:
        until(bench.is_ready)
        yield bench


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        yield playwright.chromium.launch(executable_path=BROWSER, args=BROWSER_OPTIONS)


@pytest.fixture
def visit(browser: Browser) -> Iterator[Callable[..., Sight]]:
    """Opens the page; at the end there must be no error, and no request to another host."""
    wrong: list[str] = []
    hosts: set[str] = set()
    urls: set[str] = set()
    contexts = []

    def open_page(url: str, *, is_open: bool = True, **options: Any) -> Sight:
        urls.add(urlsplit(url).netloc)
        context = browser.new_context(**{"viewport": DESKTOP, **options})
        context.set_default_timeout(TIMEOUT)
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: wrong.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: wrong.append(f"{error}\n{error.stack}"))
        page.on("request", lambda request: hosts.add(urlsplit(request.url).netloc))
        page.goto(url)
        if is_open:
            expect(page.locator("#rows .row").first).to_be_visible()
        return Sight(page)

    yield open_page
    for context in contexts:
        context.close()
    assert [each for each in wrong if not EXPECTED.search(each)] == []
    assert hosts - {""} <= urls


@pytest.fixture
def sight(bench: Bench, visit: Callable[..., Sight]) -> Sight:
    """The page, as it is opened."""
    return visit(bench.url)


def until(is_so: Callable[[], bool]) -> None:
    deadline = time.monotonic() + TIMEOUT / 1000
    while not is_so():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def value_of(bench: Bench, name: str, vehicle: str = "px4") -> Any:
    return bench.do(lambda: bench.vehicles[vehicle].param(name).value)


def test_search_groups_and_defaults(bench: Bench, sight: Sight) -> None:
    expect(sight.page.get_by_role("heading", level=1)).to_have_text("PX4 1/1")  # the lowest
    sight.search.fill("mc_roll_p")
    expect(sight.row("MC_ROLL_P")).to_be_visible()
    expect(sight.page.locator("#count")).to_contain_text(" of 9")
    sight.search.fill("")
    group = sight.page.locator("#groups").get_by_role("button").nth(1)
    group.click()
    expect(group).to_have_attribute("aria-current", "true")
    bench.set("MC_ROLL_P", 7.25)
    sight.page.locator("#groups").get_by_role("button").first.click()
    sight.page.locator("#chips").get_by_role("button", name="Changed from default").click()
    expect(sight.row("MC_ROLL_P")).to_be_visible()
    sight.page.locator("#chips").get_by_role("button", name="All").click()
    sight.search.fill("no such thing")
    expect(sight.page.locator("#empty")).to_have_text("No parameter matches the search.")


def test_values_are_staged_reviewed_sent_and_undone(bench: Bench, visit: Callable[..., Sight]) -> None:
    before = value_of(bench, "RTL_ALT", "ardupilot")
    sight = visit(bench.url)
    sight.choose("ArduPilot 2/1")
    sight.stage("RTL_ALT", str(HIGHEST + 5))
    sight.stage("RTL_SPEED", "123")
    sight.stage("WPNAV_SPEED", "612.5")
    sight.send()
    expect(sight.line("RTL_ALT")).to_contain_text("adjusted")
    expect(sight.line("RTL_SPEED")).to_contain_text("refused")
    expect(sight.line("WPNAV_SPEED")).to_contain_text("accepted")
    sight.done()
    assert value_of(bench, "WPNAV_SPEED", "ardupilot") == 612.5
    sight.search.fill("RTL_ALT")
    expect(sight.value("RTL_ALT")).to_contain_text(str(HIGHEST))
    sight.bar.get_by_role("button", name="Drop").click()  # the refused one
    sight.bar.get_by_role("button", name="Undo").click()
    sight.dialog.get_by_role("button", name="Send").click()
    sight.done()
    assert value_of(bench, "RTL_ALT", "ardupilot") == before


def test_a_press_before_the_rows_are_sorted_is_a_click(bench: Bench, sight: Sight) -> None:
    """They are sorted for screen readers after a scroll; the browser clicks no element that has moved."""
    cell = sight.page.locator("#rows .row .value").nth(5).bounding_box()
    assert cell is not None
    sight.page.mouse.move(cell["x"] + 5, cell["y"] + 5)
    sight.grid.evaluate(SCROLLED)
    sight.page.mouse.down()
    sight.page.wait_for_timeout(300)
    sight.page.mouse.up()
    expect(sight.editor).to_be_visible()


def test_a_value_out_of_range_needs_a_confirmation(bench: Bench, sight: Sight) -> None:
    high = bench.ask("GET", "/vehicles/1/1/params/MC_ROLL_P")["metadata"]["maximum"] + 1
    sight.stage("MC_ROLL_P", str(high))
    sight.bar.get_by_role("button", name="Review").click()
    send = sight.dialog.get_by_role("button", name="Send")
    expect(sight.dialog.get_by_role("alert").filter(has_text="out of range")).to_be_visible()
    expect(send).to_be_disabled()
    expect(send).not_to_have_class(re.compile("strong"))  # Enter in the dialog sends nothing
    sight.dialog.get_by_label("Send them anyway").check()
    send.click()
    expect(sight.line("MC_ROLL_P")).to_contain_text("accepted")
    sight.done()
    assert value_of(bench, "MC_ROLL_P") == high


def test_changes_by_others_appear_with_their_history(bench: Bench, sight: Sight) -> None:
    bench.set("MC_YAW_P", 3.5)
    sight.search.fill("MC_YAW_P")
    expect(sight.value("MC_YAW_P")).to_contain_text("3.5")
    sight.row("MC_YAW_P").get_by_role("gridcell").first.click()
    sight.page.keyboard.press("Space")
    expect(sight.details).to_contain_text("from the vehicle")
    expect(sight.details.locator(".past")).to_contain_text("→ 3.5")
    sight.page.locator("#chips").get_by_role("button", name="Changed by others").click()
    expect(sight.row("MC_YAW_P")).to_be_visible()


def test_a_file_is_compared_and_taken_over(bench: Bench, visit: Callable[..., Sight], tmp_path: Path) -> None:
    file = tmp_path / "tuned.parm"
    file.write_text("MC_ROLLRATE_P 0.21\nMC_ROLLRATE_I 0.2\nNO_SUCH_PARAM 1\n")
    sight = visit(bench.url)
    sight.act("Compare")
    sight.dialog.locator("input[type=file]").set_input_files(file)
    banner = sight.page.get_by_role("region", name="Comparison")
    expect(banner).to_contain_text("1 differ")
    expect(banner).to_contain_text("1 only there")
    banner.get_by_role("button", name="Take over").click()
    expect(sight.line("MC_ROLLRATE_P")).to_contain_text("0.21")
    sight.dialog.get_by_role("button", name="Apply 1 value").click()
    expect(sight.line("MC_ROLLRATE_P").get_by_text("accepted")).to_be_visible()
    sight.done()
    assert value_of(bench, "MC_ROLLRATE_P") == pytest.approx(0.21)
    expect(banner).to_contain_text("0 differ")


def test_a_snapshot_is_stored_compared_and_taken_over(bench: Bench, visit: Callable[..., Sight]) -> None:
    before = value_of(bench, "MC_ROLLRATE_D")
    sight = visit(bench.url)
    sight.act("Snapshot")
    expect(sight.page.locator("#note")).to_contain_text("Snapshot created")
    bench.set("MC_ROLLRATE_D", 0.005)
    sight.act("Compare")
    sight.dialog.get_by_role("button", name="kept by hand").first.click()
    sight.page.get_by_role("region", name="Comparison").get_by_role("button", name="Take over").click()
    sight.dialog.get_by_role("button", name="Apply").click()
    sight.done()
    assert value_of(bench, "MC_ROLLRATE_D") == pytest.approx(before)


def test_another_vehicle_is_compared(bench: Bench, sight: Sight) -> None:
    sight.act("Compare")
    sight.dialog.get_by_role("button", name="ArduPilot 2/1").click()
    expect(sight.page.get_by_role("region", name="Comparison")).to_contain_text("only here")


def test_a_table_is_fetched_and_saved(bench: Bench, sight: Sight, tmp_path: Path) -> None:
    sight.act("Fetch")
    sight.act("Save")
    with sight.page.expect_download() as download:
        sight.dialog.get_by_role("button", name="QGroundControl").click()
    file = tmp_path / download.value.suggested_filename
    download.value.save_as(file)
    assert "MC_ROLL_P" in read_file(file).sets[0]


def test_ground_stations_are_shown_with_what_cache_saved(bench: Bench, visit: Callable[..., Sight]) -> None:
    station = mavutil.mavlink_connection(bench.endpoint.replace("tcpin", "tcp"), source_system=254)
    station.wait_heartbeat(timeout=20)
    station.param_fetch_all()
    assert station.recv_match(type="PARAM_VALUE", blocking=True, timeout=20)
    sight = visit(bench.url)
    sight.page.get_by_role("button", name="Ground stations").click()
    expect(sight.dialog).to_contain_text("1 station.")
    expect(sight.dialog).to_contain_text("as 254/")
    expect(sight.dialog).to_contain_text(re.compile(r"kept \d+\.\d kB off the links"))
    sight.dialog.get_by_role("button", name="Close").last.click()
    station.close()


def test_extended_parameters_are_staged_and_undone(bench: Bench, sight: Sight) -> None:
    sight.page.get_by_role("navigation").get_by_role("button", name="Camera 4/100, extended").click()
    expect(sight.page.locator("#empty")).to_contain_text("Fetch requests them")
    sight.act("Fetch")
    name = "CAM_NAME"
    expect(sight.row(name)).to_be_visible()
    before = bench.ask("GET", f"/vehicles/4/100/params/{name}?ext=true")["value"]
    sight.stage(name, "Rear left")
    sight.send()
    expect(sight.line(name)).to_contain_text("accepted")
    sight.done()
    assert bench.ask("GET", f"/vehicles/4/100/params/{name}?ext=true&live=true")["value"] == "Rear left"
    sight.bar.get_by_role("button", name="Undo").click()
    sight.dialog.get_by_role("button", name="Send").click()
    sight.done()
    assert bench.ask("GET", f"/vehicles/4/100/params/{name}?ext=true&live=true")["value"] == before


def test_names_with_markup_are_shown_as_text(bench: Bench, sight: Sight) -> None:
    sight.choose("PX4 3/1")
    for name in HOSTILE:
        expect(sight.row(name)).to_be_visible()
    assert sight.page.locator("iframe, #rows b > b").count() == 0
    sight.stage("A/../B?c%23d%41", "9")
    sight.send()
    expect(sight.dialog).to_contain_text("accepted")
    sight.done()


def test_on_a_phone_values_are_edited_in_the_sheet(bench: Bench, visit: Callable[..., Sight]) -> None:
    sight = visit(bench.url, **PHONE)
    sight.search.fill("MC_YAWRATE_P")
    sight.row("MC_YAWRATE_P").tap()
    expect(sight.details).to_be_visible()
    sight.details.get_by_role("textbox").fill("0.3")
    sight.details.get_by_role("button", name="Stage").tap()
    sight.send()
    expect(sight.dialog).to_contain_text("accepted")
    sight.done()
    assert value_of(bench, "MC_YAWRATE_P") == pytest.approx(0.3)
    assert sight.page.evaluate("document.documentElement.scrollWidth") <= PHONE["viewport"]["width"]
    choice = sight.page.locator("#group-choice")
    whole = "choice => { choice.style.flex = 'none'; choice.length = 1; return choice.offsetWidth }"
    assert choice.evaluate("choice => choice.offsetWidth") >= choice.evaluate(whole)  # "All groups (903)"


def test_without_a_token_one_signs_in(browser: Browser, visit: Callable[..., Sight], tmp_path: Path) -> None:
    file = tmp_path / "tokens"
    reads, writes = add_token(file, "eye", "read"), add_token(file, "hand", "write")
    with at_work(tmp_path, tokens=read_tokens(file)) as bench:
        bench.token = reads
        until(bench.is_ready)
        sight = visit(bench.url, is_open=False)
        expect(sight.dialog).to_contain_text("requires a token")
        for part in ("#main", "#rail", "#vehicle-choice"):
            expect(sight.page.locator(part)).to_be_hidden()
        expect(sight.page.locator("#role")).to_have_text("")
        sight.sign_in("wrong")
        expect(sight.dialog).to_contain_text("not valid")
        sight.sign_in(reads)
        expect(sight.row("MC_ROLL_P").or_(sight.page.locator("#rows .row").first).first).to_be_visible()
        expect(sight.page.locator("#role")).to_have_text("read-only")
        assert sight.page.locator("#actions").get_by_role("button", name="Snapshot").count() == 0
        assert sight.page.context.cookies() == []
        sight.page.reload()
        expect(sight.page.locator("#rows .row").first).to_be_visible()  # the tab keeps it
        other = visit(bench.url, is_open=False)
        other.sign_in(writes)
        expect(other.page.locator("#rows .row").first).to_be_visible()
        other.stage("MC_ROLL_P", "7.5")
        other.send()
        expect(other.dialog).to_contain_text("accepted")


def test_the_page_reconnects_to_a_restarted_service(visit: Callable[..., Sight], tmp_path: Path) -> None:
    with at_work(tmp_path) as bench:
        until(bench.is_ready)
        port = urlsplit(bench.url).port
        sight = visit(bench.url)
        sight.stage("MC_ROLL_P", "7.5")
    expect(sight.page.locator("#unreachable")).to_be_visible()
    assert port is not None
    with at_work(tmp_path, port=port) as bench:
        until(bench.is_ready)
        expect(sight.page.locator("#unreachable")).to_be_hidden()
        sight.send()  # what was staged is still there
        expect(sight.dialog).to_contain_text("accepted")
