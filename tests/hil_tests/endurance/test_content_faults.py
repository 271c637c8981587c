"""The oracle knows what was injected: a unit whose telemetry is otherwise, or is not wrong enough, is in violation."""

from __future__ import annotations

import pytest

from starhil.emulator.cli.endurance import run_once
from starhil.emulator.device.clock_errors import ClockErrors
from starhil.emulator.device.telemetry_faults import Injected
from starhil.hil_tests.endurance.life import Life, make_life
from starhil.hil_tests.judge.definition import unit_of
from starhil.protocol.unit import load_unit

pytestmark = pytest.mark.long

WAIT = {"do": "wait", "s": 20.0}


def life(*faults):
    """A life in which an attitude is found, and these faults are injected and ended."""
    icd = load_unit("cubestar")
    reads = [
        {"do": "request", "link": "serial", "row": ["", icd.telemetry[name].id, "telemetry"]}
        for name in ("precise_attitude", "device_status")
    ]
    steps = [WAIT, *reads]
    for fault in faults:
        steps += [{"do": "fault", "fault": fault}, *reads, WAIT, *reads]
    steps += [{"do": "clear"}, WAIT, *reads]
    profile = {"parameters": {"start_mode": "lost_in_space", "update_rate": 2.0}}
    return Life("cubestar", 3, ("serial",), profile, tuple(steps))


FAULTS = {
    "turn": (
        {"telemetry": [{"turn_deg": [0.0, 5.0, 0.0]}]},
        (Injected, "seen", lambda _self, snapshot: snapshot),
    ),
    "freeze": (
        {"telemetry": [{"row": "precise_attitude", "freeze": "all"}]},
        (Injected, "seen", lambda _self, snapshot: snapshot),
    ),
    "set": (
        {"telemetry": [{"row": "precise_attitude", "set": {"rate_x": 0.25}}]},
        (Injected, "changed", lambda _self, _row, data: data),
    ),
    "drift": ({"clock": {"drift_ppm": 100_000.0}}, (ClockErrors, "gained_ns", lambda *_: 0)),
}


def test_faults_that_act_as_injected_are_no_violation():
    outcome = run_once(life(*(fault for fault, _ in FAULTS.values()), {"clock": {"jump_s": -30.0}}))
    assert outcome.violation == ""
    assert outcome.attitudes > 5


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_without_its_effect_is_a_violation(name, monkeypatch):
    fault, (part, method, instead) = FAULTS[name]
    monkeypatch.setattr(part, method, instead)
    outcome = run_once(life(fault))
    assert outcome.violation != ""


def test_lives_have_such_faults():
    icd = load_unit("cubestar")
    steps = make_life(unit_of(icd), "cubestar", ("serial", "can"), 5, 2000).steps
    found = {key for step in steps if step["do"] == "fault" for key in step["fault"]}
    assert {"telemetry", "clock"} <= found
