"""CubeStar's own cases on any link: acknowledge, counters, data, time, modes, reset, parameter store."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Final

from starhil.configs.units.cubestar.controls import (
    CubeStarSettings,
    parameter,
    parameters_kept,
    reset,
    save_parameters,
    set_parameter,
    standby,
    value_of,
)
from starhil.hil_tests.conformance.case import CaseArea, CaseSkipped, check, check_equal, rule
from starhil.hil_tests.conformance.link_probe import (
    INVALID_CRC,
    INVALID_ID,
    INVALID_PARAMETER,
    SEQUENCE,
    LinkProbe,
)
from starhil.hil_tests.judge.messages import Value

CLOCK_STEP_S: Final = 1_700_000_000
CLOCK_TOLERANCE_S: Final = 0.25
TEST_VALUE: Final = 137.0
TELEMETRY_REQUESTS: Final = 30

settings = CubeStarSettings
"""What a run records and restores."""

ACKNOWLEDGE: Final = CaseArea[LinkProbe](
    "acknowledge",
    "CubeComputer TLM 240: last telecommand, processed, error, index (AlbertaSat, CTS)",
    intrusive=True,
)
COUNTERS: Final = CaseArea[LinkProbe](
    "counters", "CubeComputer TLM 144: counts of telecommands and telemetry (AlbertaSat, CTS)"
)
DATA: Final = CaseArea[LinkProbe](
    "data", "CubeComputer TC 120 to 127 and TLM 247 to 254 (AlbertaSat, CTS)", intrusive=True
)
TIME: Final = CaseArea[LinkProbe]("time", "CubeComputer TC 2 and TLM 140 (AlbertaSat, CTS)")
MODES: Final = CaseArea[LinkProbe]("modes", rule(11), intrusive=True)
RESET: Final = CaseArea[LinkProbe](
    "reset", "CubeComputer TC 1, magic number 0x5A, and TLM 128, 129 (AlbertaSat, CTS)", intrusive=True
)
STORE: Final = CaseArea[LinkProbe]("store", rule(16), intrusive=True)


# --- acknowledge ---


@ACKNOWLEDGE.case("accepted", "after an accepted telecommand: its ID, processed, no error")
def acknowledge_accepted(probe: LinkProbe) -> None:
    for name, values in (("select_parameter", {"parameter": 1}), ("clear_counters", {})):
        probe.command(name, **values)
        reply = probe.telemetry("acknowledge")
        content = {
            "last_telecommand": probe.unit.telecommands[name].id,
            "processed": True,
            "error": "ok",
            "parameter_index": 0,
        }
        check_equal(reply, content, "acknowledge")


@ACKNOWLEDGE.case("unknown", "after an unknown telecommand: its ID and invalid_id")
def acknowledge_unknown(probe: LinkProbe) -> None:
    probe.expect_refusal(60, b"", INVALID_ID)
    seen = probe.telemetry("acknowledge")
    fields = (seen["last_telecommand"], seen["processed"], seen["error"])
    check_equal(fields, (60, True, "invalid_id"), "acknowledge")


@ACKNOWLEDGE.case("kept", "reading telemetry does not change the acknowledge")
def acknowledge_kept(probe: LinkProbe) -> None:
    probe.expect_refusal(96, b"\x4d", INVALID_PARAMETER)
    first = probe.telemetry("acknowledge")
    for name in ("identification", "acknowledge", "device_status"):
        probe.telemetry(name)
    check_equal(probe.telemetry("acknowledge"), first, "acknowledge")


@ACKNOWLEDGE.case("forgets", "a later success clears the error")
def acknowledge_forgets(probe: LinkProbe) -> None:
    probe.expect_refusal(2, bytes.fromhex("00000000FFFF"), INVALID_PARAMETER)
    probe.command("clear_counters")
    seen = probe.telemetry("acknowledge")
    check_equal((seen["error"], seen["parameter_index"]), ("ok", 0), "error and index")


@ACKNOWLEDGE.case(
    "crc",
    "a CRC-8 may follow a telecommand, and is checked",
    "firmware reference manual 5.5: CRC-8 of the data (CTS adcs_internal_drivers.c, EnduroSat cubeadcs_driver.c)",
)
def acknowledge_crc(probe: LinkProbe) -> None:
    """The bytes are examples of the source's table: FF for no data, 72 for 5A."""
    for name, data, code in (("clear_counters", b"", 0xFF), ("format_card", b"\x5a", 0x72)):
        row = probe.unit.telecommands[name]
        probe.send_command(row, data + bytes((code,)))
        probe.expect_refusal(row, data + bytes((code ^ 1,)), INVALID_CRC)


# --- counters ---


def _counts(probe: LinkProbe) -> tuple[int, int]:
    seen = probe.telemetry("communication_status")
    return int(seen["telecommand_count"]), int(seen["telemetry_count"])


@COUNTERS.case("telemetry", "each telemetry request counts once, including the one that reads the counters")
def counters_telemetry(probe: LinkProbe) -> None:
    commands, before = _counts(probe)
    for _ in range(TELEMETRY_REQUESTS):
        probe.telemetry("identification")
    after_commands, after = _counts(probe)
    check_equal((after - before) % 65536, TELEMETRY_REQUESTS + 1, "increase")
    check_equal(after_commands, commands, "count of telecommands")


@COUNTERS.case("refused-telemetry", "a refused telemetry request is counted too")
def counters_refused_telemetry(probe: LinkProbe) -> None:
    _, before = _counts(probe)
    probe.expect_refusal(200, b"", INVALID_ID)
    check_equal((_counts(probe)[1] - before) % 65536, 2, "increase")


@COUNTERS.case("telecommands", "each telecommand counts once, accepted or refused", intrusive=True)
def counters_telecommands(probe: LinkProbe) -> None:
    before, _ = _counts(probe)
    probe.command("select_parameter", parameter=1)
    probe.expect_refusal(60, b"", INVALID_ID)
    probe.ask(2, b"\x01")
    probe.expect_refusal(96, b"\x4d", INVALID_PARAMETER)
    check_equal((_counts(probe)[0] - before) % 65536, 4, "increase")


@COUNTERS.case("clear", "clear_counters sets both counts to zero", intrusive=True)
def counters_clear(probe: LinkProbe) -> None:
    """clear_counters itself is not counted, but the reading afterwards is."""
    probe.command("clear_counters")
    check_equal(_counts(probe), (0, 1), "counts")


# --- data are transferred unchanged: the hole map as an echo ---

ECHOES: Final = (
    ("zeros", bytes(16)),
    ("ones", b"\xff" * 16),
    ("escapes", b"\x1f" * 16),
    ("starts", b"\x1f\x7f" * 8),
    ("ends", b"\x1f\xff" * 8),
    ("escape-last", bytes(15) + b"\x1f"),
    ("escape-first", b"\x1f" + bytes(15)),
    ("ramp", bytes(range(16))),
    ("ramp-of-escapes", bytes(range(0x18, 0x28))),
)


def _echo(data: bytes, probe: LinkProbe) -> None:
    for chunk in (1, 8):
        probe.send_command(probe.unit.telecommands[f"set_hole_map_{chunk}"], data)
        check_equal(probe.data_of(probe.unit.telemetry[f"hole_map_{chunk}"]), data, "the same bytes")


for _name, _data in ECHOES:
    DATA.case(_name, f"16 bytes ({_name}) are read back unchanged")(partial(_echo, _data))


@DATA.case("parts", "the eight parts of the hole map are independent")
def parts(probe: LinkProbe) -> None:
    for part in range(1, 9):
        probe.send_command(probe.unit.telecommands[f"set_hole_map_{part}"], bytes([part]) * 16)
    for part in range(1, 9):
        seen = probe.data_of(probe.unit.telemetry[f"hole_map_{part}"])
        check_equal(seen, bytes([part]) * 16, f"part {part}")


# --- time ---


def _clock(probe: LinkProbe) -> float:
    seen = probe.telemetry("unix_time")
    return int(seen["seconds"]) + int(seen["milliseconds"]) / 1000.0


def _runtime(identification: Mapping[str, Value]) -> float:
    return int(identification["runtime_s"]) + int(identification["runtime_ms"]) / 1000.0


def _frames(probe: LinkProbe) -> int:
    return int(probe.telemetry("device_status")["frames_captured"])


@TIME.case("set", "the clock has the time to which it was set", intrusive=True)
def time_set(probe: LinkProbe) -> None:
    """The values include bytes that must be stuffed; the clock is restored afterwards."""
    with _kept_clock(probe):
        for seconds, milliseconds in ((CLOCK_STEP_S, 250), (0x1F1F1F1F, 31), (0, 0), (0xFFFFFFF0, 999)):
            probe.command("set_unix_time", seconds=seconds, milliseconds=milliseconds)
            wanted = seconds + milliseconds / 1000.0
            seen = _clock(probe)
            check(0.0 <= seen - wanted <= CLOCK_TOLERANCE_S, f"clock from {wanted:.3f} on", f"{seen:.3f}")


@contextmanager
def _kept_clock(probe: LinkProbe) -> Iterator[None]:
    before, began = _clock(probe), probe.now()
    try:
        yield
    finally:
        whole = before + probe.now() - began
        probe.command("set_unix_time", seconds=int(whole), milliseconds=int(whole % 1.0 * 1000))


@TIME.case("runs", "the clock runs as fast as the tester's clock")
def time_runs(probe: LinkProbe) -> None:
    begin, first = probe.now(), _clock(probe)
    middle = probe.now()
    probe.sleep(1.0)
    third, last = probe.now(), _clock(probe)
    end = probe.now()
    least, most = third - middle, end - begin
    check(
        0.98 * least <= last - first <= 1.02 * most + 0.002,
        f"{least:.3f} to {most:.3f} s",
        f"{last - first:.3f} s",
    )


@TIME.case("flag", "device_status reports the same time, and that the clock was set", intrusive=True)
def time_flag(probe: LinkProbe) -> None:
    with _kept_clock(probe):
        probe.command("set_unix_time", seconds=CLOCK_STEP_S, milliseconds=0)
        status = probe.telemetry("device_status")
    check(status["time_set"], "flag time_set", "not set")
    clock = float(status["clock"])
    check(0.0 <= clock - CLOCK_STEP_S <= CLOCK_TOLERANCE_S, f"clock from {CLOCK_STEP_S} on", clock)


@TIME.case(
    "uptime",
    "runtime and uptime agree and grow",
    "CubeComputer TC 1, magic number 0x5A, and TLM 128, 129 (AlbertaSat, CTS)",
)
def uptime(probe: LinkProbe) -> None:
    """The run time in identification wraps at 65536 s."""
    first = probe.telemetry("identification")
    status = probe.telemetry("device_status")
    check(int(first["runtime_ms"]) < 1000, "milliseconds below 1000", first["runtime_ms"])
    difference = float(status["uptime"]) % 65536 - _runtime(first)
    check(-0.002 <= difference <= 1.0, "uptime just after runtime", f"{difference:.3f} s apart")
    probe.sleep(0.2)
    second = probe.telemetry("device_status")
    grown = float(second["uptime"]) - float(status["uptime"])
    check(0.15 <= grown <= 2.0, "0.2 s more", f"{grown:.3f} s")


# --- modes ---


@MODES.case("standby", "in standby no attitude is valid, and the rows agree")
def in_standby(probe: LinkProbe) -> None:
    standby(probe)
    probe.wait_for("device_status", {"attitude_valid": False}, 2.0)
    attitude = probe.telemetry("precise_attitude")
    check_equal((attitude["valid"], attitude["q_x"], attitude["q_w"]), (False, 0.0, 0.0), "valid, q_x, q_w")
    check(attitude["reason"] != "ok", "a reason other than ok", attitude["reason"])
    check(not probe.telemetry("star_performance_2")["attitude_ok"], "attitude_ok not set", "set")


@MODES.case("frames", "frames are taken at the update rate outside standby, and none in standby", rule(12))
def frames(probe: LinkProbe) -> None:
    standby(probe)
    with parameters_kept(probe, "update_rate", "exposure"):
        set_parameter(probe, "exposure", 50.0)
        set_parameter(probe, "update_rate", 5.0)
        probe.command("set_mode", mode="lost_in_space")
        probe.sleep(0.6)
        first = _frames(probe)
        probe.sleep(2.0)
        made = _frames(probe) - first
        check(9 <= made <= 11, "9 to 11 frames in 2 s at 5 Hz", made)
        probe.command("set_mode", mode="standby")
        probe.sleep(1.0)
        first = _frames(probe)
        probe.sleep(0.6)
        check_equal(_frames(probe), first, "frames in standby")


@MODES.case("changes", "mode and its counter follow the command", rule(13))
def changes(probe: LinkProbe) -> None:
    standby(probe)
    first = int(probe.telemetry("device_status")["mode_changes"])
    probe.command("set_mode", mode="lost_in_space")
    mode = probe.telemetry("device_status")["mode"]
    check(mode in ("lost_in_space", "tracking"), "mode lost_in_space or tracking", mode)
    probe.command("set_mode", mode="standby")
    seen = probe.telemetry("device_status")
    check_equal(seen["mode"], "standby", "mode")
    more = (int(seen["mode_changes"]) - first) % 256
    check(more >= 2, "two changes or more", more)


@MODES.case("no-tracking", "tracking without an attitude to start from is refused with code 7", rule(14))
def no_tracking(probe: LinkProbe) -> None:
    reset(probe)
    probe.expect_refused("set_mode", SEQUENCE, mode="tracking")
    check_equal(probe.telemetry("device_status")["mode"], "standby", "mode")


@MODES.case(
    "attitude",
    "with stars in view, the attitude is valid, of unit length and recent, and all rows agree",
    rule(15),
)
def valid_attitude(probe: LinkProbe) -> None:
    standby(probe)
    probe.command("set_mode", mode="lost_in_space")
    end = probe.now() + 20.0
    while not (attitude := probe.telemetry("precise_attitude"))["valid"]:
        if probe.now() > end:
            standby(probe)
            raise CaseSkipped("no attitude was found within 20 s: no stars in view?")
        probe.sleep(0.1)
    clock = float(probe.telemetry("device_status")["clock"])
    length = sum(float(attitude[key]) ** 2 for key in ("q_x", "q_y", "q_z", "q_w")) ** 0.5
    check(abs(length - 1.0) < 1e-5, "a quaternion of length 1", f"{length:.7f}")
    check(float(attitude["q_w"]) >= 0.0, "scalar part not negative", attitude["q_w"])
    check_equal(attitude["reason"], "ok", "reason")
    check(int(attitude["stars_matched"]) >= 3, "three stars or more", attitude["stars_matched"])
    age = clock - float(attitude["time_of_exposure"])
    check(0.0 <= age <= 5.0, "time of exposure up to 5 s ago", f"{age:.3f} s")
    probe.command("set_mode", mode="standby")


# --- reset ---


@RESET.case("magic", "reset without its magic number is refused and has no effect")
def reset_magic(probe: LinkProbe) -> None:
    """The refused numbers include CubeWheel's, 0x55."""
    before = probe.telemetry("boot_status")["boot_count"]
    row = probe.unit.telecommands["reset"]
    for magic in (0x00, 0x55, 0x59, 0x5B, 0xFF):
        probe.expect_refusal(row, bytes([magic]), INVALID_PARAMETER)
    probe.sleep(0.2)
    check_equal(probe.telemetry("boot_status")["boot_count"], before, "boot count")


@RESET.case(
    "acknowledged",
    "reset is acknowledged, but not on a serial line, then the device restarts with the cause command",
)
def reset_acknowledged(probe: LinkProbe) -> None:
    before = probe.telemetry("boot_status")
    began = probe.now()
    reset(probe)
    seen = probe.telemetry("boot_status")
    check_equal(int(seen["boot_count"]), (int(before["boot_count"]) + 1) % 65536, "boot count")
    check_equal(seen["reset_cause"], "command", "reset cause")
    runtime = _runtime(probe.telemetry("identification"))
    check(runtime <= probe.now() - began + 0.01, "runtime from zero", f"{runtime:.3f} s")
    check_equal(_counts(probe)[0], 0, "count of telecommands")
    check_equal(probe.telemetry("acknowledge")["last_telecommand"], 0, "last telecommand")


# --- store ---


@STORE.case("reset", "at a reset, an unsaved parameter is lost and a saved one kept")
def store_reset(probe: LinkProbe) -> None:
    before = value_of(probe, "exposure")
    set_parameter(probe, "exposure", TEST_VALUE)
    probe.wait_for("device_status", {"parameters_changed": True}, 1.0)
    save_parameters(probe)
    set_parameter(probe, "exposure", TEST_VALUE + 1)
    reset(probe)
    try:
        check_equal(value_of(probe, "exposure"), TEST_VALUE, "saved exposure")
    finally:
        set_parameter(probe, "exposure", before)
        save_parameters(probe)


@STORE.case("restore", "restore_parameters applies the stored values", rule(17))
def store_restore(probe: LinkProbe) -> None:
    before = value_of(probe, "exposure")
    save_parameters(probe)
    set_parameter(probe, "exposure", TEST_VALUE)
    probe.command("restore_parameters")
    check_equal(value_of(probe, "exposure"), before, "exposure")


@STORE.case("defaults", "default_parameters sets the defaults and keeps the stored values", rule(18))
def store_defaults(probe: LinkProbe) -> None:
    save_parameters(probe)
    stored = value_of(probe, "limiting_magnitude")
    set_parameter(probe, "limiting_magnitude", 4.25)
    save_parameters(probe)
    probe.command("default_parameters")
    seen = parameter(probe, "limiting_magnitude")
    check_equal(seen["value"], seen["default"], "limiting_magnitude")
    probe.command("restore_parameters")
    check_equal(value_of(probe, "limiting_magnitude"), 4.25, "stored limiting_magnitude")
    set_parameter(probe, "limiting_magnitude", stored)
    save_parameters(probe)


@STORE.case(
    "config",
    "set_star_config sets all parameters or none, and star_config reports them",
    "CubeComputer TC 37, TLM 202 (AlbertaSat)",
)
def star_config(probe: LinkProbe) -> None:
    row = probe.unit.telecommands["set_star_config"]
    before = probe.telemetry("star_config")
    config = {**before, "exposure": 140, "max_stars_matched": 40}
    probe.command("set_star_config", **config)
    check_equal(probe.telemetry("star_config"), config, "star_config")
    check_equal(value_of(probe, "exposure"), 140.0, "parameter exposure")
    bad = bytearray(row.encode({**config, "exposure": 160}))
    bad[row.named["max_stars_matched"].offset] = 0
    probe.expect_refusal(row, bytes(bad), INVALID_PARAMETER)
    check_equal(probe.telemetry("star_config"), config, "star_config after a refusal")
    probe.command("set_star_config", **before)
