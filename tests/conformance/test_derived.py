"""What the definition and the truth say of a unit, and a device that does something else."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from starhil.hil_tests.attitude import from_radec_roll
from starhil.hil_tests.conformance.attitude_cases import AttitudeRow, identifying_stars
from starhil.hil_tests.conformance.canopen_suite import CANOPEN_CASES
from starhil.hil_tests.conformance.case import Case, CaseFailed, check
from starhil.hil_tests.conformance.runner import identity_of, run_case, run_cases
from starhil.hil_tests.conformance.serial_probe import SerialProbe
from starhil.hil_tests.conformance.suites import can_suite, serial_suite
from starhil.hil_tests.judge.definition import read_unit
from tests.conformance.links import LINKS, ROWS, write_unit
from tests.conformance.mutant_seams import handling, only_acknowledged
from tests.conformance.mutants_units import telemetry_data
from tests.conformance.simulated import SimulatedUnit
from tests.test_your_unit import written as tutorial

pytestmark = pytest.mark.long

SEQUENCE = """
framing = { kind = "length", start = [0xEB, 0x90] }
check = { kind = "crc", type = "u16", poly = 0x1021, init = 0xFFFF }
request_header = [{ role = "length", type = "u16" }, { role = "sequence", type = "u16" }, { role = "id", type = "u8" }]
reply_header = [{ role = "length", type = "u16" }, NUMBER, { role = "id", type = "u8" }, { role = "status", type = "u8" }]
"""
COMMANDS = """
[[telecommand]]
id = 3
name = "set_exposure"
doc = "Set the exposure time."
action = "set_parameters"
fields = [{ name = "exposure", type = "u16", unit = "ms", parameter = "exposure" }]

[[telecommand]]
id = 4
name = "search"
doc = "Identify stars."
action = "set_mode"
arguments = { mode = "lost_in_space" }

[[telecommand]]
id = 5
name = "rest"
doc = "Stop."
action = "set_mode"
arguments = { mode = "standby" }

[[telemetry]]
id = 131
name = "state"
doc = "Mode."
fields = [{ name = "mode", type = "u8", value = "mode", map = { 0 = "boot", 1 = "standby", 2 = "lost_in_space", 3 = "tracking", 4 = "error" } }]

[link.serial]
"""
TRUTH = from_radec_roll(83.8, -1.2, 0.0)


def outcome_of(case: str, unit: Path, served: Path | None = None, damage=None, truth=None):
    """Run a case on a simulated unit, which may serve another definition."""
    cases = {item.id: item for item in serial_suite(read_unit(unit))}
    with SimulatedUnit("serial", damage, unit=unit, served=served) as simulated:
        simulated.probe.truth = truth
        return run_case(simulated.probe, cases[f"serial.{case}"])


def written(folder: Path, name: str, text: str) -> Path:
    """Write a unit in one file into a folder of its own."""
    place = folder / name
    place.mkdir()
    (place / "unit.toml").write_text(text, encoding="utf-8")
    return place


def sequenced(folder: Path, name: str, number: str) -> Path:
    """Write a unit whose replies have this field where its requests have a sequence number."""
    return written(
        folder, name, ROWS.format(name="sequence", order="big") + SEQUENCE.replace("NUMBER", number)
    )


@pytest.mark.parametrize("case", ["framing.two-at-once", "telemetry.numbers", "commands.set_numbers"])
def test_a_sequence_number_that_is_not_repeated_fails(case, tmp_path):
    unit = sequenced(tmp_path, "unit", '{ role = "sequence", type = "u16" }')
    wrong = sequenced(tmp_path, "wrong", '{ type = "u16", const = 0 }')
    low = sequenced(tmp_path, "low", '{ type = "u8", const = 0 }, { role = "sequence", type = "u8" }')
    assert outcome_of(case, unit).status == "passed"
    assert outcome_of(case, unit, wrong).status == "failed"
    assert outcome_of(case, unit, low).status == "failed"


def commanded(folder: Path, name: str = "commanded") -> Path:
    text = ROWS.format(name="commanded", order="big")
    return written(folder, name, text.removesuffix("[link.serial]\n") + COMMANDS + LINKS["sum"])


def test_a_field_without_limits_has_those_of_its_parameter(tmp_path):
    unit, case = commanded(tmp_path), "fields.set_exposure.exposure.high"
    assert outcome_of(case, unit).status == "passed"

    def accept(simulated):
        simulated.device.parameters.set = lambda _changes: None

    outcome = outcome_of(case, unit, damage=accept)
    assert (outcome.status, outcome.seen) == ("failed", "acknowledge of 3")


def negated(folder: Path, order: str = "big") -> Path:
    """A unit that reports the conjugate."""
    text = ROWS.format(name="sum", order=order) + LINKS["sum"]
    for axis in "xyz":
        text = text.replace(
            f'type = "f64", value = "attitude.{axis}"', f'type = "f64", scale = -1, value = "attitude.{axis}"'
        )
    return written(folder, "negated", text)


def test_a_conjugated_quaternion_fails_where_the_truth_is_known(tmp_path):
    unit, served = write_unit(tmp_path / "unit", "sum"), negated(tmp_path)
    case = "attitude.attitude"
    assert outcome_of(case, unit, truth=lambda: TRUTH).status == "passed"
    assert outcome_of(case, unit, served).status == "passed"
    outcome = outcome_of(case, unit, served, truth=lambda: TRUTH)
    assert outcome.status == "failed"
    assert outcome.expected.startswith("the true attitude (")
    assert outcome.seen.endswith("deg off")


def test_a_valid_quaternion_that_is_not_of_length_1_fails_a_safe_case(tmp_path):
    unit = write_unit(tmp_path / "unit", "sum")
    text = (unit / "unit.toml").read_text()
    served = written(
        tmp_path,
        "served",
        text.replace('type = "f64", value = "attitude.', 'type = "f64", scale = 0.5, value = "attitude.'),
    )
    case = next(item for item in serial_suite(read_unit(unit)) if item.id == "serial.telemetry.attitude")
    assert not case.intrusive
    assert outcome_of("telemetry.attitude", unit).status == "passed"
    outcome = outcome_of("telemetry.attitude", unit, served)
    assert (outcome.status, outcome.expected) == ("failed", "a quaternion of length 1 in x, y, z, w")


@pytest.mark.parametrize(
    ("reported", "wanted"), [("lost_in_space", "standby"), ("standby", "lost_in_space or tracking")]
)
def test_a_mode_that_is_not_the_commanded_one_fails(reported, wanted, tmp_path):
    unit = commanded(tmp_path)
    number = {"standby": 1, "lost_in_space": 2}[reported]
    modes = ", ".join(f'"{mode}"' for mode in ("boot", "standby", "lost_in_space", "tracking", "error"))
    text = (unit / "unit.toml").read_text()
    before, _, after = text.partition('map = { 0 = "boot"')
    served = written(tmp_path, "served", f"{before}map = {{ {number} = [{modes}] }}{after.partition('}')[2]}")
    assert outcome_of("attitude.attitude", unit).status == "passed"
    outcome = outcome_of("attitude.attitude", unit, served)
    assert (outcome.status, outcome.seen) == ("failed", reported)
    assert outcome.expected == f"mode of state {wanted} within 5 s of the telecommand (R13, docs/rules.md)"


class Rows:
    """Rows of a unit with given values, and the commands sent."""

    def __init__(self, folder: Path, mode: str, numbers: str = "") -> None:
        folder = commanded(folder)
        if numbers:
            file = folder / "unit.toml"
            before, _, after = file.read_text().partition('map = { 0 = "boot"')
            file.write_text(f"{before}map = {numbers}{after.partition('}')[2]}")
        self.unit = read_unit(folder)
        self.mode = mode
        self.sent: list[str] = []
        self.truth = None

    def telecommands(self):
        return self.unit.telecommands.values()

    def telemetry_rows(self):
        return self.unit.telemetry.values()

    def carries(self, _row, _item):
        return True

    def values(self, _row):
        return {"mode": self.mode, "x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0, "valid": True}

    def command(self, name, **_values):
        self.sent.append(name)


def test_an_attitude_that_is_valid_in_standby_fails(tmp_path):
    rows = Rows(tmp_path, "standby")
    attitude = AttitudeRow.of(rows.unit.telemetry["attitude"], rows.unit.conventions)
    with pytest.raises(CaseFailed, match="in standby"):
        attitude.check(rows, rows.values(attitude.row))
    rows.mode = "tracking"
    attitude.check(rows, rows.values(attitude.row))


def test_a_number_that_stands_for_several_modes_is_not_standby(tmp_path):
    """Read back, it has the name of the first."""
    rows = Rows(
        tmp_path, "standby", '{ 0 = "boot", 3 = ["standby", "lost_in_space", "tracking"], 4 = "error" }'
    )
    attitude = AttitudeRow.of(rows.unit.telemetry["attitude"], rows.unit.conventions)
    attitude.check(rows, rows.values(attitude.row))


@pytest.mark.parametrize(("mode", "last"), [("standby", "rest"), ("tracking", "search")])
def test_the_mode_is_commanded_by_a_telecommand_without_fields_too(mode, last, tmp_path):
    rows = Rows(tmp_path, mode)
    with identifying_stars(rows):
        assert rows.sent == ["search"]
    assert rows.sent == ["search", last]


@pytest.mark.parametrize(
    ("link", "unit", "words"),
    [
        ("serial", "cubestar", "node_type 83, interface_version 1, firmware_major 1"),
        ("canopen", "cubestar", "revision 0x"),
        ("serial", "sagitta", ""),
    ],
)
def test_the_identity_of_a_device_is_read(link, unit, words):
    with SimulatedUnit(link, unit=unit) as simulated:
        assert words in identity_of(simulated.probe)


class SlowPort:
    """A port on which everything arrives later, and not before a time has passed since what came before it."""

    def __init__(self, port, delay_s: float, apart_s: float = 0.0) -> None:
        self.send, self.now = port.send, port.now
        self.port, self.delay_s, self.apart_s = port, delay_s, apart_s
        self.coming = []
        self.last_s = float("-inf")

    def receive(self, timeout_s):
        end = self.now() + timeout_s
        while True:
            if self.coming and self.coming[0][0] <= self.now():
                return self.coming.pop(0)[1]
            until = min(end, self.coming[0][0]) if self.coming else end
            item = self.port.receive(max(0.0, until - self.now()))
            if item is not None:
                self.last_s = max(self.now() + self.delay_s, self.last_s + self.apart_s)
                self.coming.append((self.last_s, item))
            elif self.now() >= end:
                return None


@pytest.mark.parametrize("link", ["serial", "can"])
def test_an_answer_after_the_time_out_is_named_as_late(link):
    suite = {"serial": serial_suite, "can": can_suite}[link]
    case = next(item for item in suite(read_unit("cubestar")) if item.id == f"{link}.telemetry.boot_status")
    with SimulatedUnit(link) as simulated:
        simulated.probe.port = SlowPort(simulated.probe.port, 0.3)
        assert run_case(simulated.probe, case).status == "passed"
        simulated.probe.port.delay_s = 0.7
        outcome = run_case(simulated.probe, case)
    assert outcome.status == "failed"
    assert outcome.seen.startswith("late: telemetry")
    assert outcome.seen.endswith(" after 0.7 s; see --time-out")


def test_segments_still_under_way_from_the_case_before_are_no_answer():
    """A slow machine delivers the rest of a block after the case that began it has ended."""
    cases = {case.id: case for case in CANOPEN_CASES}
    with SimulatedUnit("canopen") as simulated:
        simulated.probe.port = SlowPort(simulated.probe.port, 0.02, 0.02)
        for name in ("upload-repeat", "threshold", "upload"):
            outcome = run_case(simulated.probe, cases[f"canopen.sdo-block.{name}"])
            assert (outcome.status, outcome.seen) == ("passed", ""), "\n".join(outcome.log)


def test_a_late_answer_with_a_sequence_number_is_named_as_late(tmp_path):
    unit = sequenced(tmp_path, "unit", '{ role = "sequence", type = "u16" }')
    with SimulatedUnit("serial", unit=unit) as simulated:
        simulated.probe.port = SlowPort(simulated.probe.port, 0.7)
        outcome = run_cases(simulated.probe, serial_suite(read_unit(unit)), port="/dev/ttyX")[0]
    assert outcome.id == "serial.answers"
    assert re.match(
        r"no valid answer on /dev/ttyX: late: telemetry of .* after 0.7 s; see --time-out$", outcome.seen
    )


def test_the_log_has_every_byte_of_a_long_message():
    case = next(item for item in serial_suite(read_unit("cubestar")) if item.id == "serial.framing.longest")
    with SimulatedUnit("serial") as simulated:
        (sent, *_) = run_case(simulated.probe, case).log
    message = sent.split(" -> ")[1].split()
    assert (message[:2], message[3:]) == (["1F", "7F"], [*["00"] * 511, "1F", "FF"])


def test_a_pause_begins_when_the_line_is_free(tmp_path):
    """At 9600 bits a second, 960 bytes take a second."""

    class Port:
        time_s = 0.0

        def send(self, _data): ...
        def now(self):
            return self.time_s

        def receive(self, timeout_s):
            self.time_s += timeout_s

    unit = read_unit(write_unit(tmp_path, "sum"))
    probe = SerialProbe(Port(), unit, baud=9600)
    probe.send(bytes(960))
    probe.sleep_past_timeout()
    assert probe.now() >= 1.0 + unit.serial.timeout


def test_the_seconds_of_a_failed_case_include_its_recovery(tmp_path, monkeypatch):
    clock = [0.0]
    monkeypatch.setattr("starhil.hil_tests.conformance.runner.time.perf_counter", lambda: clock[0])
    with SimulatedUnit("serial", unit=write_unit(tmp_path, "sum")) as simulated:
        simulated.probe.recover = lambda: clock.__setitem__(0, 9.0)
        outcome = run_case(
            simulated.probe, Case("a.b.c", "a.b", "t", "c", lambda _probe: check(None, "so", "not so"))
        )
    assert outcome.seconds == 9.0


PARAMETERS = """
[[telecommand]]
id = 6
name = "imaging"
doc = "Parameters that contradict each other, a scale, a flag and an enumeration."
action = "set_parameters"
fields = [
    { name = "exposure", type = "u16", unit = "ms", scale = 0.5, parameter = "exposure" },
    { name = "rate", type = "f32", unit = "Hz", parameter = "update_rate" },
    { name = "gain", type = "u16", scale = 0.01, parameter = "analog_gain" },
    { name = "start", type = "enum8", enum = "start_mode", parameter = "start_mode" },
    { type = "bits8", bits = [{ name = "follows", parameter = "tracking_enable" }, { width = 7 }] },
]

[[telemetry]]
id = 132
name = "imaging_state"
doc = "As set."
include = ["imaging"]

[[telemetry]]
id = 133
name = "flag"
doc = "Not all of them."
fields = [{ type = "bits8", bits = [{ name = "follows", value = "parameter.tracking_enable" }, { width = 7 }] }]

[[telecommand]]
id = 7
name = "relocate"
doc = "Changes the address of the unit."
action = "set_parameters"
fields = [{ name = "address", type = "u8", parameter = "can_address" }]

[[telemetry]]
id = 134
name = "address"
doc = "The address."
include = ["relocate"]

[link.serial]
"""


def of_row(name: str, change) -> object:
    return telemetry_data(lambda data, row: change(data) if row.name == name else data)


def flipped(place: int):
    return lambda data: data[:place] + bytes((data[place] ^ 1,)) + data[place + 1 :]


@pytest.mark.parametrize(
    "damage",
    [
        of_row("exposure", flipped(1)),
        of_row("exposure", lambda _data: b"\x03\xe8"),
        only_acknowledged(0x12),
        handling(lambda _device, request, handle: handle(request) if request.id != 0x12 else []),
    ],
    ids=["a bit of the answer", "a constant", "forgotten", "unanswered"],
)
def test_a_parameter_of_the_tutorial_that_is_not_reported_as_set_fails(damage, tmp_path):
    unit, case = tutorial(tmp_path / "lynx"), "settings.exposure.set_exposure"
    assert outcome_of(case, unit).status == "passed"
    assert outcome_of(case, unit, damage=damage).status == "failed"


SETTINGS = ["serial.settings.numbers", "serial.settings.imaging_state.imaging"]


def with_parameters(folder: Path) -> Path:
    text = ROWS.format(name="parameters", order="big").removesuffix("[link.serial]\n")
    return written(folder, "parameters", text + PARAMETERS + LINKS["sum"])


@pytest.mark.parametrize("place", [1, 3, 7, 8, 9])
def test_parameters_are_read_back_and_restored(place, tmp_path):
    unit = with_parameters(tmp_path)
    cases = {item.id: item for item in serial_suite(read_unit(unit))}
    assert [name for name in cases if ".settings." in name] == SETTINGS
    with SimulatedUnit("serial", unit=unit) as simulated:
        before = simulated.probe.telemetry("imaging_state")
        outcome = run_case(simulated.probe, cases["serial.settings.imaging_state.imaging"])
        assert (outcome.status, outcome.expected, outcome.seen) == ("passed", "", "")
        assert simulated.probe.telemetry("imaging_state") == before
    assert (
        outcome_of(
            "settings.imaging_state.imaging", unit, damage=of_row("imaging_state", flipped(place))
        ).status
        == "failed"
    )


def test_parameters_that_a_row_reports_are_restored_after_the_run(tmp_path):
    def leave_changed(probe):
        seen = probe.telemetry("imaging_state")
        probe.command("imaging", **{**seen, "follows": not seen["follows"]})

    with SimulatedUnit("serial", unit=with_parameters(tmp_path)) as simulated:
        before = simulated.probe.telemetry("imaging_state")
        case = Case("serial.own.change", "serial.own", "t", "c", leave_changed, intrusive=True)
        outcomes = run_cases(simulated.probe, [case])
        assert [outcome.status for outcome in outcomes] == ["passed"]
        assert simulated.probe.telemetry("imaging_state") == before


def test_a_reason_names_few_fields_and_the_reports_list_all() -> None:
    unit = read_unit("cubestar")
    (case,) = [item for item in serial_suite(unit) if item.id == "serial.unjudged.stars"]
    with SimulatedUnit("serial") as simulated:
        outcome = run_case(simulated.probe, case)
    count, _, rest = outcome.seen.partition(" ")
    assert rest.startswith("fields, such as star_magnitudes.magnitude_1 (stars[1].magnitude), ")
    assert len(outcome.seen) < 250
    listed = [line for line in outcome.log if line.startswith("not judged: ")]
    assert len(listed) == int(count) > 20
