"""The page in a real browser: Chromium of the system, driven by playwright, on a running emulator."""

import json
import math
import re
import socket
import subprocess
import urllib.error
import urllib.request

import pytest

from starhil.hil_tests.rig.emulator_process import EmulatorProcess, emulator_command, installed_command
from tests.emulator.console.browser import (
    MARKS,
    command,
    opened,
    still,
    track,
    wait_for_text,
)
from tests.process.conftest import NO_IMAGES
from tests.waiting import PATIENCE_S

pytestmark = MARKS


@pytest.fixture
def own_page(browser, emulator):
    """A page that a test leaves or changes for good."""
    with opened(browser, emulator.ready["view"]) as page:
        yield page


NOTE = "#telecommand-form [data-note=value]"
"""What is said beside the value for a parameter."""


def send(page, name, **values):
    """Send a telecommand through its form; return the outcome that the page shows."""
    page.click("[data-tab=telecommands]")
    page.select_option("#telecommand", name)
    for key, value in values.items():
        field = page.locator(f"#telecommand-form [name={key}]")
        if field.evaluate("element => element.tagName") == "SELECT":
            field.select_option(str(value))
        else:
            field.fill(str(value))
    count = page.locator("#sent li").count()
    page.click("#send")
    page.wait_for_function("count => document.querySelectorAll('#sent li').length > count", arg=count)
    return page.locator("#sent li .outcome").first.text_content()


VALUES = "row => Object.fromEntries([...document.querySelectorAll(`[data-row=${row}] tr`)].map(tr => [tr.cells[0].textContent, tr.cells[1].textContent]))"
"""Reads the values of a row as the page shows them."""


def telemetry(page, row, **expected):
    """Return the values of a row as the page shows them, once some of them are as expected."""
    page.click("[data-tab=telemetry]")
    page.fill("#telemetry input[type=search]", row)
    page.wait_for_function(
        f"([row, expected]) => Object.entries(expected).every(([name, text]) => ({VALUES})(row)[name] === text)",
        arg=[row, expected],
    )
    return page.evaluate(VALUES, row)


def test_lost_in_space_is_commanded_in_the_form_and_the_attitude_shown_is_that_of_telemetry(page):
    for mode in ("standby", "lost_in_space"):
        assert send(page, "set_mode", mode=mode).startswith("accepted in ")
    wait_for_text(page, "#mode", "tracking")
    wait_for_text(page, "#validity", "valid")
    page.wait_for_function("() => starhil.sky.painted > 0")
    values = telemetry(page, "precise_attitude", valid="yes", mode="tracking")
    shown = page.evaluate("Object.fromEntries(Object.entries(document.getElementById('ra').dataset))")
    read = [float(values[f"q_{name}"].replace("−", "-")) for name in "xyzw"]
    seen = [float(shown[f"q{name}"]) for name in "xyzw"]
    turn = 2.0 * math.dist(read, seen)  # rad, for attitudes this near to each other
    assert math.degrees(turn) * 3600.0 < 15.0  # some frames apart at most, each with its noise
    assert abs(float(page.locator("#ra").text_content().strip("° ").replace("−", "-")) - 83.8) < 0.01


def test_a_covered_lens_is_flagged_within_three_frames_and_the_attitude_recovers(page):
    newest = "() => starhil.store.rows.at(starhil.store.rows.end - 1, 'frame')"
    page.click("[data-tab=faults]")
    before = page.evaluate(newest)
    page.click("#cover")
    wait_for_text(page, "#cover", "Uncover the lens")
    covered = page.evaluate(newest)
    wait_for_text(page, "#validity", "too few stars")
    flagged = page.evaluate(
        """before => {
            const { rows } = starhil.store;
            for (let position = rows.start; position < rows.end; position++) {
                if (rows.at(position, "frame") > before && !rows.at(position, "valid")) return rows.at(position, "frame");
            }
        }""",
        before,
    )
    assert flagged <= covered + 3
    assert page.locator("#active").text_content() == "1 fault"
    page.click("#clear-faults")
    wait_for_text(page, "#validity", "valid")
    wait_for_text(page, "#active", "no fault")


def test_in_error_mode_no_attitude_is_shown_and_the_last_image_has_its_age(page):
    page.wait_for_function("() => starhil.sky.painted > 0")
    page.evaluate("starhil.link.control({ do: 'fault', device: { error: 'sensor' } })")
    wait_for_text(page, "#mode", "error: sensor")
    wait_for_text(page, "#validity", "no images")
    wait_for_text(page, "#error-label", "Last valid")
    assert {page.locator(f"#{name}").text_content() for name in ("ra", "dec", "roll")} == {"–"}
    page.wait_for_function(
        "() => /^image of [1-9][0-9]* s ago$/.test(document.getElementById('when').textContent)"
    )
    stage = page.locator(".stage").evaluate("element => getComputedStyle(element).filter")
    assert stage == "grayscale(1)"
    page.wait_for_function("() => starhil.charts.to > starhil.store.now + 1")
    labels = page.evaluate(
        "(() => { const [time] = starhil.charts.plots.at(-1).u.axes; return time.values(null, time.splits()); })()"
    )
    assert labels == ["−60 s", "−50 s", "−40 s", "−30 s", "−20 s", "−10 s", "0"]
    assert send(page, "set_mode", mode="standby").startswith("accepted in ")


@still
def test_a_wrong_parameter_shows_the_refusal(page):
    assert send(page, "set_update_rate", rate=500) == "refused: invalid_parameter"
    problem = page.locator("#telecommand-form .problem").text_content()
    assert "500.0 is outside 0.01 to 100 Hz" in problem
    assert page.locator("#bytes").text_content().splitlines() == [
        "serial   1F 7F 61 00 00 FA 43 1F FF",
        "as this console:",
        "cansend vcan0 0161FD04#0000FA43",
        "as OBC 1:",
        "cansend vcan0 01610104#0000FA43",
    ]


@still
def test_the_present_value_of_a_parameter_is_shown_with_its_unit_and_follows_the_telecommand(page):
    for value in (200, 100):
        assert send(page, "set_parameter", parameter=1, value=value).startswith("accepted in ")
        wait_for_text(page, NOTE, f"now {value} ms\n1 … 5000")
    command(page, "set_parameter", parameter=1, value=150)  # as another OBC would
    wait_for_text(page, NOTE, "now 150 ms\n1 … 5000")
    page.select_option("#telecommand-form [name=parameter]", "13")
    page.wait_for_function(
        "selector => document.querySelector(selector).textContent.includes(' px\\n')", arg=NOTE
    )


@still
def test_a_value_about_to_be_replaced_is_replaced_although_the_parameter_changes_meanwhile(page):
    command(page, "set_parameter", parameter=1, value=150)
    page.click("[data-tab=telecommands]")
    page.select_option("#telecommand", "set_parameter")
    page.select_option("#telecommand-form [name=parameter]", "1")
    wait_for_text(page, NOTE, "now 150 ms\n1 … 5000")
    field = page.locator("#telecommand-form [name=value]")
    field.select_text()
    command(page, "set_parameter", parameter=1, value=100)
    wait_for_text(page, NOTE, "now 100 ms\n1 … 5000")
    page.keyboard.insert_text("200")
    assert field.input_value() == "200"


@still
def test_a_page_for_viewing_only_has_no_control_that_commands(browser, emulator):
    opened = browser.new_page(viewport={"width": 1280, "height": 720})
    opened.set_default_timeout(1000 * PATIENCE_S)
    opened.goto(emulator.ready["view_only"])
    wait_for_text(opened, "#link", "view only")
    for tab in ("telemetry", "telecommands", "faults", "truth"):
        opened.click(f"[data-tab={tab}]")
        buttons = opened.evaluate(
            "tab => [...document.querySelectorAll(`#${tab} button:not(.fold)`)].filter((each) => each.checkVisibility()).map((each) => each.textContent)",
            tab,
        )
        assert set(buttons) <= {"save as session"}, tab
    opened.click("[data-tab=telecommands]")
    opened.select_option("#telecommand", "set_update_rate")
    opened.wait_for_function("() => document.getElementById('bytes').textContent.includes('cansend')")
    for tab in ("telecommands", "faults", "truth"):
        opened.click(f"[data-tab={tab}]")
        fields = opened.evaluate(
            "tab => [...document.querySelectorAll(`#${tab} .commands :is(input, select:not(#telecommand), textarea)`)].map((each) => each.matches(':disabled'))",
            tab,
        )
        assert fields, tab
        assert all(fields), tab
    opened.close()


@still
def test_what_was_sent_is_saved_and_run_as_a_session(own_page, emulator, tmp_path):
    own_page.click("[data-tab=telecommands]")
    own_page.click("#clear-session")
    own_page.wait_for_function("() => document.querySelectorAll('#sent li').length === 0")
    send(own_page, "set_mode", mode="standby")
    send(own_page, "set_mode", mode="lost_in_space")
    send(own_page, "set_update_rate", rate=500)
    with own_page.expect_download() as download:
        own_page.click("#save-session")
    path = tmp_path / "session.toml"
    download.value.save_as(path)
    command = [
        installed_command(), "session", str(path), "--can", emulator.ready["can"], "--json", "--log", str(tmp_path / "log"),
        "--view", emulator.ready["view"],
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE_S)
    assert done.returncode == 0, done.stdout + done.stderr
    steps = [
        item["name"] for item in json.loads(done.stdout)["results"] if not item["name"].startswith("wait")
    ]
    assert len(steps) == 3
    own_page.goto(emulator.ready["view"].replace("/?", "/runs?"))
    own_page.wait_for_function("() => document.querySelectorAll('#results tr.passed').length >= 3")
    assert own_page.locator("#title").text_content() == "Recorded in the console"
    assert own_page.locator("#list button").first.get_attribute("data-state") == "good"


def test_the_page_can_be_paused_scrubbed_and_set_live_again_by_keys(page):
    page.wait_for_function(  # while images are rare there are rows without a frame between them
        "() => { const { rows } = starhil.store; return [1, 2, 3].every((back) => rows.at(rows.end - back, 'frame') === rows.at(rows.end - 1, 'frame') + 1 - back); }"
    )
    page.keyboard.press("Space")
    page.wait_for_selector("body.paused")
    frame = "starhil.store.rows.at(starhil.store.position, 'frame')"
    before = page.evaluate(frame)
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("ArrowLeft")
    assert page.evaluate(frame) == before - 2
    page.wait_for_function(  # the image nearest to that moment: a busy page has not got all of them
        "() => starhil.sky.shown === starhil.store.image && Math.abs(starhil.sky.shown.time - starhil.store.cursor) <= 0.5"
    )
    page.keyboard.press("Space")
    page.wait_for_function(f"() => {frame} > {before}")
    assert not page.locator("body.paused").count()


def test_stars_pan_and_time_by_keys_wherever_the_focus_is_in_their_part(page):
    page.focus("#sky [data-layer=matched]")
    page.keyboard.press("n")
    first = page.locator("#hover").text_content()
    painted = page.evaluate("starhil.sky.painted")
    page.wait_for_function("painted => starhil.sky.painted >= painted + 3", arg=painted)
    assert page.locator("#hover").is_visible()  # the next images leave it chosen
    assert page.locator("#hover").text_content().splitlines()[0] == first.splitlines()[0]
    left = page.evaluate("starhil.sky.pointer[0]")
    page.keyboard.press("n")
    assert page.evaluate("starhil.sky.pointer[0]") > left
    page.keyboard.press("+")
    across, down = page.evaluate("starhil.sky.offset")
    page.keyboard.press("Shift+ArrowRight")
    page.keyboard.press("Shift+ArrowUp")
    panned = page.evaluate("starhil.sky.offset")
    assert panned[0] > across
    assert panned[1] < down
    page.keyboard.press("0")
    page.focus("#add-plot")
    page.keyboard.press("PageUp")
    page.wait_for_selector("body.paused")
    page.keyboard.press("End")
    page.wait_for_selector("body:not(.paused)")


@still
def test_the_page_paints_at_once_and_every_tab_opens_in_both_themes(page):
    paint = page.evaluate("performance.getEntriesByType('paint')[0].startTime")
    assert paint > 0
    for _ in range(2):
        for tab in ("telemetry", "telecommands", "wire", "events", "faults", "truth"):
            page.click(f"[data-tab={tab}]")
            assert page.locator(f"#{tab}").is_visible()
        page.click("#theme")


@still
def test_content_fits_the_window_at_any_size(page):
    for width, height in ((1280, 720), (1280, 800), (1600, 1000), (1920, 1080), (3840, 2160)):
        page.set_viewport_size({"width": width, "height": height})
        boxes = page.evaluate(
            """() => ["top", "sky", "map", "charts", "side", "help", "theme"].map((id) => {
                const box = document.getElementById(id).getBoundingClientRect();
                return [id, box.left, box.top, box.right, box.bottom];
            })"""
        )
        for name, left, top, right, bottom in boxes:
            assert left >= 0, (name, width)
            assert top >= 0, (name, width)
            assert right <= width + 0.5, (name, width, right)
            assert bottom <= height + 0.5, (name, height, bottom)


@still
def test_the_page_keeps_eight_hours_of_frames_in_bounded_memory(page):
    """Frames as of eight hours at 5 Hz pass through a store of the page's kind, which nobody draws from."""
    kept = page.evaluate(
        """() => {
            const { hello } = starhil.store;
            const store = new starhil.store.constructor();
            store.message(hello);
            const blob = new Blob([new Uint8Array(16)]);
            const width = hello.columns.length;
            const block = (row) => {
                const bytes = new ArrayBuffer(16 + 4 * (width - 2));
                new Float64Array(bytes, 0, 2).set(row.slice(0, 2));
                return bytes;
            };
            const begin = store.now + 1;
            let most = 0;
            for (let number = 0; number < 8 * 3600 * 5; number++) {
                const row = new Array(width).fill(0);
                row[0] = begin + number / 5;
                store.rows.read(block(row), 0, number, 1);
                if (number % 5 === 0) {
                    store.images.push({ time: row[0], head: { row }, blob });
                    store.thin(row[0]);
                    most = Math.max(most, store.images.length);
                }
            }
            return { rows: store.rows.length, numbers: store.rows.data[0].length, most };
        }"""
    )
    assert kept["rows"] == 36_000
    assert kept["numbers"] == 36_000
    assert kept["most"] <= 62 + 721


def test_an_image_that_cannot_be_decoded_is_said_and_the_next_one_is_shown(page):
    page.wait_for_function("() => starhil.sky.painted > 0")
    text, painted = page.evaluate(
        """async () => {
            const { store, sky } = starhil;
            for (let turns = 0; sky.decoding && turns < 1000; turns++) await new Promise((resolve) => setTimeout(resolve, 10));
            const { time, head } = store.image;
            store.images.push({ time: time + 1e-6, head, blob: new Blob([new Uint8Array(16)]) });
            await sky.show();
            return [sky.notice.innerText, sky.painted];
        }"""
    )
    assert text == "this image cannot be decoded"
    page.wait_for_function("painted => starhil.sky.painted > painted", arg=painted)
    assert not page.locator("#no-frame").is_visible()


def test_a_page_that_connects_to_another_run_shows_nothing_of_the_run_before(own_page):
    track(own_page)
    own_page.wait_for_function("() => starhil.sky.painted > 0")
    *attitude, image = own_page.evaluate(
        """async () => {
            const { store, sky } = starhil;
            for (let turns = 0; sky.decoding && turns < 1000; turns++) await new Promise((resolve) => setTimeout(resolve, 10));
            store.addImage = () => {};
            store.read = (buffer, offset, first, count) => offset + 16 * count + 4 * (store.hello.columns.length - 2) * count;
            store.message({ ...store.hello, run_id: "another" });
            for (let turns = 0; sky.decoding && turns < 1000; turns++) await new Promise((resolve) => setTimeout(resolve, 10));
            return ["ra", "dec", "roll", "validity"].map((id) => document.getElementById(id).textContent).concat([sky.shown]);
        }"""
    )
    assert attitude == ["–", "–", "–", "–"]
    assert image is None


def test_a_wrong_token_and_another_origin_get_403(emulator):
    address = emulator.ready["view"]
    for url, headers in (
        (address[:-1] + ("-" if address.endswith("_") else "_"), {}),
        (re.sub(r"\?.*", "", address), {}),
        (address, {"Origin": "http://elsewhere.example"}),
    ):
        request = urllib.request.Request(url, headers=headers)
        with pytest.raises(urllib.error.HTTPError) as error:
            urllib.request.urlopen(request, timeout=PATIENCE_S)
        assert error.value.code == 403


@still
def test_a_page_whose_emulator_ended_is_grey_and_asks_for_the_address_of_the_next(browser):
    with socket.create_server(("127.0.0.1", 0)) as free:
        where = f"127.0.0.1:{free.getsockname()[1]}"
    command = emulator_command(
        profile="ideal", serial="off", can="off", seed=1, settings=NO_IMAGES, extra=["--clock", "stepped", "--view", where]
    )  # fmt: skip
    page = browser.new_page(viewport={"width": 420, "height": 900})
    page.set_default_timeout(1000 * PATIENCE_S)
    with EmulatorProcess(command) as process:
        page.goto(process.ready["view"])
        page.wait_for_selector("#link[data-state=connected]")
        page.wait_for_function("() => window.starhil && starhil.store.hello")
        assert page.evaluate("document.documentElement.scrollWidth") == 420
        assert page.evaluate("scrollY") == 0
        assert page.locator("#telecommand-form button").count() == 0
        assert page.locator("#past").is_hidden()
        page.wait_for_function("() => starhil.charts.plots.every((plot) => plot.scale > 0)")
        assert (
            min(page.evaluate("starhil.charts.plots.map((plot) => plot.scale)")) >= 0.01
        )  # nothing is plotted yet
    page.wait_for_selector("body.past #past:not([hidden])")
    assert "No connection to the emulator since " in page.locator("#past").text_content()
    assert page.locator("#active").evaluate("element => getComputedStyle(element).filter") == "grayscale(1)"
    page.click("[data-tab=faults]")
    assert page.locator("#cover").is_disabled()
    with EmulatorProcess(command):
        page.wait_for_selector("#link[data-state=restarted]")
        assert "open its new address" in page.locator("#past").text_content()
    page.close()
