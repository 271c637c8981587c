"""The exported C talks to the running emulator over its pty: every row, every dialect, and the example of the docs."""

from __future__ import annotations

import re
import struct
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from starhil.hil_tests.client import ObcClient
from starhil.protocol.export import export_folder
from starhil.protocol.export.packets import key_of
from starhil.protocol.messages import ErrorCode, Reply, ReplyKind
from starhil.protocol.serial.cubespace import Dialect
from starhil.protocol.unit import load_unit
from tests.protocol.export.c_driver import COMPILER, FLAGS, CDriver, c_words, hex_or_none
from tests.protocol.export.test_c import KINDS
from tests.protocol.serial.composed_links import CUBESTAR
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.process

ICD = load_unit()
DISRUPTIVE = frozenset({"reset", "restore_parameters", "default_parameters"})
"""Telecommands that change the dialect of the line."""
STEADY = frozenset({"boot_status", "star_config", "hole_map_1", "parameter"})
"""Telemetry that stays the same from one request to the next in standby."""


@pytest.fixture(scope="module")
def c(tmp_path_factory: pytest.TempPathFactory) -> Iterator[CDriver]:
    with CDriver(ICD, tmp_path_factory.mktemp("c")) as driver:
        yield driver


@pytest.fixture(params=list(Dialect))
def line(request: pytest.FixtureRequest, c: CDriver, emulator, can_obc: ObcClient) -> Iterator[CDriver]:
    """The program on the serial line, whose replies have a dialect."""
    identifier = ICD.parameters["serial_dialect"].id
    number = ICD.enums["serial_dialect"].values[request.param.value]
    can_obc.command("set_mode", mode="standby")
    can_obc.command("set_parameter", parameter=identifier, value=number)
    assert c("open", emulator.ready["serial"], list(Dialect).index(request.param)) == ["0"]
    yield c
    can_obc.command("default_parameters")


def test_every_telemetry_row_is_asked_for_and_read(line: CDriver, can_obc: ObcClient) -> None:
    for row in ICD.telemetry.values():
        kind, identifier, _, data = line("ask", row.id, "-")
        assert (KINDS[int(kind)], int(identifier), len(data) // 2) == ("telemetry", row.id, row.size)
        result, *words = line("decode", row.name, data)
        assert (result, words) == ("0", c_words(row, row.decode(bytes.fromhex(data))))
        if row.name in STEADY:
            assert words == c_words(row, can_obc.telemetry(row.name))


def test_every_telecommand_is_made_and_taken(line: CDriver, can_obc: ObcClient) -> None:
    for row in ICD.telecommands.values():
        if row.name in DISRUPTIVE or not CUBESTAR.answers(row):
            continue
        data = b""
        if row.named_fields:
            result, text = line("encode", row.name, *c_words(row, row.example()))
            data = bytes.fromhex(text)
            assert (result, data) == ("0", row.encode(row.example()))
        kind, identifier, code, _ = line("ask", row.id, hex_or_none(data))
        assert int(identifier) == row.id
        assert KINDS[int(kind)] in ("ack", "nack")
        assert (KINDS[int(kind)] == "ack") == (int(code) == ErrorCode.OK)
        seen = can_obc.telemetry("acknowledge")
        assert seen["last_telecommand"] == row.id
        assert ICD.enums["error_code"].values[seen["error"]] == int(code)


def test_a_refusal_comes_with_its_code(line: CDriver) -> None:
    for identifier, data, code in ((200, "-", 1), (60, "-", 1), (2, "00", 2), (96, "4d", 3)):
        assert line("ask", identifier, data)[:3] == [str(KINDS.index("nack")), str(identifier), str(code)]


@pytest.fixture(scope="module")
def component(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The component of docs/c-export.md and the exported C, compiled."""
    if COMPILER is None:
        pytest.skip("no C compiler (cc, gcc or clang) here: the example of docs/c-export.md is not compiled")
    folder = tmp_path_factory.mktemp("component")
    page = (Path(__file__).parents[2] / "docs" / "c-export.md").read_text(encoding="utf-8")
    files = dict(re.findall(r"^```c\n/\* (\S+) \*/\n(.*?)^```$", page, re.MULTILINE | re.DOTALL))
    for name, text in {**files, **export_folder(ICD, "c")}.items():
        (folder / name).write_text(text)
    for source in folder.glob("*.c"):
        run_program(str(COMPILER), *FLAGS, "-c", "-o", source.with_suffix(".o"), source)
    return folder


def make_program(component: Path, folder: Path, main: str) -> Path:
    """Compile a main function with the component, and return the program."""
    source, program = folder / "main.c", folder / "example"
    source.write_text(main)
    run_program(
        str(COMPILER), *FLAGS, f"-I{component}", "-o", program, source, *sorted(component.glob("*.o"))
    )
    return program


def run_program(*words: object) -> str:
    done = subprocess.run(
        list(map(str, words)), capture_output=True, text=True, check=False, timeout=PATIENCE_S
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


def test_the_component_of_the_docs_reads_the_attitude(emulator, component: Path, tmp_path: Path) -> None:
    main = Path(__file__).with_name("star_sensor_main.c").read_text(encoding="utf-8")
    program = make_program(component, tmp_path, main)
    with ObcClient.open(serial=emulator.ready["serial"], timeout_s=PATIENCE_S) as obc:
        obc.command("set_mode", mode="standby")  # as after boot
    counts, attitude = run_program(program, emulator.ready["serial"]).splitlines()
    assert counts == "acknowledges 2, refusals 0, faults 0, lost 0"
    with ObcClient.open(serial=emulator.ready["serial"], timeout_s=PATIENCE_S) as obc:
        truth = obc.wait_for("precise_attitude", lambda reading: bool(reading["valid"]), within_s=PATIENCE_S)
    seen = [float(word) for word in attitude.removeprefix("valid 1, q ").split()]
    assert seen == pytest.approx([truth[name] for name in ("q_x", "q_y", "q_z", "q_w")], abs=1e-4)


COMPONENT_UNDER_BAD_REPLIES = r"""
#include "star_sensor.h"
#include <stdio.h>
static void write_nothing(void *uart, const uint8_t *bytes, size_t size) { (void)uart; (void)bytes; (void)size; }
static const uint8_t acknowledge[] = {0x1F, 0x7F, 0x00, 0x1F, 0xFF}, replies[][SIZE] = {REPLIES};
int main(void)
{
    star_sensor_t sensor;
    size_t i;
    for (i = 0u; i < sizeof replies / sizeof replies[0]; ++i) {
        star_sensor_init(&sensor, write_nothing, NULL);
        printf("%d ", star_sensor_set_time(&sensor, 1u));
        printf("%d ", star_sensor_request_attitude(&sensor));
        star_sensor_silent(&sensor);
        printf("%d ", star_sensor_request_attitude(&sensor));
        star_sensor_received(&sensor, acknowledge, sizeof acknowledge); /* of the time, too late */
        star_sensor_received(&sensor, replies[i], sizeof replies[i]);
        printf("%u %u %u %u %u\n", (unsigned)sensor.attitudes, (unsigned)sensor.acknowledges,
               (unsigned)sensor.refusals, (unsigned)sensor.faults, (unsigned)sensor.lost);
    }
    return 0;
}
"""


def test_the_component_of_the_docs_takes_no_bad_attitude_and_no_late_acknowledge(
    component: Path, tmp_path: Path
) -> None:
    row = ICD.telemetry["precise_attitude"]
    good = row.encode(row.example() | {"q_x": 0.25})
    bad = good.replace(struct.pack("<f", 0.25), struct.pack("<f", float("nan")))
    lines = [
        CUBESTAR.encode_reply(Reply(ReplyKind.TELEMETRY, row.id, data), Dialect.B) for data in (good, bad)
    ]
    main = COMPONENT_UNDER_BAD_REPLIES.replace("SIZE", str(len(lines[0])))
    main = main.replace("REPLIES", ", ".join(f"{{{', '.join(map(str, line))}}}" for line in lines))
    counts = run_program(make_program(component, tmp_path, main)).splitlines()
    assert counts == ["0 -1 0 1 0 0 1 1", "0 -1 0 0 0 0 2 1"]


def test_a_unit_with_another_link_is_driven_through_its_c(sagitta, tmp_path: Path) -> None:
    """Each telecommand is accepted, and each telemetry row is read, over SLIP with XXH32."""
    icd = load_unit("sagitta")
    with CDriver(icd, tmp_path) as driver:
        assert driver("open", sagitta.ready["serial"], 0) == ["0"]
        for row in icd.telecommands.values():
            if row.action == "subscribe":
                continue
            _, data = driver("encode", row.name, *c_words(row, row.example()))
            assert driver("ask", key_of(icd, row), data) == ["2", str(key_of(icd, row)), "0", "-"]
        for row in icd.telemetry.values():
            kind, key, _, data = driver("ask", key_of(icd, row), "-")
            assert (kind, key, len(data) // 2) == ("1", str(key_of(icd, row)), row.size)
            values = row.decode(bytes.fromhex(data))
            assert driver("decode", row.name, data) == ["0", *c_words(row, values)]
        refused = key_of(icd, icd.telecommands["set_camera"])
        assert driver("ask", refused, "00")[:2] == ["3", str(refused)]
