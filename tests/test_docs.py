"""What the documents show is what happens: their code runs, their frames are answered, their tables are up to date."""

from __future__ import annotations

import ast
import contextlib
import csv
import dataclasses
import io
import math
import re
import shlex
import shutil
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import can
import cv2
import pytest

from starhil.emulator.device.parameters import Parameters
from starhil.emulator.errors import EmulatorError
from starhil.emulator.profile import load_profile
from starhil.emulator.profile.pipeline_setup import pipeline_setup
from starhil.emulator.run.truth_log import COLUMNS
from starhil.emulator.sensor.model import SensorModel
from starhil.emulator.sensor.renderer import render
from starhil.emulator.sensor.sky.view import Sky
from starhil.emulator.truth.csv_file import BOUNDS
from starhil.emulator.truth.source import TruthStatus
from starhil.hil_tests.rig.emulator_process import emulator_command
from starhil.hil_tests.rig.private_can_bus import hub_thread, private_can_bus
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.canopen.device_dictionary import DeviceDictionary
from starhil.protocol.export import export
from starhil.protocol.unit import load_unit
from starid.attitude import Attitude
from starid.camera import Camera
from starid.catalog import load_catalog
from tests.emulator.cli.command_line import run_command_line
from tests.emulator.emulator_thread import EmulatorThread
from tests.process.conftest import NO_IMAGES, NO_IMAGES_OPTIONS
from tests.typed_pages import DOCS, PAGES, UNASKED, Block, assert_shown, blocks
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.long

_NUMBER = re.compile(r"-?(?:(?<!\.)\b[0-9A-F]{2}\b(?!\.)|\d+(?:\.\d+)?)")


def programs(name: str) -> list[tuple[Block, str]]:
    """Python blocks, each with the text block that shows what it prints."""
    found = blocks(name)
    return [
        (block, after.text)
        for block, after in pairwise(found)
        if (block.language, after.language) == ("python", "text")
    ]


def run(block: Block, namespace: dict[str, object]) -> str:
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(block.text, block.heading, "exec"), namespace)
    return printed.getvalue()


def without_numbers(text: str) -> str:
    return _NUMBER.sub("#", text)


def numbers(text: str) -> list[float]:
    return [float(number) for number in re.findall(r"-?\d+(?:\.\d+)?", text)]


def test_the_examples_of_the_sky_are_valid_and_run(tmp_path):
    examples = blocks("sky.md")
    for block in examples:
        if block.language == "toml":
            path = tmp_path / "profile.toml"
            path.write_text(block.text, encoding="utf-8")
            sky = Sky(pipeline_setup(load_profile(str(path))).sky)
            assert sky.by_date
    (program,) = (block for block in examples if block.language == "python")
    run(program, {})


def test_the_library_example_of_the_readme_prints_the_attitude_of_its_image(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    truth = Attitude.from_radec_roll(83.8, -1.2, 30.0)
    cv2.imwrite(
        "sky.png", render(Camera.from_fov(20.0, width=640, height=480), load_catalog(), truth, seed=1).image
    )
    _, program = blocks("../README.md", language="python")
    assert run(program, {}) == "True RA 83.80, Dec -1.20\n"


def test_the_interface_definition_among_the_pages_is_the_present_export():
    file = DOCS / "icd" / "cubestar.md"
    remedy = f"{file} is out of date; run: python tools/make_reference.py"
    assert file.read_text(encoding="utf-8") == export(load_unit(), "markdown"), remedy


def table_after(name: str, heading: str) -> list[list[str]]:
    """Rows of the first table under a heading, without its head."""
    text = (DOCS / name).read_text(encoding="utf-8").split(f"## {heading}\n")[1]
    rows = [
        line.strip("|").split("|") for line in text.split("\n## ")[0].splitlines() if line.startswith("|")
    ]
    return [[cell.strip() for cell in row] for row in rows[2:]]


def sensor_values(name: str) -> dict[str, object]:
    """Values of a profile by the keys that the data sheet names."""
    profile = load_profile(name)
    sections: dict[str, dict[str, object]] = {
        "camera": {
            **profile.camera.model_dump(exclude_none=True),
            "focal_px": Camera.from_dict(profile.camera_values).focal_px[0],
        },
        "sensor": dataclasses.asdict(SensorModel(**profile.sensor)),
        "timing": profile.timing.model_dump(),
        "device": profile.device.model_dump(),
        "thermal": profile.thermal.model_dump(),
        "power": profile.power.model_dump(),
        "radiation": profile.radiation.model_dump(),
        "catalog": profile.catalog.model_dump(),
        "parameters": {name: item.default for name, item in load_unit().parameters.items()}
        | profile.parameters,
    }
    return {f"{name}.{key}": value for name, part in sections.items() for key, value in part.items()}


def test_sensor_gives_the_values_of_both_profiles():
    ideal, cubestar, icd = sensor_values("ideal"), sensor_values("cubestar"), load_unit()
    checked = 0
    for heading in ("Optics", "Detector", "Temperature, power, radiation", "Timing"):
        for row in table_after("sensor.md", heading):
            if not row[1].startswith("`"):
                continue
            key, shown = row[1].strip("`"), row[2]
            value = ideal[key]
            assert bool(row[3]) is (cubestar.get(key, value) != value), key
            if isinstance(value, (int, float)) and not isinstance(value, bool):
                assert float(re.split(r"[ °]", shown)[0]) == pytest.approx(value, rel=1e-6), key
                assert float(re.split(r"[ °,]", row[3] or shown)[0]) == pytest.approx(
                    cubestar.get(key, value)
                ), key
                checked += 1
            if key.startswith("parameters."):
                parameter = icd.parameters[key.removeprefix("parameters.")]
                assert f"; {parameter.minimum:g} to {parameter.maximum:g} {parameter.unit}" in shown, key
    assert checked >= 40


def test_sensor_gives_the_highest_rates():
    text = (DOCS / "sensor.md").read_text(encoding="utf-8")
    pairs = re.findall(r"^\| (\d+) ms \| (\d+) Hz \|$", text, re.MULTILINE)
    assert len(pairs) == 4
    for exposure_ms, rate_hz in pairs:
        Parameters(load_unit(), {"exposure": int(exposure_ms), "update_rate": float(rate_hz)})
        with pytest.raises(EmulatorError, match="or less"):
            Parameters(load_unit(), {"exposure": int(exposure_ms) + 1, "update_rate": float(rate_hz)})


def test_the_report_of_cubestar_has_the_published_figures():
    folder = DOCS / "performance" / "cubestar"
    with (folder / "errors.csv").open(encoding="utf-8") as stream:
        errors = {row["error"].split()[0]: row for row in csv.DictReader(stream)}
    for line in ("total", "measured"):
        x, y, z = (float(errors[line][f"{axis}_arcsec"]) / 3600.0 for axis in "xyz")
        assert math.hypot(x, y) / math.sqrt(2.0) == pytest.approx(0.0154, rel=0.2), line
        assert z == pytest.approx(0.0215, rel=0.2), line
    with (folder / "availability.csv").open(encoding="utf-8") as stream:
        rest = next(csv.DictReader(stream))
    assert (rest["influence"], rest["frames"], rest["wrong"]) == ("rest", "10000", "0")
    assert int(rest["correct"]) >= 9800


def test_every_link_between_documents_leads_somewhere():
    for file in [*DOCS.glob("*.md"), DOCS.parent / "README.md"]:
        text = re.sub(r"^```.*?^```$", "", file.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
        for target in re.findall(r"\]\(([^)\s]+)\)", text):
            name, _, anchor = target.partition("#")
            if "://" in name:
                continue
            found = file.parent / name if name else file
            assert found.exists(), f"{file.name}: {target}"
            if anchor:
                headings = re.findall(r"^#+ (.*)$", found.read_text(encoding="utf-8"), re.MULTILINE)
                anchors = {
                    "".join(
                        letter for letter in heading.lower() if letter.isalnum() or letter in " -_"
                    ).replace(" ", "-")
                    for heading in headings
                }
                assert anchor in anchors, f"{file.name}: {target}"


def test_the_pages_can_be_read_in_a_day_and_on_a_narrow_screen():
    texts = {
        file.name: file.read_text(encoding="utf-8")
        for file in [*DOCS.glob("*.md"), DOCS.parent / "README.md"]
    }
    assert sum(len(text.split()) for text in texts.values()) <= 50_000
    rows = [
        (name, line) for name, text in texts.items() for line in text.splitlines() if line.startswith("|")
    ]
    assert [(name, line) for name, line in rows if len(line) > 300] == []


def columns_of_files_and_caches(title: str) -> list[str]:
    """Return the names in the first column of the tables of a section."""
    text = (DOCS / "files-and-caches.md").read_text(encoding="utf-8")
    (section,) = re.findall(rf"^## {title}\n(.*?)^## ", text, re.MULTILINE | re.DOTALL)
    cells = re.findall(r"^\|([^|]*)", section, re.MULTILINE)
    return [name for cell in cells for name in re.findall(r"`(\w+)`", cell)]


def case_counts(*words: str) -> dict[str, int]:
    """Return how many cases there are on each link, as the command lists and totals them; those without a rule do not count."""
    _, listed, totals = run_command_line("conformance", "--list", "--start", *words)
    areas = [line.split(".")[:2] for line in listed.splitlines()]
    counts = Counter(link for link, area in areas if area != "unjudged")
    assert totals.startswith(
        "judged cases: " + ", ".join(f"{number} {link}" for link, number in counts.items())
    )
    return counts


def test_the_numbers_of_conformance_cases_are_those_that_the_command_lists():
    own = case_counts("--canopen", "44")
    (row,) = [
        line
        for line in (DOCS.parent / "README.md").read_text("utf-8").splitlines()
        if "conformance cases |" in line
    ]
    assert row.split(" | ")[1] == f"{own['serial']} serial, {own['can']} CAN, {own['canopen']} CANopen"
    both = f"{own['can']} + {own['canopen']}"
    gen2 = case_counts("--unit", "cubestar-gen2")
    others = {unit: case_counts("--unit", unit)["serial"] for unit in ("sagitta", "nos3", "st16", "st200")}
    serial = ", ".join(
        f"{unit} {count}" for unit, count in [*others.items(), ("cubestar-gen2", gen2["serial"])][1:]
    )
    oresat = case_counts("--unit", "oresat", "--canopen", "44")["canopen"]
    assert [cells[2] for cells in table_after("bus.md", "Conformance on real buses")] == [
        f"{own['serial']} each", both, f"{others['sagitta']} ({serial})", str(gen2["can"]), str(oresat), both
    ]  # fmt: skip


def test_files_and_caches_has_every_column_of_a_truth_file():
    assert columns_of_files_and_caches("Truth file") == list(BOUNDS)


def test_files_and_caches_has_every_column_and_status_of_the_truth_log():
    names = columns_of_files_and_caches("Truth log")
    assert names == [*COLUMNS, *(status for status in names if status in set(TruthStatus))]
    assert set(TruthStatus) <= set(names)


def test_canopen_names_every_object_of_the_device():
    named: set[int] = set()
    for places, _ in table_after("canopen.md", "Where things are"):
        for place in places.split(", "):
            first, _, last = place.replace("h", "").partition("–")
            named |= set(range(int(first, 16), int(last or first, 16) + 1))
    assert named == {index for index in DeviceDictionary(load_unit()).od.indices if index >= 0x2000}


def test_canopen_shows_the_pdos_as_they_are():
    od = DeviceDictionary(load_unit()).od
    for title, identifier, content in table_after("canopen.md", "Attitude by PDO")[:4]:
        number = int(title.split()[0]) - 1
        mapping = od[0x1A00 + number]
        sizes = [(mapping[slot].default & 0xFF) // 8 for slot in range(1, mapping[0].default + 1)]
        shown = [int(size or 1) for size in re.findall(r"(?:^|, )[^,(]*(?:\((\d)\))?", content)]
        assert sizes == shown, title
        base = int(identifier.removesuffix("h + node"), 16)
        assert base == (od[0x1800 + number][1].default & 0x7FF & ~0x7F), title


def test_library(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, object] = {}
    for block, shown in programs("library.md"):
        printed = run(block, namespace)
        assert without_numbers(printed) == without_numbers(shown), block.heading
        assert numbers(printed) == pytest.approx(numbers(shown), rel=0.05, abs=0.35), block.heading


@pytest.fixture(scope="module")
def bus():
    with private_can_bus() as channel:
        yield channel


@pytest.fixture(scope="module")
def unit(bus, tmp_path_factory):
    """An emulator on every link that the walk-through uses: its ready line, by key."""
    command = emulator_command(
        profile="ideal",
        serial="auto",
        can=bus,
        seed=1,
        settings=["parameters.start_mode=lost_in_space", *NO_IMAGES],
        state_dir=tmp_path_factory.mktemp("state"),
        extra=["--canopen", "5"],
    )
    with EmulatorThread(command) as emulator:
        yield emulator.ready


def python_can(channel: str) -> dict[str, str | int]:
    """Keywords with which python-can opens a bus that the bench names."""
    match = re.fullmatch(r"socketcand:(.*):(\d+)/(.*)", channel)
    if match is None:
        return {"interface": "socketcan", "channel": channel.removeprefix("socketcan:")}
    return {"interface": "socketcand", "host": match[1], "port": int(match[2]), "channel": match[3]}


def here(text: str, ready: dict[str, str]) -> str:
    """Put the addresses of this run's emulator in place of those of the walk-through."""
    keywords = ", ".join(f"{key}={value!r}" for key, value in python_can(ready.get("can", "")).items())
    addresses = {
        'interface="socketcan", channel="vcan0"': keywords,
        "/tmp/startracker": ready["serial"],
    }
    for shown, actual in addresses.items():
        text = text.replace(shown, actual)
    return text


def program_under(heading: str) -> tuple[Block, str]:
    (found,) = [(block, shown) for block, shown in programs("walkthrough.md") if block.heading == heading]
    return found


def check_program(heading: str, ready: dict[str, str], folder: Path) -> None:
    """Run a program of the walk-through, and compare the words that it prints."""
    block, shown = program_under(heading)
    (folder / "starhil.eds").write_text(export(load_unit(), "eds"), encoding="ascii")
    with contextlib.chdir(folder):
        printed = run(replace(block, text=here(block.text, ready)), {})
    assert without_numbers(printed) == without_numbers(shown)


def test_walkthrough_decodes_the_attitude():
    block, shown = program_under("Mode and attitude")
    assert run(block, {}) == shown


@pytest.mark.process
@pytest.mark.parametrize(
    "heading",
    ["With the `canopen` library as master", "3. A serial line, byte by byte"],
)
def test_walkthrough_program(heading, unit, tmp_path):
    check_program(heading, unit, tmp_path)


@pytest.mark.parametrize("name", PAGES)
def test_frames_that_a_page_types_are_answered_as_shown(name, tmp_path):
    page = PAGES[name]
    node = [0x705] if "--canopen" in page.run else []
    with contextlib.ExitStack() as stack:
        hub = stack.enter_context(hub_thread())
        typed = shlex.split(page.run.replace("vcan0", hub))
        assert typed[:2] == ["starhil", "run"]
        stack.enter_context(
            EmulatorThread(emulator_command(state_dir=tmp_path, extra=[*typed[2:], *NO_IMAGES_OPTIONS]))
        )
        own = stack.enter_context(can.Bus(**python_can(hub)))
        for exchange in page.exchanges:
            sent = exchange.sent
            own.send(can.Message(arbitration_id=sent.id, data=sent.data, is_extended_id=sent.extended))
            for answer in exchange.answers:
                got = own.recv(PATIENCE_S)
                while got is not None and got.arbitration_id in {*UNASKED, *node} - {answer.id}:
                    got = own.recv(PATIENCE_S)
                assert got is not None, f"no answer to {exchange.typed}"
                frame = CanFrame(got.arbitration_id, bytes(got.data), extended=got.is_extended_id)
                assert_shown(frame, answer, exchange.typed)


def test_examples_in_docstrings_are_indented_below_their_colons():
    """Otherwise `make docs` fails: docutils expects a literal block there."""
    wrong = [
        f"{path.relative_to(DOCS.parent)}: {node.name if hasattr(node, 'name') else 'module'}"
        for package in ("emulator", "protocol", "hil_tests", "starid")
        for path in sorted((DOCS.parent / package).rglob("*.py"))
        if "::\n\n" in (text := path.read_text(encoding="utf-8"))
        for node in ast.walk(ast.parse(text))
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef))
        and re.search(r"::\n\n\S", ast.get_docstring(node) or "")
    ]
    assert wrong == []


@pytest.mark.process
@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd-analyze")
def test_systemd_takes_the_service_of_a_raspberry_pi(tmp_path):
    (text,) = [block.text for block in blocks("raspberry-pi.md", "ini") if "ExecStart=" in block.text]
    command = re.search(r"^ExecStart=/opt/starhil/bin/(starhil run .*)$", text, re.MULTILINE)[1]
    unit = tmp_path / "starhil.service"
    unit.write_text(text.replace("/opt/starhil/bin/", f"{Path(sys.executable).parent}/"))
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(unit)], capture_output=True, text=True, check=False
    )
    assert [line for line in done.stderr.splitlines() if "starhil.service" in line] == []
    assert done.returncode == 0
    words = shlex.split(
        command.replace("/var/lib/starhil", str(tmp_path)).replace("/dev/ttyAMA0", str(tmp_path / "tty"))
    )
    # all its options are taken; there is no such port
    status, _out, said = run_command_line(*words[1:], *NO_IMAGES_OPTIONS)
    assert (status, said.partition("tty: ")[2][:12]) == (2, "no such port")
