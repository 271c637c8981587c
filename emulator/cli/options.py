"""Options and arguments that several commands of `starhil` share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, TypeAlias

import typer

from starid.cli.output import output_help

SerialPort: TypeAlias = Annotated[
    str | None,
    typer.Option("--serial", help="Serial port: /dev/…, socket://HOST:PORT, or auto with --start."),
]
CanChannel: TypeAlias = Annotated[
    str | None,
    typer.Option(
        "--can", help="CAN channel: vcan0, socketcand:127.0.0.1:29536/vcan0, …, or auto with --start."
    ),
]
SerialDialect: TypeAlias = Annotated[
    str | None,
    typer.Option("--dialect", help="Format of serial replies, if the unit has several: a, b (default) or c."),
]
HostAddress: TypeAlias = Annotated[int, typer.Option("--host-address", help="CAN address of the OBC.")]
DeviceAddress: TypeAlias = Annotated[int, typer.Option("--device-address", help="CAN address of the device.")]
CanopenNode: TypeAlias = Annotated[
    int | None,
    typer.Option(
        "--canopen", min=1, max=127, help="Also test the CANopen node with this ID on the CAN channel."
    ),
]
Unit: TypeAlias = Annotated[
    str,
    typer.Option(
        "--unit",
        help="Interface of the device: name of a bundled unit, or a folder of TOML files.",
    ),
]
UnitChoice: TypeAlias = Annotated[
    str | None,
    typer.Option(
        "--unit",
        help="Interface of the device: name of a bundled unit, or a folder of TOML files. Default: the profile's (cubestar).",
    ),
]
JunitFile: TypeAlias = Annotated[
    Path | None, typer.Option("--junit", help=output_help("Write a JUnit XML file."))
]

ConsoleAddress: TypeAlias = Annotated[
    str | None,
    typer.Option(
        "--view",
        metavar="[ADDRESS]",
        help="Show the results on a console as they arrive. ADDRESS is on the ready line of `starhil run --view`; "
        "default with --start: the started emulator's console.",
    ),
]

DIALECTS = ("a", "b", "c")
