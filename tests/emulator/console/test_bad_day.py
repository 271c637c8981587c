"""The page on a bad day: slow links, hidden tabs, keys, faults, many messages; and its accessibility, judged by axe-core."""

from urllib.parse import urlsplit

import pytest

from starhil.emulator.console.viewer import TURN_TEXT
from tests.emulator.console.browser import (
    AXE,
    MARKS,
    STILL_HZ,
    SlowLink,
    command,
    fault,
    let_pass,
    opened,
    requests_of,
    still,
    track,
    wait_for_text,
)

pytestmark = MARKS

SLOW_BYTES_S = 6_000
"""Rate of a slow link: a tenth of what images at 3 Hz need."""

TABS = ("telemetry", "telecommands", "wire", "events", "faults", "truth")
WIDTHS = (390, 820, 1280, 1920, 3840)


def open_tab(page, name):
    page.click(f"[data-tab={name}]")


def test_over_a_slow_link_nothing_queues_images_are_left_out_and_numbers_are_not(page, browser, emulator):
    """Not more than a turn is on the way, so what is shown is as young as the link admits."""
    port = urlsplit(emulator.ready["view"]).port
    with (
        SlowLink(port) as link,
        opened(browser, emulator.ready["view"].replace(str(port), str(link.port))) as slow,
    ):
        slow.wait_for_function("() => starhil.store.images.length > 2")
        link.bytes_s, link.most = SLOW_BYTES_S, 0
        begin = slow.evaluate("starhil.store.now")
        slow.wait_for_function(
            "begin => starhil.store.now > begin + 8 && starhil.store.images.at(-1).time > begin", arg=begin
        )
        numbers = slow.evaluate(
            """begin => {
                const { rows } = starhil.store;
                const found = [];
                for (let at = rows.start; at < rows.end; at++) if (rows.at(at, "run_s") > begin) found.push(rows.at(at, "frame"));
                return found;
            }""",
            begin,
        )
        sizes = slow.evaluate(
            "begin => starhil.store.images.filter(each => each.time > begin).map(each => each.blob.size)",
            begin,
        )
        shown = slow.locator("#when").text_content()
        most = link.most
        link.bytes_s = float("inf")
    assert numbers == list(range(int(numbers[0]), int(numbers[0]) + len(numbers)))
    assert 0 < len(sizes) < len(numbers)
    assert most < max(sizes) + 2 * TURN_TEXT
    assert shown == "live" or shown.endswith((" s behind", " s ago"))


def test_what_is_older_than_a_second_is_not_live(page):
    page.wait_for_function("() => document.getElementById('when').textContent === 'live'")
    page.evaluate(
        "() => { window.held = []; starhil.link.socket.onmessage = (event) => held.push(event.data); }"
    )
    wait_for_text(page, "#link", "slow link")
    assert page.locator("#when").text_content().endswith(" s behind")
    page.evaluate(
        "() => { starhil.link.socket.onmessage = (event) => starhil.link.receive(event.data); for (const data of held) starhil.link.receive(data); }"
    )
    wait_for_text(page, "#link", "connected")


def test_what_a_hidden_page_missed_is_filled_when_it_is_shown(page):
    hide = "hidden => { Object.defineProperty(document, 'hidden', { value: hidden, configurable: true }); document.dispatchEvent(new Event('visibilitychange')); }"
    page.evaluate(hide, arg=True)
    begin = page.evaluate("starhil.store.rows.end")
    let_pass(page, 2.5)
    assert page.evaluate("starhil.store.rows.end") <= begin + 3
    page.evaluate(hide, arg=False)
    page.wait_for_function("begin => starhil.store.rows.end >= begin + 6", arg=begin)
    missing = page.evaluate(
        "begin => { const { rows } = starhil.store; let count = 0; for (let at = begin; at < rows.end; at++) count += Number.isNaN(rows.at(at, 'mode')); return count; }",
        begin,
    )
    assert missing == 0
    numbers = page.evaluate(
        "begin => { const { rows } = starhil.store; return Array.from({ length: rows.end - begin }, (_, at) => rows.at(begin + at, 'frame')); }",
        begin,
    )
    assert numbers == list(range(int(numbers[0]), int(numbers[0]) + len(numbers)))


@still
def test_letters_and_ctrl_enter_act_only_in_their_part(page):
    open_tab(page, "telecommands")
    page.select_option("#telecommand", "set_mode")
    sent = page.locator("#sent li").count()
    page.focus("#plots")
    with requests_of(page) as requests:
        for key in ("Control+Enter", "c", "x", "1", "t", "r"):
            page.keyboard.press(key)
        assert requests() == []
    assert page.locator("#sent li").count() == sent
    assert page.locator("#active").text_content() == "no fault"
    assert page.get_attribute("[data-layer=matched]", "aria-pressed") == "true"
    page.focus(".stage")
    page.keyboard.press("1")
    assert page.get_attribute("[data-layer=matched]", "aria-pressed") == "false"
    page.keyboard.press("1")
    page.focus("#telecommand-form [name=mode]")
    page.keyboard.press("Control+Enter")
    page.wait_for_function("count => document.querySelectorAll('#sent li').length > count", arg=sent)


@still
def test_a_telecommand_that_restarts_or_deletes_asks_first(page):
    open_tab(page, "telecommands")
    for row in ("reset", "format_card", "erase_file"):
        page.select_option("#telecommand", row)
        with requests_of(page) as requests:
            page.click("#send")
            page.wait_for_selector("#ask[open]")
            assert row in page.locator("#ask-text").text_content()
            page.click("#ask button[value='']")
            page.wait_for_selector("#ask:not([open])", state="attached")
            assert requests() == []


@still
def test_the_form_of_a_level_shows_its_faults_and_injecting_keeps_them(page):
    open_tab(page, "faults")
    fault(page, optical={"false_stars": 5})
    page.wait_for_function(
        "() => document.querySelector('[data-level=optical] [name=false_stars]').value === '5'"
    )
    page.locator("[data-level=optical] [name=missing_stars]").select_text()
    fault(page, optical={"false_stars": 5, "missing_stars": 2})
    page.wait_for_function(
        "() => document.querySelector('[data-level=optical] [name=missing_stars]').value === '2'"
    )
    page.keyboard.insert_text("3")
    page.click("[data-level=optical] button[type=submit]")
    page.wait_for_function("() => document.querySelectorAll('#active-faults li').length === 2")
    active = page.evaluate("starhil.link.control({ do: 'status' })")["faults"]
    assert active == {"optical": {"false_stars": 5, "missing_stars": 3}}
    page.click("#active-faults li >> nth=0 >> button")
    page.wait_for_function("() => document.querySelectorAll('#active-faults li').length === 1")
    assert page.evaluate("starhil.link.control({ do: 'status' })")["faults"] == {
        "optical": {"missing_stars": 3}
    }
    page.fill("[data-level=optical] [name=false_stars]", "many")
    page.click("[data-level=optical] button[type=submit]")
    page.wait_for_function(
        "() => document.getElementById('fault-outcome').textContent.includes('is not a number')"
    )


@still
@pytest.mark.parametrize("width", WIDTHS)
def test_everything_fits_the_width_and_text_is_at_least_12_px(page, width):
    page.set_viewport_size({"width": width, "height": {390: 844, 820: 1180, 3840: 2160}.get(width, 800)})
    for tab in TABS:
        open_tab(page, tab)
        state = page.evaluate(
            """() => {
                const seen = [...document.querySelectorAll("button, a, input, select, dd, dt, h1, h2, td, th, label, p, span, code")].filter((each) => each.checkVisibility() && !each.closest(".quiet, .skip, .scroll, #plots, #statistics, .log, select, .message"));
                const wide = seen.filter((each) => { const box = each.getBoundingClientRect(); return box.width && (box.left < -1 || box.right > innerWidth + 1); });
                const small = seen.filter((each) => each.textContent.trim() && parseFloat(getComputedStyle(each).fontSize) < 12);
                const name = (each) => each.id || each.className || each.textContent.slice(0, 30);
                return { scroll: document.documentElement.scrollWidth, wide: wide.map(name), small: small.map(name) };
            }"""
        )
        assert state == {"scroll": width, "wide": [], "small": []}, tab
    if width < 600:
        assert page.evaluate("document.getElementById('tabs').getBoundingClientRect().bottom <= innerHeight")


@still
@pytest.mark.parametrize("width", [390, 1280])
def test_no_name_and_unit_is_cut_off(page, width):
    page.set_viewport_size({"width": width, "height": 844})
    open_tab(page, "telemetry")
    cut_off = page.evaluate(
        """() => [...document.querySelectorAll("#top *, #telemetry b, #telemetry th, #telemetry .unit, .legend *")]
            .filter((each) => each.checkVisibility() && !each.matches(".val") && each.scrollWidth > each.clientWidth + 1)
            .filter((each) => getComputedStyle(each).display !== "inline").map((each) => each.textContent)"""
    )
    assert cut_off == []


@still
def test_a_telephone_shows_the_whole_image_below_the_header(page):
    page.set_viewport_size({"width": 390, "height": 844})
    page.evaluate("scrollTo(0, 0)")
    bottom, tabs = page.evaluate(
        "['.stage', '#tabs'].map((each, i) => document.querySelector(each).getBoundingClientRect()[i ? 'top' : 'bottom'])"
    )
    assert bottom < tabs


@still
def test_text_follows_the_font_size_of_the_browser(page):
    before = page.evaluate("getComputedStyle(document.getElementById('ra')).fontSize")
    page.evaluate("document.documentElement.style.fontSize = '200%'")
    after = page.evaluate("getComputedStyle(document.getElementById('ra')).fontSize")
    page.evaluate("document.documentElement.style.fontSize = ''")
    assert float(after[:-2]) == pytest.approx(2 * float(before[:-2]))


def test_numbers_are_in_no_live_region_and_outcomes_are(page):
    regions = page.evaluate(
        "[...document.querySelectorAll('output, [role=status], [aria-live]')].map((each) => each.id).sort()"
    )
    assert regions == ["active", "link", "mode", "past", "said", "validity"]
    command(page, "set_mode", mode="lost_in_space")
    page.wait_for_function(
        "() => document.getElementById('said').textContent.startsWith('set_mode accepted')"
    )
    track(page)


@still
def test_messages_are_added_without_making_the_others_again_and_one_opens_with_its_fields(page):
    open_tab(page, "wire")
    page.check("#wire label.check:has-text('console') input")
    command(page, "set_mode", mode="tracking")
    line = page.locator("#wire .trace li", has_text="set_mode mode=tracking").first
    line.wait_for()
    line.evaluate("element => { element.marked = true; }")
    command(page, "set_mode", mode="tracking")
    page.wait_for_function(
        "() => [...document.querySelectorAll('#wire .trace li')].filter((each) => each.textContent.includes('set_mode mode=tracking')).length >= 2"
    )
    assert page.evaluate("[...document.querySelectorAll('#wire .trace li')].some((each) => each.marked)")
    page.locator("#wire .trace li button", has_text="set_mode mode=tracking").first.click()
    page.wait_for_selector("#wire .message:not([hidden])")
    assert page.locator("#wire .message tr").first.text_content().startswith("modetracking")
    page.click("#wire .message button:has-text('close')")


@still
def test_more_messages_than_anyone_can_read_are_put_on_the_page_once_a_second(browser, emulator):
    with opened(browser, emulator.ready["view"]) as page:
        open_tab(page, "wire")
        added, taken_s = page.evaluate(
            """async () => {
                const added = [];
                const begin = performance.now();
                const list = document.querySelector("#wire .trace");
                new MutationObserver((changes) => { added.push(changes.reduce((sum, change) => sum + change.addedNodes.length, 0)); }).observe(list, { childList: true });
                const [bus] = Object.keys(starhil.store.hello.buses);
                for (let turn = 1; turn <= 30; turn++) {
                    const items = Array.from({ length: 60 }, (_, at) => ({ n: 1e6 * turn + at, t: turn, bus, out: false, own: false, kind: "telemetry", raw: "00", text: `turn ${turn}` }));
                    starhil.store.emit("wire", { items, left_out: 0 });
                    await new Promise((resolve) => setTimeout(resolve, 50));
                }
                return [added, (performance.now() - begin) / 1000];
            }"""
        )
        page.locator("#wire .trace li", has_text="turn 30").first.wait_for()
        page.locator("#wire input[type=search]").fill("turn")
        kept = page.locator("#wire .trace li", has_text="turn").count()
    assert 1 <= len(added) <= 2 + taken_s
    assert max(added[1:], default=0) <= 100  # the newest; a filter shows the others
    assert kept == 400


def test_paused_is_paused_everywhere_and_arrows_on_a_tab_change_the_tab(page):
    open_tab(page, "telemetry")
    page.fill("#telemetry input[type=search]", "precise")
    page.click("#live")
    page.wait_for_selector("body.paused")
    texts = "['utc', 'run', 'ra', 'telemetry', 'truth', 'frame-info'].map((id) => document.getElementById(id).textContent)"
    before, end = page.evaluate(texts), page.evaluate("starhil.store.rows.end")
    page.wait_for_function("end => starhil.store.rows.end >= end + 4", arg=end)
    assert page.evaluate(texts) == before
    page.focus("#tab-telemetry")
    position = page.evaluate("starhil.store.position")
    page.keyboard.press("ArrowRight")
    assert page.get_attribute("#tab-telecommands", "aria-selected") == "true"
    assert page.evaluate("starhil.store.position") == position
    page.click("#live")
    page.fill("#telemetry input[type=search]", "") if page.locator("#telemetry input").is_visible() else None


def test_a_reconnection_keeps_filter_forms_and_images(page):
    open_tab(page, "telecommands")
    page.select_option("#telecommand", "set_update_rate")
    page.fill("#telecommand-form [name=rate]", "7.5")
    page.fill("#telecommands input[type=search]", "rate")
    image = page.evaluate("starhil.store.images.at(-1).time")
    end = page.evaluate("starhil.store.rows.end")
    page.evaluate("starhil.link.socket.close()")
    page.wait_for_selector("#link[data-state=disconnected]")
    page.wait_for_selector("#link[data-state=connected]")
    page.wait_for_function("end => starhil.store.rows.end > end + 2", arg=end)
    assert page.input_value("#telecommand-form [name=rate]") == "7.5"
    assert page.input_value("#telecommands input[type=search]") == "rate"
    assert page.evaluate("image => starhil.store.images.some((each) => each.time === image)", image)
    page.fill("#telecommands input[type=search]", "")


@still
def test_a_turn_that_is_no_number_is_said_and_not_sent(page):
    open_tab(page, "truth")
    page.fill("[data-truth=rate] [name=x]", "abc")
    page.click("[data-truth=rate] button[type=submit]")
    page.wait_for_function(
        "() => document.querySelector('#truth .problem').textContent === 'x: “abc” is not a number'"
    )
    assert page.evaluate("starhil.link.control({ do: 'status' })")["truth_kind"] == "fixed"
    page.fill("[data-truth=rate] [name=x]", "0")


@still
def test_events_are_listed_and_a_click_shows_the_moment(page):
    open_tab(page, "events")
    page.fill("#events form input", "look here")
    page.click("#events form button")
    note = page.locator("#events li", has_text="look here")
    note.wait_for()
    page.fill("#events input[type=search]", "look")
    assert page.locator("#events li").count() == 1
    note.locator("button").click()
    page.wait_for_selector("body.paused")
    page.fill("#events input[type=search]", "")
    page.click("#live")


def test_any_telemetry_field_is_plotted_and_a_part_of_the_time_is_enlarged_and_saved(page):
    page.click("#add-plot")
    page.check("#chooser input[value='precise_attitude.q_w']")
    page.check("#chooser input[value=true_ra]")
    page.click("#chooser button[value=plot]")
    page.wait_for_function(  # some of them are in the part that is enlarged: it ends a second ago and is 24 s long
        """() => {
            const found = starhil.store.samples.get("precise_attitude") || [];
            return found.some(([at]) => at < found.at(-1)[0] - 2 && at > found.at(-1)[0] - 10);
        }"""
    )
    assert page.locator("#plots .plot").count() == 6
    plot = page.locator("#plots .u-over").first
    plot.scroll_into_view_if_needed()
    box = plot.bounding_box()
    page.mouse.move(box["x"] + 0.58 * box["width"], box["y"] + 10)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.98 * box["width"], box["y"] + 10, steps=4)
    page.mouse.up()
    page.wait_for_function(
        "() => starhil.charts.zoomed && Math.abs(starhil.charts.to - starhil.charts.from - 24) < 2"
    )
    with page.expect_download() as download:
        page.click("#save-csv")
    lines = download.value.path().read_text().splitlines()
    assert lines[0].startswith("series,run_s,unix_s,frame")
    assert any(line.startswith("precise_attitude,") for line in lines)
    with page.expect_download() as download:
        page.click("#save-image")
    assert download.value.path().read_bytes()[:4] == b"\x89PNG"
    plot.dblclick()
    page.wait_for_function("() => !starhil.charts.zoomed && starhil.store.cursor === null")
    page.click("#statistics summary")
    page.wait_for_function("() => document.querySelectorAll('#statistics tr').length === 5")
    page.click("#statistics summary")
    page.click("#plots button[aria-label^='remove']")
    assert page.locator("#plots .plot").count() == 5


RULES = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]
COLOURS = ["color-contrast", "link-in-text-block"]
"""The rules of RULES that look at colours, in which alone the themes differ."""
SERIOUS = """async ([part, runOnly]) => {
    const { violations } = await axe.run(part, { resultTypes: ["violations"], runOnly });
    return violations.filter((each) => ["critical", "serious"].includes(each.impact)).map((each) => [each.id, each.nodes.length, each.nodes[0].target.join(" "), each.nodes[0].failureSummary]);
}"""
STATES = ("live", "paused", "covered", "stuck", "standby", "error")
WHOLE, PANEL, STATE = "html", "#side", "#top, #past, #sky, #active-faults"
"""Parts of the page: all of it, what differs between tabs, and what between states."""


def serious(page, rules, views):
    """Return what axe finds in views, each of a width, a tab and a part, and change the theme."""
    gaps = []
    for width, tab, part in views:
        page.set_viewport_size({"width": width, "height": 900})
        open_tab(page, tab)
        gaps += [(width, tab, *each) for each in page.evaluate(SERIOUS, [part, rules])]
    page.click("#theme")
    return gaps


@pytest.mark.skipif(not AXE.is_file(), reason="no axe-core: tools/install_test_packages tests, with npm")
@pytest.mark.parametrize("state", STATES)
def test_axe_finds_nothing_serious(page, state):
    """A live page whole, each of its panels and narrow widths; in the other states what they change. Colours in both themes."""
    if not page.evaluate("Boolean(window.axe)"):
        page.evaluate(AXE.read_text())
    gaps, views = [], [(1280, "faults", STATE)]
    if state == "live":
        gaps = serious(page, RULES, [(1280, "faults", WHOLE)])
        views = [(1280, tab, PANEL) for tab in TABS] + [(390, "telecommands", WHOLE), (820, "wire", WHOLE)]
    elif state == "covered":
        fault(page, optical={"blank": True})
        wait_for_text(page, "#validity", "too few stars")
    command(page, "set_update_rate", rate=STILL_HZ)
    if state == "stuck":
        fault(page, device={"stuck": True})
        page.wait_for_selector("body.past")
    elif state == "standby":
        command(page, "set_mode", mode="standby")
        wait_for_text(page, "#validity", "no images")
    elif state == "error":
        fault(page, device={"error": "sensor"})
        wait_for_text(page, "#mode", "error: sensor")
    elif state == "paused":
        page.click("#live")
    gaps += serious(page, RULES, views) + serious(page, COLOURS, views)
    if state == "error":
        command(page, "set_mode", mode="standby")
    assert gaps == []
