"""A unit whose frames no case has thought of, or a bus that is gone, fails cases.

It never ends the run.
"""

from __future__ import annotations

import pytest

from starhil.hil_tests.conformance.canopen_suite import CANOPEN_CASES
from starhil.hil_tests.conformance.case import Case
from starhil.hil_tests.conformance.runner import run_case, run_cases
from starhil.hil_tests.errors import LinkLostError
from tests.conformance.simulated import SimulatedUnit
from tests.conformance.test_healthy import SUITES
from tests.planted import Edit, planted
from tests.protocol.canopen.conftest import simulated_probe

pytestmark = pytest.mark.long

UNREADABLE = (
    (
        "empty heartbeat",
        Edit("canopen.error_control", "bytes([self._context.state]))\n            self._next", 'b"")\n            self._next'),
        "canopen.nmt.commands",
        "an answer that can be read",
        "72C# (IndexError",
    ),
    (
        "EMCY of 2 bytes",
        Edit("canopen.emergency", "MESSAGE.build(fields)", "MESSAGE.build(fields)[:2]"),
        "canopen.emcy.history-order",
        "bytes of EMCY 8 ",
        "2",
    ),
    (
        "SYNC without its counter",
        Edit("canopen.sync", 'bytes([self._counter]) if overflow else b""', 'b""'),
        "canopen.sync.producer",
        "data ['01', '02', '03', '01', '02'] ",
        "['', '', '', '', '']",
    ),
)  # fmt: skip


@pytest.mark.parametrize(
    ("edit", "caught_by", "expected", "words"),
    [each[1:] for each in UNREADABLE],
    ids=[each[0] for each in UNREADABLE],
)
def test_frames_that_cannot_be_parsed_fail_their_cases_and_the_run_continues(
    edit, caught_by, expected, words
):
    with planted(edit):
        outcomes = run_cases(simulated_probe(), CANOPEN_CASES)
    assert [outcome.id for outcome in outcomes] == [case.id for case in CANOPEN_CASES]
    caught = next(outcome for outcome in outcomes if outcome.id == caught_by)
    assert caught.status == "failed"
    assert caught.expected.startswith(expected)
    assert words in caught.seen


def lost(*_arguments: object) -> None:
    raise LinkLostError("socketcand 127.0.0.1:29536: the hub is gone")


@pytest.mark.parametrize("link", ["serial", "can", "canopen"])
def test_a_lost_link_fails_all_that_is_left_at_once(link, monkeypatch):
    with SimulatedUnit("can" if link == "canopen" else link) as unit:
        probe = simulated_probe() if link == "canopen" else unit.probe
        port = probe.port
        cases = CANOPEN_CASES if link == "canopen" else SUITES[link]
        monkeypatch.setattr(port, "send", lost)
        begin = port.now()
        outcomes = run_cases(probe, cases)
        assert port.now() - begin < 1.0  # no pause for a device that nobody reaches
    sent = [outcome for outcome in outcomes if outcome.status != "passed"]
    assert len(sent) > 0.9 * len(cases)
    assert {outcome.seen for outcome in sent if outcome.status == "failed"} == {
        "socketcand 127.0.0.1:29536: the hub is gone"
    }


@pytest.mark.parametrize("at", ["begin", "run", "end", "recover"])
@pytest.mark.parametrize("error", [LookupError, ValueError, LinkLostError])
def test_wherever_it_happens_it_is_an_outcome(at, error):
    def fail(**_options: object) -> None:
        raise error("so it is")

    class Probe:
        log = ["0.1 <- 080#"]  # noqa: RUF012

        def begin(self, *, intrusive): ...
        def end(self, *, intrusive, passed): ...
        def recover(self): ...

    probe = Probe()
    run = (lambda _probe: fail()) if at in ("run", "recover") else (lambda _probe: None)
    if at != "run":
        setattr(probe, at, fail)
    outcome = run_case(probe, Case("a.b.c", "a.b", "t", "c", run))
    assert outcome.status == "failed"
    assert "so it is" in outcome.seen
