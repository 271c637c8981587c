"""What a peer sends costs no more than its size: long lists are rejected unread, and errors are worded outside the loop."""

from __future__ import annotations

import asyncio
import json
import socket
import threading
import time
from typing import Any

import numpy as np
import pytest

from starhil.emulator.control import channel, scenario
from starhil.emulator.control.channel import MAX_LINE
from starhil.emulator.errors import EmulatorError
from starhil.emulator.profile import load_profile
from starhil.emulator.sensor.sky.objects import MAX_ROWS
from starhil.emulator.sensor.sky.tables import OPTICAL_FAULT
from starhil.emulator.truth.config import MAX_SEGMENTS
from starhil.emulator.truth.feed import MAX_LINES, MAX_WAITING, LiveFeed, _Datagrams
from starhil.emulator.truth.live import LiveTruth
from starhil.hil_tests.session.script import ScriptError, load_script
from starhil.protocol.errors import LONGEST_PROBLEM, MAX_PROBLEMS
from starhil.protocol.transports.connections import FREE_IN_ALL, Budget
from starhil.protocol.unit import load_unit
from starid.attitude import Attitude
from tests.fuzzing.control import _Loop
from tests.waiting import PATIENCE_S, until

HOLD = {"do": "hold", "seconds": 1.0}
LARGEST_ANSWER = (MAX_PROBLEMS + 1) * (LONGEST_PROBLEM + 10)


def keys(name: str) -> dict[str, int]:
    return {f"{name}{number:04}": 1 for number in range(4000 - 10 * len(name))}


WORST: dict[str, dict[str, Any]] = {
    "empty segments": {"do": "set_truth", "truth": {"kind": "slew", "segments": [{}] * 16_000}},
    "wrong segments": {"do": "set_truth", "truth": {"kind": "slew", "segments": [{"do": "hold"}] * MAX_SEGMENTS}},
    "keys of a truth": {"do": "set_truth", "truth": {"kind": "fixed", **keys("a")}},
    "a long kind": {"do": "set_truth", "truth": {"kind": "fixed" * 13_000}},
    "planets": {"do": "fault", "optical": {"planets": [{"ra_deg": 1}] * 4200}},
    "keys of a sky": {"do": "fault", "optical": keys("moon")},
    "keys of a link": {"do": "fault", "serial": keys("drop")},
    "a long error": {"do": "fault", "device": {"error": "x" * 65_000}},
    "a long name": {"do": "scenario", "name": "x" * 65_000},
    "a long action": {"do": "status" * 10_000},
    "a long key": {"do": "status", "x" * 65_000: 1},
}  # fmt: skip


@pytest.fixture(scope="module")
def run_() -> _Loop:
    return _Loop()


@pytest.mark.parametrize("name", WORST)
def test_the_worst_requests_of_64_kb_are_worded_outside_the_loop_in_a_short_answer(
    run_: _Loop, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    threads: list[threading.Thread] = []
    problems = channel.problems

    def noting(*arguments: Any, **options: Any) -> Any:
        threads.append(threading.current_thread())
        return problems(*arguments, **options)

    monkeypatch.setattr(channel, "problems", noting)
    line = json.dumps(WORST[name]).encode()
    assert len(line) <= MAX_LINE
    answer = run_.call(run_.control.answer(line))
    assert not answer["ok"]
    assert len(json.dumps(answer)) <= LARGEST_ANSWER
    assert threading.main_thread() not in threads


def test_a_slew_may_have_as_many_segments_as_fit_into_a_request(run_: _Loop) -> None:
    for count, ok in ((MAX_SEGMENTS, True), (MAX_SEGMENTS + 1, False)):
        request = {"do": "set_truth", "truth": {"kind": "slew", "segments": [HOLD] * count}}
        assert run_.call(run_.control.answer(json.dumps(request)))["ok"] == ok
    assert run_.call(run_.control.answer(b'{"do": "set_truth"}'))["ok"]


def test_a_scenario_and_a_sky_have_limits() -> None:
    event = {"run_time_s": 1.0, "clear_faults": True}
    scenario.Scenario.model_validate({"at": [event] * scenario.MAX_EVENTS})
    with pytest.raises(ValueError, match="at most 1000"):
        scenario.Scenario.model_validate({"at": [event] * (scenario.MAX_EVENTS + 1)})
    planet = {"ra_deg": 1.0, "dec_deg": 2.0, "magnitude": 3.0}
    for rows in ({"planets": [planet]}, {"obstructions": [{}]}):
        ((name, row),) = rows.items()
        OPTICAL_FAULT.model_validate({name: row * MAX_ROWS})
        with pytest.raises(ValueError, match=f"{name}\n.* at most {MAX_ROWS} items .* not 201"):
            OPTICAL_FAULT.model_validate({name: row * (MAX_ROWS + 1)})
    with pytest.raises(ValueError, match=f"polygon_px\n.* at most {MAX_ROWS} items"):
        OPTICAL_FAULT.model_validate({"obstructions": [{"polygon_px": [[0.0, 0.0]] * (MAX_ROWS + 1)}]})


MESSAGE = b'{"q": [0, 0, 0, 1]}'


async def datagrams(truth: LiveTruth, *sent: bytes) -> None:
    """Send datagrams to a feed, and wait until it has processed or dropped them."""
    feed = LiveFeed(truth, lambda: 1.0)
    address = await feed.start("udp", "127.0.0.1", 0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.connect(("127.0.0.1", int(address.rpartition(":")[2])))
        for datagram in sent:
            peer.send(datagram)
            before = truth.accepted + truth.refused
            await until(lambda count=before: truth.accepted + truth.refused > count)
            await until(lambda: feed._datagrams is not None and not feed._datagrams.waiting)
    feed.close()


def test_a_datagram_is_read_up_to_a_number_of_lines_and_a_length() -> None:
    truth = LiveTruth(Attitude.identity())
    asyncio.run(datagrams(truth, b"\n".join([MESSAGE] * MAX_LINES) + b"\n"))
    assert (truth.accepted, truth.refused) == (MAX_LINES, 0)
    asyncio.run(datagrams(truth, b"\n".join([MESSAGE] * 3000)))
    assert (truth.accepted, truth.refused) == (2 * MAX_LINES, 1)
    assert truth.last_fault == f"datagram of more than {MAX_LINES} lines"
    asyncio.run(datagrams(truth, b'{"q": [' + b"0, " * 5000 + b"1]}"))
    assert truth.last_fault == "message longer than 4096 bytes"


LONG_LINES = (b'{"q":[' + b"1," * 900 + b"1]}\n") * MAX_LINES
"""A datagram of 57 kB."""


@pytest.mark.long
@pytest.mark.parametrize("datagram", [MESSAGE, LONG_LINES, b"", b"\n" * 60_000])
def test_a_flood_of_datagrams_takes_short_turns_and_no_more_than_its_share_of_the_loop(
    datagram: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Messages without pause held up replies on the bus by 40 ms, and a datagram of 32 long lines by 8 ms."""
    turns: list[float] = []
    turn = _Datagrams._turn

    def timed(self: _Datagrams, source: socket.socket) -> None:
        begin_s = time.thread_time()
        turn(self, source)
        turns.append(time.thread_time() - begin_s)

    monkeypatch.setattr(_Datagrams, "_turn", timed)

    def flood(peer: socket.socket) -> float:
        begin_s = time.monotonic()
        while time.monotonic() < begin_s + 0.5:
            peer.send(datagram)
        return time.monotonic() - begin_s

    async def main() -> float:
        feed = LiveFeed(truth := LiveTruth(Attitude.identity()), lambda: 1.0)
        address = await feed.start("udp", "127.0.0.1", 0)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
            peer.connect(("127.0.0.1", int(address.rpartition(":")[2])))
            flooded_s = await asyncio.to_thread(flood, peer)
            share = sum(turns) / flooded_s
            before = truth.accepted
            async with asyncio.timeout(PATIENCE_S):
                while truth.accepted == before:  # as long as the feed rests, what is sent is lost
                    peer.send(MESSAGE)
                    await asyncio.sleep(0.01)
        feed.close()
        return share

    assert asyncio.run(main()) < FREE_IN_ALL + 0.1
    assert float(np.median(turns)) < 0.002


def test_of_datagrams_that_come_too_fast_the_newest_are_processed() -> None:
    truth = LiveTruth(Attitude.identity())
    waiting = _Datagrams(LiveFeed(truth, lambda: 1.0), Budget())
    for number in range(3 * MAX_WAITING):
        waiting.add(b'{"t": %d, "q": [0, 0, 0, 1]}' % number)
    while waiting.waiting:
        waiting.process_line()
    assert (truth.accepted, truth.refused) == (MAX_WAITING, 2 * MAX_WAITING)
    assert truth.last_fault == "messages come too fast; the oldest are dropped"


def test_the_rest_of_a_file_with_very_many_errors_is_not_checked(tmp_path: Any) -> None:
    profile = tmp_path / "profile.toml"
    keys = "".join(f"gian{number} = 1\n" for number in range(5000))
    profile.write_text(f"[parameters]\n{keys}")
    with pytest.raises(EmulatorError) as caught:
        load_profile(str(profile))
    assert len(caught.value.args) == MAX_PROBLEMS
    assert "4981 more keys are not checked; correct these first" in str(caught.value)
    profile.write_text(f"[sensor]\n{keys}[sky]\n{keys}")
    with pytest.raises(EmulatorError) as caught:
        load_profile(str(profile))
    assert len(caught.value.problems) == MAX_PROBLEMS + 1
    assert caught.value.problems[-1] == "and 9980 more"
    session = tmp_path / "session.toml"
    session.write_text("[[step]]\ntelemetri = 'x'\n" * 5000)
    with pytest.raises(ScriptError, match="4980 more steps are not checked; correct these first") as wrong:
        load_script(session, load_unit())
    assert len(wrong.value.args) == MAX_PROBLEMS + 1
