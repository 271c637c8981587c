"""Export of a Functional Mock-up Unit: the description of its variables, and `shell.c` as source and binary.

The table `VARIABLES` is the one definition: its rows become the elements of modelDescription.xml and the enumeration and
tables of `model.h`. An output is the value of a key of the last row of the truth log (`frames` on the control channel).
"""

from __future__ import annotations

import io
import shutil
import subprocess
import tempfile
import uuid
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Final, Literal
from xml.etree import ElementTree as ET

from starhil.emulator.errors import EmulatorError

MODEL: Final = "startracker"
SHELL: Final = "shell.c"
STEP_S: Final = 0.1
"""Step that the description suggests."""

BINARIES: Final = {"2": "binaries/linux64", "3": "binaries/x86_64-linux"}
REAL_TYPES: Final = {"2": "Real", "3": "Float64"}
INTEGER_TYPES: Final = {"2": "Integer", "3": "Int32"}
FLAGS: Final = ("-std=gnu11", "-O2", "-Wall", "-Wextra", "-fPIC", "-shared", "-fvisibility=hidden")

Causality = Literal["independent", "input", "output", "parameter"]


@dataclass(frozen=True)
class Variable:
    """A variable: its start value also says whether it is a real, a whole number, a truth value or a text.

    Attributes
    ----------
    key
        Key of an output in a row of the truth log; empty for the others.
    """

    name: str
    start: float | int | bool | str
    about: str
    causality: Causality
    unit: str = ""
    key: str = ""


def variables(profile: str, command: str) -> list[Variable]:
    """Return all variables, in the order of their value references."""
    return [
        Variable("time", 0.0, "Time of the simulation", "independent", "s"),
        *_vector("q", "1234", (0.0, 0.0, 0.0, 1.0), "Attitude quaternion of the body, see convention and order", "input"),
        *_vector("rate", "xyz", (0.0,) * 3, "Body rate in the body frame", "input", "deg/s"),
        *_vector("position", "xyz", (0.0,) * 3, "Position in GCRS; all zero: that of the profile", "input", "m"),
        *_vector("velocity", "xyz", (0.0,) * 3, "Velocity in GCRS", "input", "m/s"),
        Variable("unix_s", 0.0, "Date as Unix time; 0: that of the profile", "input", "s"),
        *_outputs("measured_q", "xyzw", "Measured quaternion ICRS to sensor; it rotates vectors"),
        *_outputs("measured_w", "xyz", "Measured body rate in the sensor frame", "_deg_s", "deg/s"),
        Variable("valid", start=False, about="Whether the last measurement has an attitude", causality="output", key="valid"),
        Variable("reason", "", "Why it has none", "output", key="reason"),
        Variable("mode", "", "Mode in which it was taken", "output", key="mode"),
        Variable("frame", 0, "Number of the measurement", "output", key="frame"),
        Variable("stars_detected", 0, "Stars in the image", "output", key="stars_detected"),
        Variable("stars_matched", 0, "Stars identified", "output", key="stars_matched"),
        Variable("exposure_unix_s", 0.0, "Middle of the exposure, by the device's clock", "output", "s", "time_of_exposure_s"),
        Variable("exposure_s", 0.0, "Middle of the exposure, by the time of the emulator", "output", "s", "run_time_s"),
        Variable("sigma_cross", 0.0, "Standard deviation about x and about y", "output", "arcsec", "sigma_cross_arcsec"),
        Variable("sigma_roll", 0.0, "Standard deviation about the boresight", "output", "arcsec", "sigma_roll_arcsec"),
        Variable("ready", "", "Ready line of the emulator, with its links", "output"),
        Variable("profile", profile, "Device profile: a name or the path of a TOML file", "parameter"),
        Variable("seed", 1, "Random seed", "parameter"),
        Variable("serial", "auto", "Serial link: auto, a device path, listen://HOST:PORT or off", "parameter"),
        Variable("symlink", "", "Symbolic link to the pty of serial = auto", "parameter"),
        Variable("can", "off", "CAN link: auto, a channel or off", "parameter"),
        Variable("convention", "rotation", "Of q: rotation (rotates vectors from ICRS to the body) or attitude", "parameter"),
        Variable("order", "xyzw", "Of q: xyzw or wxyz", "parameter"),
        Variable("check_rates", start=True, about="Whether the rates are connected; they then check the convention", causality="parameter"),
        Variable("command", command, "Program that starts the emulator", "parameter"),
        Variable("feed", "", "Live feed HOST:PORT of an emulator that runs already; empty: one is started", "parameter"),
        Variable("control", "", "Its control channel, unix:/PATH or HOST:PORT", "parameter"),
    ]  # fmt: skip


def export_fmu(path: Path, profile: str, command: str, fmi: Literal["2", "3"]) -> None:
    """Write the FMU with its binary and its source.

    Parameters
    ----------
    profile, command
        Start values of the parameters: the device profile, and the program that starts the emulator.

    Raises
    ------
    EmulatorError
        There is no C compiler, or it fails.
    """
    found = variables(profile, command)
    token = "{" + str(uuid.uuid5(uuid.NAMESPACE_URL, repr((version("starhil"), fmi, found)))) + "}"
    source = (Path(__file__).parent / SHELL).read_text(encoding="ascii")
    header = "\n".join(_header(found, token)) + "\n"
    files = {
        "modelDescription.xml": _description(found, token, fmi),
        f"sources/{SHELL}": source,
        "sources/model.h": header,
    }
    if fmi == "3":
        files["sources/buildDescription.xml"] = _xml(_build_description())
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in files.items():
            archive.writestr(name, text)
        archive.writestr(f"{BINARIES[fmi]}/{MODEL}.so", _compiled(source, header))
    path.write_bytes(content.getvalue())


def _compiled(source: str, header: str) -> bytes:
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        raise EmulatorError(
            "fmu export: needs a C compiler (cc, gcc or clang); as root on Debian: apt-get install gcc libc6-dev"
        )
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / SHELL).write_text(source, encoding="ascii")
        (Path(folder) / "model.h").write_text(header, encoding="utf-8")
        command = [compiler, *FLAGS, "-o", f"{MODEL}.so", SHELL]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)  # noqa: S603
        if done.returncode:
            raise EmulatorError(f"fmu export: {compiler} failed: {done.stderr.strip().partition(chr(10))[0]}")
        return (Path(folder) / f"{MODEL}.so").read_bytes()


def _vector(
    name: str, parts: str, starts: tuple[float, ...], about: str, causality: Causality, unit: str = ""
) -> Iterator[Variable]:
    for part, start in zip(parts, starts, strict=True):
        yield Variable(f"{name}_{part}", start, about, causality, unit)


def _outputs(prefix: str, parts: str, about: str, suffix: str = "", unit: str = "") -> Iterator[Variable]:
    for part in parts:
        key = f"{prefix}{part}{suffix}"
        yield Variable(key, 0.0, about, "output", unit, key)


def _description(found: list[Variable], token: str, fmi: Literal["2", "3"]) -> str:
    """Return modelDescription.xml."""
    root = ET.Element("fmiModelDescription", {
        "fmiVersion": f"{fmi}.0",
        "modelName": MODEL,
        "guid" if fmi == "2" else "instantiationToken": token,
        "description": "Star tracker of starhil, emulated in lock-step",
        "generationTool": f"starhil {version('starhil')}",
        "variableNamingConvention": "flat",
    })  # fmt: skip
    simulation = ET.SubElement(root, "CoSimulation", {
        "modelIdentifier": MODEL,
        "needsExecutionTool": "true",
        "canHandleVariableCommunicationStepSize": "true",
    })  # fmt: skip
    if fmi == "2":
        ET.SubElement(ET.SubElement(simulation, "SourceFiles"), "File", {"name": SHELL})
    units = ET.SubElement(root, "UnitDefinitions")
    for unit in sorted({each.unit for each in found if each.unit}):
        ET.SubElement(units, "Unit", {"name": unit})
    categories = ET.SubElement(root, "LogCategories")
    for name in ("logStatusWarning", "logStatusError"):
        ET.SubElement(categories, "Category", {"name": name})
    ET.SubElement(root, "DefaultExperiment", {"startTime": "0", "stopTime": "60", "stepSize": f"{STEP_S:g}"})
    listed = ET.SubElement(root, "ModelVariables")
    structure = ET.SubElement(root, "ModelStructure")
    outputs = ET.SubElement(structure, "Outputs") if fmi == "2" else structure
    for reference, each in enumerate(found):
        _add_variable(listed, reference, each, fmi)
        if each.causality == "output" and fmi == "2":
            ET.SubElement(outputs, "Unknown", {"index": str(reference + 1)})
        elif each.causality == "output":
            ET.SubElement(outputs, "Output", {"valueReference": str(reference)})
    return _xml(root)


def _add_variable(listed: ET.Element, reference: int, each: Variable, fmi: Literal["2", "3"]) -> None:
    attributes = {
        "name": each.name,
        "valueReference": str(reference),
        "causality": each.causality,
        "description": each.about,
    }
    kind = {bool: "Boolean", str: "String", int: INTEGER_TYPES[fmi]}.get(type(each.start), REAL_TYPES[fmi])
    attributes["variability"] = (
        "fixed"
        if each.causality == "parameter"
        else "continuous"
        if isinstance(each.start, float)
        else "discrete"
    )
    if each.causality == "output":
        attributes["initial"] = "exact"
    value = {"unit": each.unit} if each.unit else {}
    if each.causality != "independent" and (fmi == "2" or not isinstance(each.start, str)):
        value["start"] = str(each.start).lower() if isinstance(each.start, bool) else str(each.start)
    if fmi == "2":
        ET.SubElement(ET.SubElement(listed, "ScalarVariable", attributes), kind, value)
        return
    element = ET.SubElement(listed, kind, attributes | value)
    if isinstance(each.start, str):
        ET.SubElement(element, "Start", {"value": each.start})


def _build_description() -> ET.Element:
    root = ET.Element("fmiBuildDescription", {"fmiVersion": "3.0"})
    build = ET.SubElement(root, "BuildConfiguration", {"modelIdentifier": MODEL})
    files = ET.SubElement(
        build, "SourceFileSet", {"language": "C99", "compiler": "gcc", "compilerOptions": "-std=gnu11"}
    )
    ET.SubElement(files, "SourceFile", {"name": SHELL})
    return root


def _header(found: list[Variable], token: str) -> Iterator[str]:
    """Yield the lines of model.h: the enumeration of the variables, their start values and keys."""
    names = ", ".join(each.name.upper() for each in found)
    texts = ", ".join(_quoted(each.start if isinstance(each.start, str) else "") for each in found)
    numbers = ", ".join("0.0" if isinstance(each.start, str) else repr(float(each.start)) for each in found)
    keys = ", ".join(_quoted(each.key) if each.key else "0" for each in found)
    yield "/* Generated with modelDescription.xml. */"
    yield f"#define TOKEN {_quoted(token)}"
    yield f"enum {{ {names}, VARIABLES }};"
    yield f"static const double START_NUMBERS[] = {{ {numbers} }};"
    yield f"static const char *const START_TEXTS[] = {{ {texts} }};"
    yield f"static const char *const KEYS[] = {{ {keys} }};"


def _quoted(text: str) -> str:
    """Return a text as a C string; what is not plain ASCII as octal escapes."""
    plain = "".join(chr(b) if 32 <= b < 127 and chr(b) not in '"\\?' else f"\\{b:03o}" for b in text.encode())
    return f'"{plain}"'


def _xml(root: ET.Element) -> str:
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"
