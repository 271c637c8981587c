"""The cases by the vendor's text find an ST-16 that differs from it in one point."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from starhil.emulator.truth.source import FixedTruth
from starhil.hil_tests.conformance.conformance_run import POINTING
from starhil.hil_tests.conformance.runner import run_case
from starhil.hil_tests.conformance.suites import serial_suite
from starhil.hil_tests.judge.definition import read_unit
from starhil.protocol.files.bundled import find_unit
from starid.attitude import Attitude
from tests.conformance.simulated import SimulatedUnit

pytestmark = pytest.mark.long

MUTANTS = [
    ("combination.quaternion", "unit.py", '"wxyz"', '"xyzw"'),
    ("combination.counts", "unit.py", 'struct.pack("<H", start) + stream', 'struct.pack("<H", 0) + stream'),
    ("combination.fails", "unit.py", '+ why.encode("ascii")', ""),
    ("combination.matching", "unit.py", "count, 0, 0.0, *mapping, *quaternion", "count, 0, 0.0, *mapping, *quaternion[::-1]"),
    ("combination.time", "unit.py", "snapshot.uptime_ns // 1000 &", "snapshot.uptime_ns // 1000000 &"),
    ("combination.time-step", "unit.py", "0xFFFFFFFE", "0xFFFFFFFF"),
    ("result.count-zero", "unit.py", 'arguments["count"] or 256', 'arguments["count"]'),
    ("result.forms", "unit.py", 'arguments["count"] | high << 8', "high"),
    ("result.dark-window", "unit.py", "> size", "> size + 65536"),
    ("memory.files", "unit.py", '"little"), data[-4:])', '"little"), data[:4])'),
    ("memory.edac", "unit.py", "memory[address : address + len(data)] = data\n\n\ndef read", "memory[address : address + 1] = data[:1]\n\n\ndef read"),
    ("memory.size", "unit.py", "EDAC_SIZE = 512", "EDAC_SIZE = 513"),
    ("counters.framing", "unit.py", "UART_PROTOCOL, FaultKind.UART_SHORT", "UART_SHORT, FaultKind.UART_PROTOCOL"),
    ("counters.crc", "unit.py", "FaultKind.UART_CHECK)", "FaultKind.UART_ADDRESS)"),
    ("counters.crc-elsewhere", "unit.py", "FaultKind.UART_CHECK)", "FaultKind.UART_ADDRESS)"),
    ("counters.runt-elsewhere", "unit.py", "FaultKind.UART_CHECK)", "FaultKind.UART_ADDRESS)"),
    ("control.no-poll", "st16.toml", '{ role = "poll", default = 1 }', "{ default = 1 }"),
    ("control.no-poll-refused", "st16.toml", '{ role = "poll", default = 1 }', "{ default = 1 }"),
    ("control.b", "st16.toml", '{ role = "ack" }, { role = "flags" }', '{ role = "ack" }, { width = 1 }'),
    ("control.ack-ignored", "st16.toml", '{ width = 1 }, { role = "flags" }', '{ const = 0 }, { role = "flags" }'),
    ("control.nack", "st16.toml", '{ role = "ack" }', "{ default = 1 }"),
    ("control.final", "st16.toml", '{ role = "final" }', "{ default = 1 }"),
]  # fmt: skip


@pytest.mark.parametrize(("case", "file", "right", "wrong"), MUTANTS, ids=[item[0] for item in MUTANTS])
def test_a_unit_that_differs_from_the_text_is_found(case, file, right, wrong, tmp_path: Path) -> None:
    folder = tmp_path / "st16"
    shutil.copytree(find_unit("st16"), folder, ignore=shutil.ignore_patterns("__pycache__"))
    (case_item,) = [item for item in serial_suite(read_unit("st16")) if item.id == f"serial.{case}"]

    def point(simulated: SimulatedUnit) -> None:
        simulated.device.surroundings.truth = FixedTruth(Attitude.from_quaternion(POINTING))

    def outcome():
        with SimulatedUnit("serial", point, unit=str(folder)) as simulated:
            simulated.probe.truth = lambda: POINTING
            return run_case(simulated.probe, case_item)

    right_one = outcome()
    assert right_one.status == "passed", (right_one.expected, right_one.seen)
    text = (folder / file).read_text(encoding="utf-8")
    assert text.count(right) == 1
    (folder / file).write_text(text.replace(right, wrong), encoding="utf-8")
    assert outcome().status == "failed"
