"""The console's panel of features in a real browser, with the thesis's recursive algorithm on a turning sensor."""

import math

import pytest

from tests.emulator.console.browser import MARKS, command, emulator_with_console, opened

pytestmark = MARKS

SETTINGS = (
    "run.algorithm=rsi", "truth.kind=rate", "truth.attitude.ra_deg=83.8", "truth.attitude.dec_deg=-1.2",
    "truth.attitude.roll_deg=30", "truth.rate_deg_s=[0.0, 0.3, 0.0]", "sky.false_stars=6", "parameters.update_rate=2",
)  # fmt: skip


@pytest.fixture
def page(browser):
    with (
        emulator_with_console(settings=list(SETTINGS)) as emulator,
        opened(browser, emulator.ready["view"]) as page,
    ):
        yield page


def test_features_region_and_removed_detections_are_shown(page):
    assert page.locator("#features").is_hidden()
    command(page, "set_mode", mode="lost_in_space")
    page.wait_for_function(
        "() => { const known = starhil.store.image && starhil.store.image.head.features;"
        " return known && known.search === 'rsi' && known.removed.length >= 3; }"
    )
    page.click("#live")  # nothing changes any more
    command(page, "set_mode", mode="standby")
    shown = page.evaluate("() => starhil.store.image.head.features")
    page.wait_for_function(
        "text => document.querySelector('#features p').textContent.includes(text)",
        arg=f"{len(shown['removed'])} removed",
    )
    widths = page.evaluate(
        "() => [...document.querySelectorAll('#features i')].map((bar) => parseFloat(bar.style.width))"
    )
    pairs = [value for pair in zip(shown["observed"], shown["of_cell"], strict=True) for value in pair]
    assert widths == pytest.approx([min(max(value, 0.0), 100.0) for value in pairs], abs=0.01)
    outside = page.evaluate(
        """() => {
          const map = document.getElementById("map").getBoundingClientRect(), globe = document.querySelector(".globe").getBoundingClientRect();
          const inside = (box) => box.left >= map.left && box.right <= globe.left && box.top >= map.top && box.bottom <= map.bottom;
          return [...document.querySelectorAll("#features i, #features p")].filter((each) => !inside(each.getBoundingClientRect())).length;
        }"""
    )
    assert outside == 0  # bars and text are in the panel, beside the map
    text = page.locator("#features p").text_content()
    assert "RSI, 2.0°" in text
    assert f"cell {shown['cell'] + 1} · {shown['weights']} weights" in text
    assert shown["translation_deg"] > 0.1  # 0.3 degrees per second, two images per second
    assert f"moved {shown['translation_deg']:.2f}°, turned " in text
    assert shown["region_deg"] == pytest.approx(2.0, abs=0.1)
    sides = page.evaluate(
        """() => {
          const { sky } = starhil, { head } = sky.shown, drawn = [];
          sky.skyLine({ beginPath() {}, stroke() {}, lineTo: (x, y) => drawn.push([x, y]) }, head, [[0, 0.5], [0, -0.5]].map(([a, d]) => [
            head.features.region_at_deg[0] + a, head.features.region_at_deg[1] + d]));
          const [first, second] = drawn, scale = sky.scale();
          const middle = sky.place((head.width - 1) / 2, (head.height - 1) / 2);
          return [Math.hypot(first[0] - second[0], first[1] - second[1]) / scale,
            Math.hypot((first[0] + second[0]) / 2 - middle[0], (first[1] + second[1]) / 2 - middle[1]) / scale];
        }"""
    )
    pixels_per_degree = page.evaluate("() => starhil.store.hello.camera.focal_px[0]") * math.pi / 180.0
    assert sides[0] == pytest.approx(
        pixels_per_degree, rel=0.01
    )  # a degree along the hour circle of its centre
    assert sides[1] < 0.1 * pixels_per_degree  # which is the boresight, carried by the motion
    crossed = page.evaluate(
        """() => {
          const { sky } = starhil, { head } = sky.shown, ratio = window.devicePixelRatio || 1;
          const { width, height } = sky.overlay;
          const ink = sky.overlay.getContext("2d").getImageData(0, 0, width, height).data;
          return head.features.removed.map((row) => {
            const [x, y] = sky.place(head.detections[row][0], head.detections[row][1]).map((at) => Math.floor(at * ratio));
            return Math.max(...[-1, 0, 1].map((step) => ink[4 * (y * width + x + step) + 3]));
          });
        }"""
    )
    assert min(crossed) > 0  # ink in the middle of each, where a circle or square has none
