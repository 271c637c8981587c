"""Export of a Functional Mock-up Unit: the description of its variables, and `shell.c` as source and binary."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
import uuid
import zipfile
from importlib.metadata import version
from pathlib import Path
from typing import Final

from jinja2 import StrictUndefined, Template

from starhil.emulator.cli.fmu.variables import TEXT_SIZE, Fmi, Variable, variables
from starhil.emulator.errors import EmulatorError
from starhil.protocol.icd.quoting import c_string
from starid.storage.files import write_atomically

FOLDER: Final = Path(__file__).parent
MODEL: Final = "startracker"
BINARIES: Final[dict[Fmi, str]] = {"2": "binaries/linux64", "3": "binaries/x86_64-linux"}
FLAGS: Final = ("-std=gnu11", "-O2", "-Wall", "-Wextra", "-fPIC", "-shared", "-fvisibility=hidden")


def export_fmu(path: Path, profile: str, orbit: str, command: str, fmi: Fmi) -> None:
    """Write the FMU with its binary and its source.

    Parameters
    ----------
    profile, orbit, command
        Start values of the parameters: the device profile, its orbit, and the program that starts the emulator.

    Raises
    ------
    EmulatorError
        There is no C compiler, or it fails.
    """
    model_variables = variables(profile, orbit, command)
    token = "{" + str(uuid.uuid5(uuid.NAMESPACE_URL, repr((version("starhil"), fmi, model_variables)))) + "}"
    template = Template(
        _text("modelDescription.xml.j2"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    files = {
        "modelDescription.xml": template.render(
            fmi=fmi, model=MODEL, token=token, version=version("starhil"), variables=model_variables
        ),
        "sources/shell.c": _text("shell.c"),
        "sources/model.h": _header(model_variables, token),
    }
    if fmi == "3":
        files["sources/buildDescription.xml"] = _text("buildDescription.xml")

    def write(part: Path) -> None:
        with (
            tempfile.TemporaryDirectory() as folder,
            zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive,
        ):
            for name, text in files.items():
                archive.writestr(name, text)
            archive.extractall(folder)
            _compile(Path(folder, "sources"))
            archive.write(Path(folder, "sources", f"{MODEL}.so"), f"{BINARIES[fmi]}/{MODEL}.so")

    write_atomically(path, write)


def _compile(folder: Path) -> None:
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        raise EmulatorError(
            "fmu export: needs a C compiler (cc, gcc or clang); as root on Debian: apt-get install gcc libc6-dev"
        )
    command = [compiler, *FLAGS, "-o", f"{MODEL}.so", "shell.c"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)  # noqa: S603
    if done.returncode:
        raise EmulatorError(f"fmu export: {compiler} failed: {done.stderr.strip().partition(chr(10))[0]}")


def _header(model_variables: list[Variable], token: str) -> str:
    """Return model.h: all variables with their start values, and the numbers of those that the shell uses."""
    rows = [
        f"{{{c_string(each.name)}, {each.kind('3').upper()}, {each.causality.upper()}}}"
        for each in model_variables
    ]
    texts = [each for each in model_variables if isinstance(each.start, str)]
    numbers = model_variables[: -len(texts)]
    return "\n".join((
        "/* Generated with modelDescription.xml. */",
        f"#define TOKEN {c_string(token)}",
        f"enum {{ NUMBERS = {len(numbers)}, TEXTS = {len(texts)}, TEXT_SIZE = {TEXT_SIZE} }};",
        f"enum {{ TIME = 0, COMMAND = {[each.name for each in texts].index('command')} }};",
        f"#define VARIABLES_OF_MODEL {{ {', '.join(rows)} }}",
        f"#define START_NUMBERS {{ {', '.join(repr(float(each.start)) for each in numbers)} }}",
        f"#define START_TEXTS {{ {', '.join(c_string(str(each.start)) for each in texts)} }}",
        "",
    ))  # fmt: skip


def _text(name: str) -> str:
    return (FOLDER / name).read_text(encoding="utf-8")
