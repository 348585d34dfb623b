"""The page, looked at and used as a person does: in a browser, over a service with simulated vehicles."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from anyio.from_thread import start_blocking_portal
from playwright.sync_api import Browser, Locator, Page, Route, expect, sync_playwright

from paramclient import ParamCache, ParamClient
from paramclient.links import SimLink
from paramclient.model.ext_params import ExtParamType
from paramclient.service import Settings
from paramclient.service.access import AccessSettings
from paramclient.service.tokens import Tokens
from paramclient.sim import Camera, PX4Vehicle
from paramclient.sim.camera import ExtEntries
from paramclient.testing import SimVehicle
from tests.page import BROWSER, BROWSER_OPTIONS, HIGHEST, HOSTILE, Bench, at_work

FILES = Path(__file__).parents[2] / "paramclient/service/page"
LARGEST_PAGE = 150_000
DESKTOP = {"width": 1280, "height": 800}
PHONE = {"width": 390, "height": 844}
TIMEOUT = 60_000.0
EXPECTED = re.compile(
    r"the server responded with a status of (4\d\d|503)|ERR_(CONNECTION_(REFUSED|RESET)|INCOMPLETE)"
)
"""What the browser itself says of answers that are problems, and of a service that is gone."""

expect.set_options(timeout=TIMEOUT)

needs_browser = pytest.mark.skipif(
    BROWSER is None, reason="no Chromium is here to look at the page with: apt install chromium"
)


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
        self.spoken = page.get_by_role("log")

    def choose(self, vehicle: str) -> None:
        self.page.get_by_role("navigation").get_by_role("button", name=vehicle).click()
        expect(self.page.get_by_role("heading", level=1)).to_have_text(vehicle)

    def find(self, text: str) -> None:
        self.search.fill(text)

    def row(self, name: str) -> Locator:
        label = self.page.locator(".label").get_by_text(name, exact=True)
        return self.grid.get_by_role("row").filter(has=label)

    def value(self, name: str) -> Locator:
        return self.row(name).get_by_role("gridcell").nth(1)

    def open(self, name: str) -> Locator:
        """Search for a parameter and open the form over its value."""
        self.find(name)
        self.value(name).click()
        expect(self.editor).to_be_visible()
        return self.editor

    def stage(self, name: str, text: str) -> None:
        editor = self.open(name)
        editor.get_by_role("textbox").fill(text)
        editor.get_by_role("button", name="Stage").click()
        expect(self.editor).to_be_hidden()

    def review(self) -> None:
        self.bar.get_by_role("button", name="Review").click()

    def send(self) -> None:
        self.review()
        self.dialog.get_by_role("button", name="Send").click()
        expect(self.dialog.get_by_role("button", name="Done")).to_be_visible()

    def line(self, name: str) -> Locator:
        return self.dialog.get_by_role("row").filter(has=self.page.get_by_role("rowheader", name=name))


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    with at_work(tmp_path_factory.mktemp("service")) as bench:
        until(lambda: all(map(bench.is_synced, (1, 2, 3))))
        for system, link in ((1, "px4"), (3, "odd")):
            bench.ask("POST", f"/components/{system}/1/metadata?link={link}", {})
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

    def open_page(url: str, vehicle: str | None = "PX4 1/1", **options: Any) -> Sight:
        urls.add(urlsplit(url).netloc)
        context = browser.new_context(**{"viewport": DESKTOP, **options})
        context.set_default_timeout(TIMEOUT)
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: wrong.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: wrong.append(f"{error}\n{error.stack}"))
        page.on("request", lambda request: hosts.add(urlsplit(request.url).netloc))
        page.goto(url)
        if vehicle is not None:
            expect(page.locator("#rows .row").first).to_be_visible()
        sight = Sight(page)
        if vehicle not in (None, "PX4 1/1"):
            sight.choose(str(vehicle))
        return sight

    yield open_page
    for context in contexts:
        context.close()
    assert [each for each in wrong if not EXPECTED.search(each)] == []
    assert hosts <= urls


@pytest.fixture
def sight(visit: Callable[..., Sight], bench: Bench) -> Sight:
    return visit(bench.url)


def until(is_so: Callable[[], object], patience: float = 30.0) -> None:
    """Wait until something is so."""
    end = time.monotonic() + patience
    while not is_so():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.05)


# what it is made of


def test_the_page_is_small_and_whole() -> None:
    contents = {path.name: path.read_text(encoding="utf-8") for path in FILES.iterdir()}
    assert sum(len(text.encode()) for text in contents.values()) < LARGEST_PAGE
    named = {
        name for text in contents.values() for name in re.findall(r'(?:"/page/|from "\./)([\w.]+)"', text)
    }
    assert named | {"index.html"} == set(contents)


def test_no_text_can_become_markup() -> None:
    forbidden = re.compile(
        r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\(|new Function|DOMParser"
    )
    markup = re.compile(r"<script(?![^>]*\bsrc=)|<style|\sstyle=|\son\w+=")
    for path in FILES.iterdir():
        text = path.read_text(encoding="utf-8")
        assert not forbidden.search(text), path.name
        if path.suffix == ".html":
            assert not markup.search(text)


def test_the_page_loads_nothing_from_other_hosts() -> None:
    for path in FILES.iterdir():
        addresses = set(
            re.findall(r"(?:https?:)?//[\w.]+\.[a-z]+[^\s\"']*", path.read_text(encoding="utf-8"))
        )
        assert addresses <= {"http://www.w3.org/2000/svg"}, path.name


# what is shown


@needs_browser
def test_only_visible_rows_of_the_table_are_drawn(sight: Sight) -> None:
    expect(sight.page.get_by_role("heading", level=1)).to_have_text("PX4 1/1")
    expect(sight.page.locator("#badges")).to_have_text("up to date")
    expect(sight.page.locator("#count")).to_have_text("903 parameters")
    expect(sight.grid).to_have_attribute("aria-rowcount", "904")
    assert sight.page.locator("#rows .row").count() < 60
    sight.grid.press("End")
    last = sight.grid.get_by_role("row", selected=True)
    expect(last).to_have_attribute("aria-rowindex", "904")
    expect(last).to_be_in_viewport()
    assert sight.page.locator("#rows .row:not([hidden])").count() < 60


@needs_browser
def test_search_by_name_by_description_by_meaning_by_value(sight: Sight, bench: Bench) -> None:
    names = sight.page.locator("#rows .row:not([hidden]) .label")
    sight.find("mc_roll_p")
    expect(names).to_have_text(["MC_ROLL_P"])
    sight.find("remote control lost")
    expect(names).to_have_text(["NAV_RCL_ACT"])
    sight.find("MC_ 100.0")
    expected = {name for name, value in bench.px4.values.items() if value == 100.0 and "MC_" in name}
    expect(names).to_have_count(len(expected))
    assert set(names.all_inner_texts()) == expected
    sight.find("no such thing")
    expect(sight.page.get_by_text("No parameter matches the search.")).to_be_visible()
    sight.search.press("Escape")
    expect(sight.page.locator("#count")).to_have_text("903 parameters")


@needs_browser
def test_groups_hold_what_is_theirs(sight: Sight, bench: Bench) -> None:
    sight.page.get_by_role("button", name=re.compile("^EKF2")).click()
    own = [name for name in bench.px4.values if name.partition("_")[0] == "EKF2"]
    expect(sight.page.locator("#count")).to_have_text(f"{len(own)} of 903")


@needs_browser
def test_changed_from_default_lists_the_changed_parameters(visit: Callable[..., Sight], bench: Bench) -> None:
    sight = visit(bench.url, "ArduPilot 2/1")
    sight.page.get_by_role("button", name="Changed from default").click()
    changed = bench.ask("GET", "/components/2/1/params?changed=true")["params"]
    expect(sight.page.locator("#count")).to_have_text(f"{len(changed)} of 1382")


@needs_browser
def test_defaults_of_the_metadata_count_as_defaults(visit: Callable[..., Sight], tmp_path: Path) -> None:
    """The service loads the descriptions of a PX4 without a request; the page offers a button for others."""
    plain = SimVehicle(PX4Vehicle(system=5, ftp=True))
    with at_work(tmp_path, more={"plain": plain}) as bench:
        sight = visit(bench.url)
        sight.find("MC_ROLL_P")
        expect(sight.row("MC_ROLL_P").get_by_role("gridcell").nth(3)).to_contain_text("Gain from the error")
        load = sight.page.get_by_role("button", name="Load descriptions")
        expect(load).to_be_hidden()
        third = sight.row("MC_ROLL_P").get_by_role("gridcell").nth(2)
        expect(third).to_have_text("4.0")
        expect(third).to_have_attribute("title", "Default of the metadata")
        bench.set("MC_ROLL_P", 6.5)
        sight.find("")
        sight.page.get_by_role("button", name="Changed from default").click()
        expect(sight.row("MC_ROLL_P")).to_be_visible()
        changed = bench.ask("GET", "/components/1/1/params?link=px4&changed=true")["params"]
        assert "MC_ROLL_P" in changed
        expect(sight.page.locator("#count")).to_have_text(f"{len(changed)} of 903")
        sight.find("MC_ROLL_P")
        sight.search.press("Enter")
        sight.grid.press("Space")
        standard = sight.details.get_by_role("definition").first
        expect(standard).to_have_text("4.0 1/s")
        expect(standard).to_have_attribute("title", "Default of the metadata")
        sight.details.press("Escape")
        sight.choose("PX4 5/1")
        expect(load).to_be_visible()
        expect(load).to_have_attribute("title", "the vehicle serves no metadata")
        load.click()
        expect(sight.dialog.get_by_role("button", name="Load from the vehicle")).to_be_visible()


@needs_browser
def test_the_details_of_a_parameter(sight: Sight) -> None:
    sight.find("MC_ROLL_P")
    sight.search.press("Enter")
    sight.grid.press("Space")
    for text in (
        "Gain from the error of the roll angle",
        "0 to 12 1/s",
        "REAL32",
        "received from the vehicle",
    ):
        expect(sight.details).to_contain_text(text)
    sight.details.press("Escape")
    expect(sight.details).to_be_hidden()
    expect(sight.grid).to_be_focused()


@needs_browser
def test_names_that_try_to_be_markup_stay_texts(visit: Callable[..., Sight], bench: Bench) -> None:
    sight = visit(bench.url, "PX4 3/1")
    expect(sight.page.locator("#rows .row:not([hidden]) .label")).to_have_text(sorted(HOSTILE))
    expect(sight.value("NOT_A_NUMBER")).to_have_text("NaN")
    for name in HOSTILE:
        sight.row(name).locator(".label").click()
        sight.grid.press("Space")
        expect(sight.details.get_by_role("heading", level=2)).to_have_text(name)
        sight.details.press("Escape")
    assert (
        sight.page.locator("#main b b, #main img, #details img, #details script, #rows script").count() == 0
    )


# edits


@needs_browser
def test_an_edit_is_staged_then_reviewed_then_sent_and_can_be_undone(sight: Sight, bench: Bench) -> None:
    before = bench.px4.values["MC_PITCH_P"]
    assert before != 5.25
    sight.stage("MC_PITCH_P", "5,25")
    expect(sight.row("MC_PITCH_P")).to_contain_text(f"{before!r} → 5.25")
    expect(sight.bar).to_contain_text("1 change staged")
    sight.review()
    expect(sight.line("MC_PITCH_P")).to_contain_text("5.25")
    assert bench.px4.values["MC_PITCH_P"] == before  # nothing goes out before it was looked at
    sight.dialog.get_by_role("button", name="Send 1 change").click()
    expect(sight.line("MC_PITCH_P")).to_contain_text("accepted")
    expect(sight.spoken).to_contain_text("1 accepted.")
    assert bench.px4.values["MC_PITCH_P"] == 5.25
    sight.dialog.get_by_role("button", name="Undo").click()
    sight.dialog.get_by_role("button", name="Send 1 change").click()
    expect(sight.line("MC_PITCH_P")).to_contain_text("accepted")
    assert bench.px4.values["MC_PITCH_P"] == before
    sight.dialog.get_by_role("button", name="Done").click()
    expect(sight.value("MC_PITCH_P")).to_have_text(repr(before))
    expect(sight.row("MC_PITCH_P")).not_to_have_class(re.compile("recent"))  # it was us


@needs_browser
def test_the_outcome_of_each(visit: Callable[..., Sight], bench: Bench) -> None:
    sight = visit(bench.url, "ArduPilot 2/1")
    sight.stage("RTL_SPEED", "7")
    sight.stage("RTL_ALT", str(HIGHEST + 2000))
    sight.stage("RTL_CLIMB_MIN", "12")
    sight.send()
    expect(sight.line("RTL_SPEED")).to_contain_text(re.compile("refused.*read.only", re.IGNORECASE))
    expect(sight.line("RTL_ALT")).to_contain_text(
        f"adjusted The vehicle changed {HIGHEST + 2000} to {HIGHEST}."
    )
    expect(sight.line("RTL_CLIMB_MIN")).to_contain_text("accepted")
    assert bench.ardupilot.values["RTL_ALT"] == HIGHEST
    assert bench.ardupilot.values["RTL_CLIMB_MIN"] == 12
    sight.dialog.get_by_role("button", name="Done").click()
    expect(sight.bar).to_contain_text("1 change staged")  # what was refused waits to be seen to


@needs_browser
def test_all_changes_go_out_in_one_request(sight: Sight, bench: Bench) -> None:
    wanted = {
        "MC_ROLL_P": 6.25,
        "MC_PITCH_P": 6.25,
        "MC_YAW_P": 2.25,
        "MC_ROLLRATE_P": 0.25,
    }
    bodies: list[Any] = []
    sight.page.on(
        "request", lambda each: bodies.append(each.post_data_json) if each.method == "PATCH" else None
    )
    before = {name: bench.px4.values[name] for name in wanted}
    for name, value in wanted.items():
        sight.stage(name, str(value))
    sight.send()
    for name in wanted:
        expect(sight.line(name)).to_contain_text("accepted")
    assert bodies == [{"values": dict(sorted(wanted.items()))}]
    assert {name: bench.px4.values[name] for name in wanted} == wanted
    bench.ask("PATCH", "/components/1/1/params?link=px4", {"values": before})


@needs_browser
def test_changes_whose_response_is_lost_may_have_been_written(sight: Sight) -> None:
    def lose(route: Route) -> None:
        if route.request.method == "PATCH":
            route.abort("connectionreset")
        else:
            route.continue_()

    sight.page.route("**/params?**", lose)
    sight.stage("MC_ROLL_P", "6.5")
    sight.stage("MC_PITCH_P", "6.5")
    sight.send()
    for name in ("MC_ROLL_P", "MC_PITCH_P"):
        expect(sight.line(name)).to_contain_text("sent, not acknowledged")
    expect(sight.spoken).to_contain_text("2 sent, not acknowledged.")
    sight.dialog.get_by_role("button", name="Done").click()
    expect(sight.bar).to_contain_text("2 changes staged")


@needs_browser
def test_an_invalid_value_is_not_staged_and_one_out_of_range_has_a_warning(sight: Sight) -> None:
    editor = sight.open("MC_ROLL_P")
    field = editor.get_by_role("textbox")
    field.fill("twelve")
    field.press("Enter")
    expect(editor.get_by_role("alert")).to_have_text(re.compile("Not a number"))
    field.fill("1e39")
    expect(editor.get_by_role("alert")).to_have_text(re.compile("more than a REAL32 holds"))
    field.fill("12.5")
    expect(editor).to_contain_text("Above the maximum of 12 1/s.")
    field.press("Escape")
    expect(sight.bar).to_be_hidden()


@needs_browser
def test_named_values_are_a_list_and_masks_are_boxes(sight: Sight, bench: Bench) -> None:
    editor = sight.open("NAV_RCL_ACT")
    editor.get_by_role("combobox").select_option("Land (3)")
    editor.get_by_role("combobox").press("Enter")
    editor = sight.open("EKF2_GPS_CTRL")
    before = int(bench.px4.values["EKF2_GPS_CTRL"])
    editor.get_by_role("checkbox", name="Heading").click()
    editor.get_by_role("checkbox", name="Heading").press("Enter")
    sight.send()
    expect(sight.line("NAV_RCL_ACT")).to_contain_text("3 Land")
    assert bench.px4.values["NAV_RCL_ACT"] == 3
    assert bench.px4.values["EKF2_GPS_CTRL"] == before ^ 8


@needs_browser
def test_wide_integers_keep_all_their_digits(sight: Sight) -> None:
    """JavaScript's numbers would round them."""
    texts = sight.page.evaluate(
        """async () => {
            const { parse, textOf } = await import("/page/values.js");
            return [textOf({ type: "INT64", value: 0, bits: "4000000000000001" }),
                textOf({ type: "INT64", value: 0, bits: "ffffffffffffffff" }),
                JSON.stringify(parse("4611686018427387907", "INT64").send),
                JSON.stringify(parse("-2", "INT64").send),
                parse("0x1F", "UINT8").send, parse("256", "UINT8").error];
        }"""
    )
    bits = '{"bits":"4000000000000003"}'
    assert texts == ["4611686018427387905", "-1", bits, "-2", 31, "UINT8 holds 0 to 255."]


@needs_browser
def test_an_armed_vehicle_wants_a_second_word(sight: Sight, bench: Bench) -> None:
    def arm(is_armed: bool) -> None:
        bench.px4.armed = is_armed

    try:
        sight.stage("MC_YAW_P", "2.5")
        sight.review()
        send = sight.dialog.get_by_role("button", name="Send")
        expect(send).to_be_enabled()
        bench.do(arm, True)  # during a review
        expect(sight.dialog.get_by_role("alert")).to_contain_text("The vehicle is armed.")
        expect(sight.page.locator("#badges")).to_contain_text("ARMED")
        expect(sight.spoken).to_contain_text("PX4 1/1 is armed.")
        expect(send).to_be_disabled()
        sight.dialog.get_by_role("checkbox", name="Send anyway").check()
        send.click()
        expect(sight.line("MC_YAW_P")).to_contain_text("accepted")
    finally:
        bench.do(arm, False)


# others


@needs_browser
def test_a_change_by_another_client_is_marked_and_keeps_the_focus(sight: Sight, bench: Bench) -> None:
    editor = sight.open("MC_YAWRATE_P")
    field = editor.get_by_role("textbox")
    field.fill("0.3")
    bench.ask("PATCH", "/components/1/1/params?link=px4", {"values": {"MC_YAWRATE_P": 0.4}})
    expect(editor).to_contain_text(re.compile(r"The vehicle now has 0\.4, by \w+"))
    expect(field).to_be_focused()
    expect(field).to_have_value("0.3")
    field.press("Escape")
    expect(sight.row("MC_YAWRATE_P")).to_have_class(re.compile("recent"))
    expect(sight.spoken).to_contain_text("MC_YAWRATE_P is 0.4 now")
    sight.find("")
    sight.page.get_by_role("button", name="Changed by others").click()
    expect(sight.row("MC_YAWRATE_P")).to_be_visible()
    sight.row("MC_YAWRATE_P").locator(".label").click()
    sight.grid.press("Space")
    expect(sight.details.get_by_role("listitem").first).to_contain_text("0.2 → 0.4")


@needs_browser
def test_parameters_that_appear_and_disappear_are_announced(
    visit: Callable[..., Sight], bench: Bench
) -> None:
    sight = visit(bench.url, "ArduPilot 2/1")
    sight.find("EK2_GPS_TYPE")
    bench.ask("PATCH", "/components/2/1/params?link=ardupilot", {"values": {"EK2_ENABLE": 1}})
    expect(sight.row("EK2_GPS_TYPE")).to_have_class(re.compile("recent"))
    expect(sight.spoken).to_contain_text("52 parameters were added.")
    bench.ask("PATCH", "/components/2/1/params?link=ardupilot", {"values": {"EK2_ENABLE": 0}})
    expect(sight.row("EK2_GPS_TYPE")).to_have_count(0)
    expect(sight.spoken).to_contain_text("52 parameters were removed.")


@needs_browser
def test_changes_that_a_load_overtakes_are_announced(sight: Sight) -> None:
    """Their events arrive while the table is loaded, or after a load that includes them."""
    announced = sight.page.evaluate(
        """async () => {
            const { store } = await import("/page/store.js");
            const { table, selected } = store;
            const said = [];
            store.on("recent", ({ row }) => said.push(`${row.name} ${row.recent.kind}`));
            const change = (seq, name, kind, value) => {
                const param = { name, value: 1, type: "INT32" };
                const [before, now] = { removed: [param, null], added: [null, param] }[kind] ?? [
                    param,
                    { ...param, value },
                ];
                store.takeChange(selected, { seq, name, kind, old: before, new: now, by: "vehicle" });
            };
            table.isLoaded = false;
            table.early = [];
            change(table.seq + 1, "MC_ROLL_P", "removed");
            change(table.seq + 2, "NEW_ONE", "added");
            table.keep();
            store.catchUp(selected);
            change(table.seq, "GONE_ONE", "removed");
            change(table.seq, "MC_PITCH_P", "added");
            change(table.seq, "MC_YAW_P", "changed", 2);
            change(table.seq, "MC_YAWRATE_P", "changed", 1);
            return [said, table.rows.has("MC_ROLL_P"), table.rows.has("NEW_ONE")];
        }"""
    )
    said = ["MC_ROLL_P removed", "NEW_ONE added", "GONE_ONE removed", "MC_PITCH_P added", "MC_YAW_P changed"]
    assert announced == [said, False, True]


@needs_browser
def test_each_table_is_loaded_again_by_its_own_events(sight: Sight) -> None:
    """After a load in progress, and only if its response lacks what the event reports."""
    loaded = sight.page.evaluate(
        """async () => {
            const { store } = await import("/page/store.js");
            const loaded = [];
            store.loadTable = async (key) => loaded.push(key);
            const pause = () => new Promise((resolve) => setTimeout(resolve, 400));
            Object.assign(store.tableOf("older"), { isLoaded: true, seq: 6 });
            Object.assign(store.tableOf("newer"), { isLoaded: true, seq: 7 });
            const loading = Object.assign(store.tableOf("loading"), { isLoading: true });
            for (const key of ["older", "newer", "loading", "older", "unknown"]) store.reload(key, 7);
            await pause();
            const before = [...loaded];
            Object.assign(loading, { isLoaded: true, isLoading: false, seq: 6 });
            store.reload("loading", -1);
            await pause();
            return [before, loaded];
        }"""
    )
    assert loaded == [["older"], ["older", "loading"]]


@needs_browser
def test_a_load_that_a_later_one_overtakes_changes_nothing(sight: Sight) -> None:
    state = sight.page.evaluate(
        """async () => {
            const { store } = await import("/page/store.js");
            const { table, selected } = store;
            const request = window.fetch;
            let count = 0;
            window.fetch = async (...options) => {
                const isFirst = count++ === 0;
                const response = await request(...options);
                if (isFirst) await new Promise((resolve) => setTimeout(resolve, 300));
                if (isFirst) throw new TypeError("lost");
                return response;
            };
            const loads = [store.loadTable(selected), store.loadTable(selected)];
            await Promise.all(loads);
            return [count, table.isLoaded, table.isLoading, table.rows.size];
        }"""
    )
    assert state == [2, True, False, 903]


@needs_browser
def test_a_stale_edit_says_so_in_the_review(sight: Sight, bench: Bench) -> None:
    sight.stage("MC_ROLLRATE_P", "0.2")
    bench.do(bench.px4.set_param, "MC_ROLLRATE_P", 0.25)
    expect(sight.row("MC_ROLLRATE_P")).to_contain_text("0.25 → 0.2")
    sight.review()
    expect(sight.line("MC_ROLLRATE_P")).to_contain_text("when you edited it")


@needs_browser
def test_an_open_review_follows_what_others_change(sight: Sight, bench: Bench) -> None:
    now, remark = (sight.line("MC_PITCHRATE_P").get_by_role("cell").nth(place) for place in (0, 2))
    was = str(bench.px4.param("MC_PITCHRATE_P").value)[:4]
    sight.stage("MC_PITCHRATE_P", "0.2")
    sight.review()
    expect(now).to_have_text(was)
    expect(remark).to_have_text("")
    bench.set("MC_PITCHRATE_P", 0.25)
    expect(now).to_have_text("0.25")
    expect(remark).to_have_text(f"It was {was} when you edited it.")
    bench.set("MC_PITCHRATE_P", 0.2)
    expect(remark).to_contain_text("The vehicle already has this value.")
    sight.dialog.get_by_role("button", name="Send").click()
    expect(sight.dialog.get_by_role("status")).to_have_text("1 accepted.")
    bench.set("MC_PITCHRATE_P", 0.3)
    expect(sight.row("MC_PITCHRATE_P")).to_contain_text("0.3")
    expect(remark).to_have_text("accepted")


@needs_browser
def test_a_table_that_cannot_be_loaded_anew_goes_on_from_what_was_known(sight: Sight, bench: Bench) -> None:
    def fail(route: Route) -> None:
        route.fulfill(status=503, content_type="application/problem+json", body="{}")

    sight.page.route(re.compile(r"/params\?"), fail, times=1)
    is_loaded = sight.page.evaluate(
        """async () => {
            const { store } = await import("/page/store.js");
            await store.loadTable(store.selected).catch(() => {});
            return store.table.isLoaded;
        }"""
    )
    assert is_loaded
    sight.find("MC_PITCHRATE_K")
    bench.set("MC_PITCHRATE_K", 1.25)
    expect(sight.row("MC_PITCHRATE_K")).to_contain_text("1.25")


@needs_browser
def test_an_open_plan_follows_what_others_change(sight: Sight, bench: Bench, tmp_path: Path) -> None:
    sight.find("NOTHING_SUCH")
    file = tmp_path / "other.param"
    file.write_text("MC_YAWRATE_P,0.9\n")
    sight.page.get_by_role("button", name="Compare").click()
    sight.dialog.locator("input[type=file]").set_input_files(file)
    expect(sight.row("MC_YAWRATE_P")).to_be_visible()  # what was searched for hides nothing of it
    sight.page.get_by_role("button", name="Take over").click()
    expect(sight.line("MC_YAWRATE_P")).to_be_visible()
    bench.set("MC_YAWRATE_P", 0.55)
    expect(sight.line("MC_YAWRATE_P").get_by_role("cell").nth(1)).to_have_text("0.55")
    sight.dialog.get_by_role("button", name="Apply").click()
    sight.dialog.get_by_role("button", name="Done").click()
    sight.page.get_by_role("button", name="Undo").click()
    expect(sight.line("MC_YAWRATE_P").get_by_role("cell").nth(1)).to_have_text("0.55")


# files, earlier states, other vehicles


@needs_browser
def test_a_file_is_compared_chosen_from_and_applied(sight: Sight, bench: Bench) -> None:
    values = bench.px4.values
    content = (
        "# Vehicle-Id Component-Id Name Value Type\n"
        "1\t1\tMC_PR_INT_LIM\t0.41\t9\n"
        "1\t1\tMC_RR_INT_LIM\t0.42\t9\n"
        "1\t1\tCAL_ACC0_XOFF\t0.5\t9\n"
        f"1\t1\tMC_AIRMODE\t{values['MC_AIRMODE']!r}\t6\n"
    )
    sight.page.get_by_role("button", name="Compare").click()
    sight.dialog.locator("input[type=file]").set_input_files(
        {"name": "tuned.params", "mimeType": "text/plain", "buffer": content.encode()}
    )
    banner = sight.page.get_by_role("region", name="Comparison")
    expect(banner).to_contain_text("Compared with tuned.params: 3 differ")
    expect(sight.page.locator("#count")).to_have_text("3 of 903")
    banner.get_by_role("button", name="Take over").click()
    expect(sight.dialog.get_by_role("button", name="Apply 2 values")).to_be_enabled()
    expect(sight.line("CAL_ACC0_XOFF").get_by_role("checkbox")).not_to_be_checked()
    expect(sight.line("CAL_ACC0_XOFF")).to_contain_text("left out")
    sight.line("MC_RR_INT_LIM").get_by_role("checkbox").uncheck()
    sight.dialog.get_by_role("button", name="Apply 1 value").click()
    expect(sight.line("MC_PR_INT_LIM")).to_contain_text("accepted")
    sight.dialog.get_by_role("button", name="Done").click()
    expect(banner).to_contain_text("2 differ")
    now = bench.px4.values
    assert now["MC_PR_INT_LIM"] == pytest.approx(0.41)
    assert (now["MC_RR_INT_LIM"], now["CAL_ACC0_XOFF"]) == (values["MC_RR_INT_LIM"], values["CAL_ACC0_XOFF"])


@needs_browser
def test_a_file_of_changed_names_is_used_in_the_plan_and_in_the_apply(sight: Sight, bench: Bench) -> None:
    content = "1\t1\tOLD_PITCH_MAX\t0.42\t9\n"
    sight.page.get_by_role("button", name="Compare").click()
    sight.dialog.locator("input[type=file]").set_input_files(
        {"name": "old.params", "mimeType": "text/plain", "buffer": content.encode()}
    )
    sight.page.get_by_role("button", name="Take over").click()
    expect(sight.line("OLD_PITCH_MAX")).to_contain_text("cannot be set")
    names = sight.dialog.locator("#renames")
    names.set_input_files({"name": "n.json", "mimeType": "application/json", "buffer": b'[{"old": "A"}]'})
    expect(sight.dialog.get_by_role("alert")).to_contain_text("n.json")
    rules = b'[{"old": "OLD_PITCH_MAX", "new": "MC_PITCHRATE_MAX", "factor": 100}]'
    names.set_input_files({"name": "n.json", "mimeType": "application/json", "buffer": rules})
    expect(sight.dialog.get_by_role("alert")).to_have_text("")
    expect(sight.line("OLD_PITCH_MAX")).to_contain_text("here MC_PITCHRATE_MAX")
    sight.dialog.get_by_role("button", name="Apply 1 value").click()
    expect(sight.line("OLD_PITCH_MAX")).to_contain_text("accepted")
    sight.dialog.get_by_role("button", name="Done").click()
    assert bench.px4.values["MC_PITCHRATE_MAX"] == 42


@needs_browser
def test_a_file_that_is_no_parameter_file_is_reported(sight: Sight) -> None:
    sight.page.get_by_role("button", name="Compare").click()
    sight.dialog.locator("input[type=file]").set_input_files(
        {"name": "photo.jpg", "mimeType": "image/jpeg", "buffer": bytes(range(256))}
    )
    expect(sight.dialog.get_by_role("alert")).to_contain_text("photo.jpg")


@needs_browser
def test_an_earlier_state_is_kept_and_gone_back_to(sight: Sight, bench: Bench) -> None:
    sight.page.get_by_role("button", name="Snapshot").click()
    expect(sight.page.get_by_text("Snapshot created. Compare shows it.")).to_be_visible()
    before = bench.px4.values["MC_YAWRATE_MAX"]
    bench.set("MC_YAWRATE_MAX", 123.0)
    sight.find("MC_YAWRATE_MAX")
    expect(sight.value("MC_YAWRATE_MAX")).to_contain_text("123.0")
    sight.page.get_by_role("button", name="Compare").click()
    sight.dialog.get_by_role("button", name=re.compile("kept by hand")).first.click()
    expect(sight.row("MC_YAWRATE_MAX")).to_contain_text(repr(before))
    sight.row("MC_YAWRATE_MAX").locator(".label").click()
    sight.grid.press("t")
    sight.send()
    assert bench.px4.values["MC_YAWRATE_MAX"] == before


@needs_browser
def test_two_vehicles_are_compared(sight: Sight) -> None:
    sight.page.get_by_role("button", name="Compare").click()
    sight.dialog.get_by_role("button", name="ArduPilot 2/1").click()
    banner = sight.page.get_by_role("region", name="Comparison")
    expect(banner).to_contain_text(re.compile(r"only here, \d+ only there"))
    banner.get_by_role("button", name="End the comparison").click()
    expect(banner).to_be_hidden()


@needs_browser
def test_the_table_is_saved_as_a_file(sight: Sight, bench: Bench) -> None:
    sight.page.get_by_role("button", name="Save").click()
    with sight.page.expect_download() as saved:
        sight.dialog.get_by_role("button", name="QGroundControl").click()
    text = saved.value.path().read_text()
    assert sum(line.startswith("1\t1\t") for line in text.splitlines()) == len(bench.px4.values)


# by hand and by ear


@needs_browser
def test_the_page_is_usable_by_keyboard(sight: Sight, bench: Bench) -> None:
    keyboard = sight.page.keyboard
    keyboard.press("/")
    expect(sight.search).to_be_focused()
    keyboard.type("MC_ACRO_R_MAX")
    keyboard.press("Enter")
    expect(sight.grid).to_be_focused()
    keyboard.press("Enter")
    expect(sight.editor.get_by_role("textbox")).to_be_focused()
    keyboard.press("Control+a")
    keyboard.type("200")
    keyboard.press("ArrowUp")
    keyboard.press("Enter")
    expect(sight.grid).to_be_focused()
    keyboard.press("Control+Enter")
    expect(sight.dialog.get_by_role("button", name="Send 1 change")).to_be_focused()
    keyboard.press("Enter")
    expect(sight.dialog.get_by_role("button", name="Done")).to_be_focused()
    keyboard.press("Enter")
    assert bench.px4.values["MC_ACRO_R_MAX"] == pytest.approx(200.1)
    expect(sight.grid).to_be_focused()
    keyboard.press("Control+z")
    expect(sight.dialog.get_by_role("button", name="Send 1 change")).to_be_focused()
    keyboard.press("Escape")
    expect(sight.dialog).to_be_hidden()
    expect(sight.grid).to_be_focused()
    keyboard.press("u")
    expect(sight.row("MC_ACRO_R_MAX")).not_to_have_class(re.compile("pending"))
    keyboard.press("g")
    expect(sight.page.get_by_role("button", name=re.compile("^All groups"))).to_be_focused()
    keyboard.press("ArrowDown")
    keyboard.press("?")
    expect(sight.dialog.get_by_role("heading", name="Keys")).to_be_visible()


@needs_browser
def test_the_grid_has_accessible_names_and_positions(sight: Sight) -> None:
    sight.grid.focus()
    sight.grid.press("ArrowDown")
    active = sight.grid.get_attribute("aria-activedescendant")
    row = sight.page.locator(f"#{active}")
    expect(row).to_have_attribute("aria-selected", "true")
    expect(row).to_have_attribute("aria-rowindex", "3")
    unnamed = sight.page.evaluate(
        """() => [...document.querySelectorAll("button, input, select, a, dialog, nav, run_in_thread")]
            .filter((each) => each.checkVisibility())
            .filter((each) => !(each.textContent.trim() || each.ariaLabel || each.labels?.length
                || each.getAttribute("aria-labelledby")))
            .map((each) => each.outerHTML)"""
    )
    assert unnamed == []


@needs_browser
def test_dark_and_light_by_the_system_and_by_choice(visit: Callable[..., Sight], bench: Bench) -> None:
    sight = visit(bench.url, color_scheme="dark")
    root = sight.page.locator("html")
    expect(root).to_have_attribute("data-theme", "dark")
    sight.page.get_by_role("button", name="Dark or light").click()
    expect(root).to_have_attribute("data-theme", "light")
    sight.page.reload()
    expect(root).to_have_attribute("data-theme", "light")


@needs_browser
def test_on_a_phone(visit: Callable[..., Sight], bench: Bench) -> None:
    sight = visit(bench.url, viewport=PHONE, has_touch=True, is_mobile=True)
    assert sight.page.evaluate("document.documentElement.scrollWidth") == PHONE["width"]
    small = sight.page.evaluate(
        """() => [...document.querySelectorAll("button, select, input")]
            .filter((each) => each.checkVisibility() && each.getBoundingClientRect().height < 36)
            .map((each) => each.textContent || each.ariaLabel)"""
    )
    assert small == []
    sight.find("MC_PITCHRATE_MAX")
    sight.row("MC_PITCHRATE_MAX").tap()
    sight.details.get_by_role("textbox").fill("150")
    sight.details.get_by_role("button", name="Stage").tap()
    expect(sight.details).to_be_hidden()
    sight.bar.get_by_role("button", name="Review").tap()
    sight.dialog.get_by_role("button", name="Send 1 change").tap()
    expect(sight.line("MC_PITCHRATE_MAX")).to_contain_text("accepted")
    assert bench.px4.values["MC_PITCHRATE_MAX"] == 150.0


# the service


@needs_browser
def test_a_service_that_restarts(visit: Callable[..., Sight], tmp_path: Path) -> None:
    with at_work(tmp_path) as first:
        until(lambda: first.is_synced(1))
        sight = visit(first.url)
        sight.stage("MC_ROLL_P", "7.5")
        port = urlsplit(first.url).port
    expect(sight.page.get_by_text("The service does not respond.")).to_be_visible()
    with at_work(tmp_path, port=port or 0) as second:
        second.do(second.px4.set_param, "MC_PITCH_P", 3.25)
        expect(sight.page.get_by_text("The service does not respond.")).to_be_hidden()
        sight.find("MC_PITCH_P")
        expect(sight.value("MC_PITCH_P")).to_contain_text("3.25")
        sight.send()  # what was staged has waited
        assert second.px4.values["MC_ROLL_P"] == 7.5


@needs_browser
def test_a_vehicle_of_yesterday_is_looked_at(visit: Callable[..., Sight], tmp_path: Path) -> None:
    _keep_yesterdays(tmp_path)
    with at_work(tmp_path) as bench:
        until(lambda: bench.is_synced(1))
        sight = visit(bench.url)
        sight.page.get_by_text("Not connected").click()
        kept = sight.page.get_by_role("list", name="Vehicles that are not connected").get_by_role("button")
        expect(kept).to_have_count(1)
        kept.click()
        expect(sight.page.get_by_role("heading", level=1)).to_have_text("PX4 9/1")
        expect(sight.page.locator("#badges")).to_contain_text("in the cache, heard last")
        expect(sight.page.locator("#count")).to_have_text("25 parameters")
        expect(sight.page.get_by_role("button", name="Fetch")).to_have_count(0)
        expect(sight.page.get_by_role("button", name="Snapshot")).to_have_count(0)
        sight.find("PARAM_01")
        sight.value("PARAM_01").click()
        expect(sight.details).to_contain_text("1 → 77")
        expect(sight.details.get_by_role("textbox")).to_have_count(0)
        sight.page.get_by_role("button", name="Compare").click()
        sight.dialog.get_by_role("button", name="PX4 1/1").click()
        expect(sight.page.get_by_role("region", name="Comparison")).to_contain_text("25 only here")
        expect(sight.page.get_by_role("button", name="Take over")).to_have_count(0)
        sight.page.get_by_role("button", name="Save").click()
        with sight.page.expect_download() as saved:
            sight.dialog.get_by_role("button", name="QGroundControl").click()
        assert "9\t1\tPARAM_01\t77\t" in saved.value.path().read_text()
        sight.page.keyboard.press("Escape")
        sight.choose("PX4 1/1")
        expect(sight.page.get_by_role("button", name="Fetch all parameters")).to_be_visible()


def _keep_yesterdays(folder: Path) -> None:
    async def fetch() -> None:
        vehicle = PX4Vehicle(system=9, table={f"PARAM_{number:02}": number for number in range(25)})
        with ParamCache(folder / "cache.sqlite3") as cache:
            async with ParamClient(SimLink(vehicle), cache=cache) as client:
                await (await client.component()).fetch_all()
            async with ParamClient(SimLink(vehicle), cache=cache) as client:
                await (await client.component()).set("PARAM_01", 77)

    with start_blocking_portal() as portal:  # the browser has a loop in this thread
        portal.call(fetch)


@needs_browser
def test_a_forgotten_vehicle_stays_in_view(sight: Sight) -> None:
    """One that the service forgets, as when its link fails, stays in view, and what was staged waits."""
    sight.stage("MC_ROLL_P", "7.5")
    sight.page.evaluate(
        """async () => {
            const { store } = await import("/page/store.js");
            const px4 = { link: "px4", system: 1, component: 1 };
            store.take({ type: "component", why: "forgotten", seq: Infinity, ...px4 });
        }"""
    )
    expect(sight.page.locator("#badges")).to_have_text("lost")
    expect(sight.page.get_by_role("heading", level=1)).to_have_text("PX4 1/1")
    expect(sight.bar).to_contain_text("1 change staged")


@needs_browser
def test_a_token_is_requested_and_a_reader_sees_that_it_may_only_read(
    visit: Callable[..., Sight], tmp_path: Path
) -> None:
    reader, writer = "r" * 32, "w" * 32
    tokens = Tokens.of_text(f"visitor read {reader}\npilot write {writer}\n")
    with at_work(tmp_path, Settings(access=AccessSettings(tokens=tokens))) as bench:
        bench.token = reader
        until(lambda: bench.is_synced(1))
        sight = visit(bench.url, None)
        field = sight.dialog.get_by_label("Token")
        field.fill("x" * 32)
        field.press("Enter")
        expect(sight.dialog.get_by_role("alert")).to_have_text("The token is not valid for this service.")
        field.fill(reader)
        field.press("Enter")
        expect(sight.page.locator("#role")).to_have_text("read-only")
        sight.find("MC_ROLL_P")
        sight.value("MC_ROLL_P").click()
        expect(sight.details).to_contain_text("REAL32")
        expect(sight.details.get_by_role("textbox")).to_have_count(0)
        expect(sight.page.get_by_role("button", name="Snapshot")).to_have_count(0)
        sight.page.reload()  # the token is in a cookie, which no script can read
        expect(sight.page.locator("#role")).to_have_text("read-only")
        assert sight.page.evaluate("document.cookie + JSON.stringify(localStorage)").find(reader) < 0


@needs_browser
def test_after_a_gap_everything_is_loaded_anew(sight: Sight) -> None:
    """Also where the service is another run, or has forgotten what was missed."""
    begun = sight.page.evaluate(
        """async () => {
            const { Stream } = await import("/page/api.js");
            const begun = [];
            const stream = new Stream({
                begin: () => begun.push("begin"),
                take: (event) => begun.push(event.type),
                changed: () => {},
            });
            const hello = (run, resumed) => ({ type: "hello", run, resumed });
            const change = { type: "change" };
            for (const event of [
                hello("a", false), change, hello("a", true), { type: "gap", missed: 3 }, change,
                hello("a", false), hello("b", true),
            ]) stream.receive(event);
            return begun;
        }"""
    )
    assert begun == ["begin", "change", "begin", "change", "begin", "begin"]


# extended parameters


@pytest.fixture
def camera(tmp_path: Path) -> Iterator[tuple[Bench, Camera]]:
    """A service with a camera among its vehicles."""
    table: ExtEntries = {
        "CLOCK": (ExtParamType.INT64, -(2**53) - 1),
        "SIZE": (ExtParamType.UINT64, 2**64 - 1),
        "MODE": (ExtParamType.UINT8, 1),
        "EV": 0.5,
        "NAME": "Front <b>camera</b>",
        "KEY": b"\xff\x00\xfe",
        "<iframe/>": "one\ntwo",
    }
    vehicle = Camera(table, system=4, supported={"MODE": [1, 2]}, failing=["EV"])
    with at_work(tmp_path, more={"camera": SimVehicle(vehicle)}) as bench:
        until(lambda: any(each["system"] == 4 for each in bench.ask("GET", "/components")["components"]))
        yield bench, vehicle


def opened(sight: Sight) -> None:
    """Open the extended parameters of the selected component."""
    sight.page.get_by_role("button", name="Extended parameters of the component").click()
    expect(sight.dialog).to_contain_text("Extended parameters of")


@needs_browser
def test_extended_parameters_are_shown_and_set(
    visit: Callable[..., Sight], camera: tuple[Bench, Camera]
) -> None:
    bench, vehicle = camera
    sight = visit(bench.url)
    offer = sight.page.get_by_role("button", name="Extended parameters of the component")
    expect(offer).to_be_hidden()
    sight.page.get_by_role("navigation").get_by_role("button", name="4/100").click()
    opened(sight)
    expect(sight.dialog).to_contain_text("None are known yet.")
    sight.dialog.get_by_role("button", name="Fetch all").click()
    expect(sight.dialog).to_contain_text("7 extended parameters")

    def field(name: str) -> Locator:
        return sight.dialog.get_by_label(f"Value of {name}", exact=True)

    def put(name: str, text: str) -> Locator:
        field(name).fill(text)
        sight.dialog.get_by_role("button", name=f"Set {name}", exact=True).click()
        return sight.line(name).locator(".remark")

    for name, text in {
        "CLOCK": "-9007199254740993",
        "SIZE": "18446744073709551615",
        "MODE": "1",
        "EV": "0.5",
        "NAME": "Front <b>camera</b>",
        "KEY": "hex:ff00fe",
        "<iframe/>": "one\ntwo",
    }.items():
        expect(field(name)).to_have_value(text)
    values = vehicle.ext_values
    expect(put("CLOCK", "9007199254740995")).to_have_text("accepted")
    expect(put("SIZE", "0x8000000000000001")).to_have_text("accepted")
    expect(field("SIZE")).to_have_value(str(2**63 + 1))
    expect(put("NAME", "Rear, \u00fc")).to_have_text("accepted")
    expect(put("KEY", "hex:80 01")).to_have_text("accepted")
    expect(put("<iframe/>", "three\nfour")).to_have_text("accepted")
    assert vehicle.ext_values == values | {
        "CLOCK": 2**53 + 3,
        "SIZE": 2**63 + 1,
        "NAME": "Rear, \u00fc",
        "KEY": b"\x80\x01",
        "<iframe/>": "three\nfour",
    }
    expect(put("MODE", "9")).to_contain_text("refused: 4/100 did not set MODE to 9: value unsupported")
    expect(field("MODE")).to_have_value("9")
    expect(put("MODE", "256")).to_contain_text("UINT8 holds 0 to 255")
    expect(put("KEY", "hex:0")).to_contain_text("pairs of hexadecimal digits")
    expect(put("EV", "1.5")).to_contain_text("refused")
    assert vehicle.ext_values["MODE"] == 1
    field("MODE").fill("2")
    field("MODE").press("Enter")
    expect(sight.line("MODE").locator(".remark")).to_have_text("accepted")
    expect(sight.spoken).to_contain_text("MODE: accepted")


@needs_browser
def test_extended_parameters_follow_what_others_change(
    visit: Callable[..., Sight], camera: tuple[Bench, Camera]
) -> None:
    bench, vehicle = camera
    bench.ask("POST", "/components/4/100/extended/fetch", {})
    sight = visit(bench.url)
    sight.page.get_by_role("navigation").get_by_role("button", name="4/100").click()
    opened(sight)
    name = sight.dialog.get_by_label("Value of NAME")
    expect(name).to_have_value("Front <b>camera</b>")
    bench.ask("PATCH", "/components/4/100/extended/params", {"values": {"NAME": "Rear", "MODE": 2}})
    expect(name).to_have_value("Rear")
    expect(sight.line("MODE").locator(".remark")).to_have_text("now 2, by local")
    name.fill("typed")
    bench.ask("PATCH", "/components/4/100/extended/params", {"values": {"NAME": "Top"}})
    expect(sight.line("NAME").locator(".remark")).to_have_text("now Top, by local")
    expect(name).to_have_value("typed")
    bench.do(vehicle.remove_ext_param, "MODE")
    bench.do(vehicle.add_ext_param, "NEW", "text")
    bench.ask("POST", "/components/4/100/extended/fetch", {})
    expect(sight.line("MODE")).to_be_hidden()
    expect(sight.dialog.get_by_label("Value of NEW")).to_have_value("text")


@needs_browser
def test_who_may_only_read_sees_extended_values(visit: Callable[..., Sight], tmp_path: Path) -> None:
    vehicle = Camera({"NAME": "Front"}, system=4)
    settings = Settings(access=AccessSettings(read_only=True))
    with at_work(tmp_path, settings, more={"camera": SimVehicle(vehicle)}) as bench:
        until(lambda: any(each["system"] == 4 for each in bench.ask("GET", "/components")["components"]))
        bench.ask("POST", "/components/4/100/extended/fetch", {})
        sight = visit(bench.url)
        sight.page.get_by_role("navigation").get_by_role("button", name="4/100").click()
        opened(sight)
        expect(sight.line("NAME")).to_contain_text("Front")
        expect(sight.dialog.get_by_role("button", name="Set NAME")).to_be_hidden()
        expect(sight.dialog.get_by_role("textbox")).to_have_count(0)
