"""Requests of wrong shape on the console: an answer names what is wrong, and none is an internal error."""

import json
import logging

import aiohttp
import pytest

from tests.emulator.console.pages import OPTIONS, Page
from tests.emulator.runs import Control

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("prompt_pages")]

VALUES = (
    None, True, 0, -1, 2**70, 1e308, "", "x", "\ud800", [], [None], [1, "x", {}],
    [[1]], [1e308] * 3, [10**400] * 3, [True] * 3, {}, {"x": 1}, {"star": []}, {"star": "HIP " + "9" * 5000},
    {"ra_deg": "x"}, {"ra_deg": [], "dec_deg": {}}, {"do": []}, {"do": {}},
    {"do": "fault", "optical": 3}, {"do": "truth", "run_time_s": []}, {"do": "truth", "run_time_s": 1e11},
    {"do": "truth", "unix_s": -1e11}, {"do": "set_truth", "truth": {"kind": []}}, {"do": "scenario", "name": []},
    {"do": "scenario", "name": "x\0"}, {"do": "scenario", "name": "x" * 5000}, {"do": "scenario", "name": "~nobody-here/x.toml"},
    {"do": "set_truth", "truth": {"kind": "file", "path": "x" * 5000}}, {"do": "set_truth", "truth": {"kind": "file", "path": "~nobody-here/x"}},
    {"do": "set_truth", "truth": {"kind": "file", "path": "x\0\ud800"}}, {"do": "step", "seconds": 1e308}, {"do": "fault", "head": []}, {"do": "step", "seconds": {}}, {"mode": []},
    {"mode": {}}, {"mode": "9" * 5000}, {"mode": "\ud800"},
)  # fmt: skip
"""Values of every type, and the requests that reach further checks."""

REQUESTS = (
    ({"do": "subscribe"}, ("frames", "wire", "rows")),
    ({"do": "control"}, ("request",)),
    ({"do": "point", "kind": "slew"}, ("kind", "to", "max_rate_deg_s")),
    ({"do": "point", "kind": "fixed"}, ("to",)),
    ({"do": "point", "kind": "rate"}, ("rate_deg_s",)),
    ({"do": "clock"}, ("speed",)),
    ({"do": "encode", "row": "set_mode"}, ("row", "values")),
    ({"do": "send", "row": "set_mode"}, ("row", "values")),
    ({"do": "read"}, ("row",)),
    ({}, ("do",)),
)

REPORTS = (
    ({"run": "1", "event": "begin"}, ("run", "event", "kind", "title", "unit", "planned")),
    ({"run": "1", "event": "result", "result": {"status": "passed"}}, ("run", "event", "result")),
    ({"run": "1", "event": "result"}, ("run", "event", "result")),
    ({"run": "1", "event": "end"}, ("run", "event")),
)


def test_no_request_of_a_page_is_an_internal_error(run, caplog):
    wrong = []

    async def scenario(emulation, _line):
        await emulation.stepper.step(5.0)
        async with Page(emulation) as page:
            for request, keys in REQUESTS:
                for key in keys:
                    for value in VALUES:
                        answer = await page.ask(**{**request, key: value})
                        error = answer.get("error", "fine")
                        if not error or not error.isprintable() or error.startswith("internal"):
                            wrong.append((request, key, value, error))

    run(scenario, options=OPTIONS)
    assert not wrong
    assert not [record for record in caplog.records if record.levelno >= logging.ERROR]


NOT_FINITE = ("NaN", "Infinity", "-Infinity", "1e999", "-1e999")


@pytest.mark.parametrize("number", NOT_FINITE)
def test_a_number_that_is_not_finite_is_rejected_everywhere_and_never_answered(run, number):
    async def scenario(emulation, _line):
        async with Page(emulation) as page, Control(emulation) as control:
            for key, content in (
                ("id", '"id": {0}, "do": "status"'),
                ("seconds", '"id": 1, "seconds": [{0}]'),
            ):
                line = f"{{{content.format(number)}}}"
                said = {"ok": False, "error": f"{key}: {float(number)} is not a finite number"}
                assert await control.raw(line.encode()) == said
                await page.socket.send_str(line)
                assert await page.message("answer") == {"type": "answer", "id": None, **said}
                page.messages.clear()
            report = f'{{"run": "1", "event": "begin", "planned": {number}}}'
            async with page.session.post(page.url("/runs"), data=report) as response:
                assert await response.text() == f"report: planned: {float(number)} is not a finite number\n"

    run(scenario, options=OPTIONS)


def test_no_report_of_wrong_shape_is_a_server_error(run):
    variants = [{**content, key: value} for content, keys in REPORTS for key in keys for value in VALUES]

    async def scenario(emulation, _line):
        async with aiohttp.ClientSession() as session, Page(emulation) as page:
            for variant in (*variants, *VALUES):
                async with session.post(page.url("/runs"), data=json.dumps(variant)) as response:
                    text = await response.text()
                    assert response.status in (200, 400), (variant, text)
                    assert response.status == 200 or text.startswith("report: "), (variant, text)
                    assert text.count("\n") <= 1
            async with Page(emulation) as another:  # it receives all runs
                assert another.messages

    run(scenario, options=OPTIONS)
