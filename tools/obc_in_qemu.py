"""Run the flight computer of tools/obc in QEMU against the emulator, and report what it saw.

python tools/obc_in_qemu.py [--link pty|tcp|theirs] [--clock real|scaled:FACTOR] [--icount SHIFT] [--out DIR]

The flight computer reaches the star tracker over the emulator's pseudo-terminal (`pty`), over TCP (`tcp`), or over a
pseudo-terminal that QEMU opens and the emulator connects to (`theirs`, as with Renode and Zephyr). Its attitudes are
compared with the truth log. With `--icount`, an instruction of the flight computer takes 2^SHIFT ns of its time, which
then does not keep pace with that of the star tracker; without, both run in real time. Exit status: 0 if it has read 25
valid attitudes and all agree with the truth.
"""

from __future__ import annotations

import argparse
import csv
import re
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from starhil.hil_tests.rig.emulator_process import EmulatorProcess, emulator_command
from starhil.protocol.export import export_folder
from starhil.protocol.unit import load_unit
from starid.attitude import Attitude

SOURCE = Path(__file__).parent / "obc"
COMPILER = "arm-none-eabi-gcc"
MACHINE = "qemu-system-arm"
FLAGS = (
    *("-mcpu=cortex-m3", "-mthumb", "-std=c99", "-Os", "-Wall", "-Wextra", "-Werror"),
    *("-ffunction-sections", "-Wl,--gc-sections", "--specs=nano.specs", "--specs=rdimon.specs"),
)
ENDS_WITHIN_S = 180.0
AGREES_ARCSEC = 5.0
"""Largest difference from the truth, arcseconds: errors of the ideal sensor, and digits of 1e-6 in the report."""


def build(folder: Path, *flags: str) -> Path:
    """Compile the flight computer with the exported codec; return the program."""
    for name, text in export_folder(load_unit(), "c").items():
        (folder / name).write_text(text, encoding="utf-8")
    program = folder / "obc.elf"
    sources = [SOURCE / "obc.c", *folder.glob("*.c")]
    subprocess.run(
        [COMPILER, *FLAGS, *flags, f"-I{folder}", "-T", SOURCE / "obc.ld", "-o", program, *sources],
        check=True,
    )
    return program


def start_machine(program: Path, tracker: str, options: Sequence[str] = ()) -> subprocess.Popen[str]:
    """Start QEMU with the star tracker on UART 0 and the reports of UART 1 on its standard output."""
    command = [
        *(MACHINE, "-machine", "mps2-an385", "-nographic", "-monitor", "none"),
        *("-semihosting-config", "enable=on,target=native", "-kernel", str(program)),
        *("-serial", tracker, "-serial", "stdio", *options),
    ]
    return subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


def emulator(serial: str, clock: str, folder: Path) -> EmulatorProcess:
    """Return the emulator of a star tracker that turns slowly."""
    settings = [
        "truth.kind=rate",
        "truth.rate_deg_s=[0.0,0.05,0.0]",
        f"run.clock={clock}",
        "parameters.update_rate=5",
    ]
    command = emulator_command(
        profile="ideal", serial=serial, can="off", truth_log=folder / "truth.csv", settings=settings
    )
    return EmulatorProcess(command)


def run(
    program: Path, link: str, clock: str, folder: Path, options: Sequence[str] = ()
) -> tuple[int, str, float]:
    """Run the flight computer; return its exit status, its report, and the wall time that it took, seconds."""
    if link == "theirs":
        machine = start_machine(program, "pty", options)
        line = machine.stdout.readline() if machine.stdout is not None else ""
        found = re.search(r"/dev/pts/\d+", line)
        if found is None:
            raise SystemExit(f"obc_in_qemu: {MACHINE} names no pseudo-terminal: {line}")
        with emulator(found[0], clock, folder):
            return end(machine)
    with emulator("listen://127.0.0.1:0" if link == "tcp" else "auto", clock, folder) as tracker:
        where = tracker.ready["serial"]
        address = f"tcp:{where.split('://')[1]}" if link == "tcp" else where
        return end(start_machine(program, address, options))


def end(machine: subprocess.Popen[str]) -> tuple[int, str, float]:
    """Wait for the end of the flight computer."""
    begin = time.monotonic()
    try:
        report, _ = machine.communicate(timeout=ENDS_WITHIN_S)
    except subprocess.TimeoutExpired:
        machine.kill()
        report, _ = machine.communicate()
    return machine.returncode, report, time.monotonic() - begin


def largest_error_arcsec(report: str, truth_log: Path) -> float:
    """Return the largest difference between a reported attitude and the truth at its exposure."""
    with truth_log.open(encoding="utf-8") as file:
        rows = {
            row["frame"]: [float(row[f"true_q{axis}"]) for axis in "xyzw"] for row in csv.DictReader(file)
        }
    readings = re.findall(r"^frame (\d+) q (-?\d+) (-?\d+) (-?\d+) (-?\d+)$", report, re.MULTILINE)
    return max(
        Attitude(np.array([float(digits) for digits in q]))
        .error_to(Attitude(np.array(rows[frame])))
        .total_arcsec
        for frame, *q in readings
    )


def main() -> int:
    """Build, run and report."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--link", choices=("pty", "tcp", "theirs"), default="pty")
    parser.add_argument("--clock", default="real")
    parser.add_argument("--icount", type=int, metavar="SHIFT")
    parser.add_argument("--out", type=Path, default=Path("out/obc"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    guest = () if options.icount is None else ("-icount", f"shift={options.icount},sleep=off")
    program = build(options.out, *(() if options.icount is None else ("-DBUSY",)))
    status, report, seconds = run(program, options.link, options.clock, options.out, guest)
    print(report, end="")
    if elapsed := re.search(r"elapsed_ms (\d+)", report):
        print(f"real-time factor of the flight computer: {int(elapsed[1]) / 1e3 / seconds:.2f}")
    if status:
        return status
    error = largest_error_arcsec(report, options.out / "truth.csv")
    print(f"largest difference from the truth: {error:.1f} arcseconds")
    return int(error > AGREES_ARCSEC)


if __name__ == "__main__":
    sys.exit(main())
