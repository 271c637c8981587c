"""The process behind an FMU: it starts an emulator or connects to one, and steps it.

The FMU's shell (`emulator/cli/fmu/shell.c`) is the other end of standard input, a socket that keeps packets apart. Each packet holds the
values of all variables; the first begins a simulation, each later one is a step to its time. Each is answered by one with the
outputs, a message for the host's log and its FMI status. The process ends after an error, and when the shell closes its end.
"""

from __future__ import annotations

import socket
import struct
from contextlib import ExitStack
from typing import Any, Final

from starhil.emulator.cli.fmu.variables import TEXT_SIZE, variables
from starhil.hil_tests.errors import BenchError
from starhil.hil_tests.rig.control import ControlClient
from starhil.hil_tests.rig.emulator_process import EmulatorProcess, emulator_command

VARIABLES: Final = variables()
TEXTS: Final = [each.name for each in VARIABLES if isinstance(each.start, str)]
PACKET: Final = struct.Struct(f"@{len(VARIABLES) - len(TEXTS)}d" + f"{TEXT_SIZE}s" * (len(TEXTS) + 1) + "i0d")
"""The `struct values` of the shell."""

OK, WARNING, ERROR = 0, 1, 3

LOCK_STEP: Final = ("truth.kind=live", "truth.protocol=tcp", "truth.port=0", "truth.lockstep=true")

Values = dict[str, Any]


class Simulation:
    """An emulator in lock-step with the importer of the FMU.

    Raises BenchError: the emulator does not start, or there is none.
    """

    def __init__(self, values: Values, stack: ExitStack) -> None:
        self._emulator: EmulatorProcess | None = None
        self._reported = 0
        self._offset_s: float | None = None
        """Time of the importer minus that of the emulator, seconds."""
        feed, control = values["feed"], values["control"]
        if not feed:
            try:
                self._emulator = stack.enter_context(EmulatorProcess(_command(values)))
            except BenchError as error:
                raise BenchError(f"{values['command']} does not start: {error}") from None
            ready = self._emulator.ready
            values["ready"] = " ".join(["ready", *(f"{name}={value}" for name, value in ready.items())])
            feed, control = ready["truth"], ready["control"]
        try:
            self._feed = stack.enter_context(ControlClient(feed.removeprefix("tcp:")))
            self._control = stack.enter_context(ControlClient(control))
        except BenchError as error:
            raise BenchError(f"no emulator at {feed} and {control}: {error}") from None

    def step(self, values: Values) -> None:
        """Advance the emulator to the time of the inputs, and take the outputs of the last measurement.

        What a measurement does not have, such as the attitude of an invalid one, stays.
        Raises BenchError: the emulator rejects the inputs, or has ended.
        """

        def vector(names: str) -> list[float]:
            return [values[name] for name in names.split()]

        message = {"t": round(values["time"], 9), "q": vector("q_1 q_2 q_3 q_4")}
        if values["check_rates"]:
            message["rate"] = vector("rate_x rate_y rate_z")
        if any(position := vector("position_x position_y position_z")):
            message |= {
                "position_m": position,
                "velocity_m_s": vector("velocity_x velocity_y velocity_z"),
            }
        if values["unix_s"]:
            message["unix_s"] = round(values["unix_s"], 9)
        answer = self._feed.exchange(f"inputs at {values['time']:g} s", message)
        if self._offset_s is None:
            self._offset_s = message["t"] - answer["run_time_s"]
        for row in self._control.do("frames")["frames"]:
            outputs = {
                each.name: row.get(each.key or each.name) for each in VARIABLES if each.causality == "output"
            }
            outputs["exposure_s"] = row["run_time_s"] + self._offset_s
            values |= {name: value for name, value in outputs.items() if value is not None}

    def warnings(self) -> str:
        """Return what the emulator has reported since the last call."""
        lines = [] if self._emulator is None else self._emulator.errors[self._reported :]
        self._reported += len(lines)
        return "\n".join(f"emulator: {line}" for line in lines)


def serve() -> None:
    """Answer the packets on standard input until an error or their end."""
    with socket.socket(fileno=0) as shell, ExitStack() as stack:
        simulation: Simulation | None = None
        while packet := shell.recv(PACKET.size + 1):
            if len(packet) != PACKET.size:
                raise BenchError("fmu serve: the FMU is of another version of starhil; export it again")
            values = _unpacked(packet)
            try:
                if simulation is None:
                    simulation = Simulation(values, stack)
                else:
                    simulation.step(values)
            except BenchError as error:
                shell.send(_packed(values, _closed(stack, str(error)), ERROR))
                return
            message = simulation.warnings()
            shell.send(_packed(values, message, WARNING if message else OK))


def _closed(stack: ExitStack, error: str) -> str:
    """End the emulator after an error; return the error, and how it has ended if that was unexpected."""
    try:
        stack.close()
    except BenchError as ended:
        return f"{error}; {ended}"
    return error


def _command(values: Values) -> list[str]:
    settings = [*LOCK_STEP, *(f"truth.{key}={values[key]}" for key in ("convention", "order"))]
    if values["orbit"]:
        settings.insert(0, f"orbit={values['orbit']}")
    if values["symlink"]:
        settings.append(f"links.serial.symlink={values['symlink']}")
    return emulator_command(
        profile=values["profile"],
        serial=values["serial"],
        can=values["can"],
        seed=int(values["seed"]),
        settings=settings,
        extra=("--clock", "stepped", "--control", "auto"),
    )


def _unpacked(packet: bytes) -> Values:
    cells = [
        cell if isinstance(cell, float) else cell.partition(b"\0")[0].decode(errors="replace")
        for cell in PACKET.unpack(packet)[:-2]
    ]
    return dict(zip([each.name for each in VARIABLES], cells, strict=True))


def _packed(values: Values, message: str, status: int) -> bytes:
    cells = [
        _shortened(cell) if isinstance(cell, str) else float(cell) for cell in (*values.values(), message)
    ]
    return PACKET.pack(*cells, status)


def _shortened(text: str) -> bytes:
    """Return the whole characters of a text that fit, in UTF-8."""
    return text.encode(errors="replace")[: TEXT_SIZE - 1].decode(errors="ignore").encode()
