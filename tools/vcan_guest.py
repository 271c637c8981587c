#!/usr/bin/env python3
"""Run a command inside a User-Mode Linux guest that has a real SocketCAN interface, vcan0.

    tools/vcan_guest.py [--share FOLDER]... [--time-out SECONDS] [--memory SIZE] -- COMMAND [ARGUMENT...]

For machines whose kernel has no CAN. The guest sees the host's file system under the same paths, so the
virtual environment of this clone works unchanged. Files written by the guest are discarded, except below the
folders named by --share. The command gets the caller's environment, working folder and arguments, but no
standard input. Its output is passed on as it is written, and its exit status is returned.

Other exit statuses: 2 for a wrong call, 69 if a package is missing, 124 after a timeout, 125 if the guest did
not start or died (its console is printed then). Root is not needed. Requires the Debian packages of
`tools/install_test_packages vcan`. Uses only the standard library and leaves no files.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import termios
import threading
import tty
from pathlib import Path
from typing import Any, BinaryIO, Final

EXIT_UNAVAILABLE: Final = 69
EXIT_TIME_OUT: Final = 124
EXIT_GUEST_FAILED: Final = 125

SYSTEM_PATH: Final = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
MODULES: Final = (
    "net/can/can",
    "net/can/can-raw",
    "net/can/can-bcm",
    "net/can/can-gw",
    "drivers/net/can/dev/can-dev",
    "drivers/net/can/vcan",
    "drivers/net/can/vxcan",
    "drivers/net/can/slcan/slcan",
)
"""Kernel modules loaded in the guest, in order."""

OVERLAY_MODULE: Final = "fs/overlayfs/overlay"
JOB_FILE: Final = "job.json"
STATUS_FILE: Final = "status"
PROCESSOR_FILE: Final = "cpuinfo"
KILL_GRACE_S: Final = 5.0
POWER_OFF: Final = 0x4321FEDC
"""LINUX_REBOOT_CMD_POWER_OFF of reboot(2)."""


class GuestError(Exception):
    """The guest is not available or failed; carries the exit status to end with."""

    def __init__(self, text: str, status: int) -> None:
        super().__init__(text)
        self.status = status


# --- on the host ---


def run_in_guest(command: list[str], *, shares: list[Path], time_out_s: float, memory: str) -> int:
    """Run a command in a new guest and return its exit status.

    Raises
    ------
    GuestError
        A package is missing, the command timed out, or the guest did not boot.
    """
    listing = [str(Path(__file__).with_name("install_test_packages")), "--list", "vcan"]
    if missing := subprocess.run(listing, stdout=subprocess.PIPE, text=True, check=True).stdout.strip():
        raise GuestError(f"Debian packages missing: {missing}", EXIT_UNAVAILABLE)
    with tempfile.TemporaryDirectory(prefix="vcan-guest-") as name:
        folder = Path(name)
        job = {
            "command": command,
            "folder": str(Path.cwd()),
            "environment": dict(os.environ),
            "shares": [str(path.resolve()) for path in shares],
            "job_folder": str(folder),
        }
        (folder / JOB_FILE).write_text(json.dumps(job), encoding="utf-8")
        (folder / PROCESSOR_FILE).write_bytes(Path("/proc/cpuinfo").read_bytes())
        init = folder / "init"
        here = Path(__file__).resolve()
        words = shlex.join([sys.executable, "-I", str(here), "--inside-guest", str(folder / JOB_FILE)])
        init.write_text(f"#!/bin/sh\nexport PATH={SYSTEM_PATH}\nexec {words}\n", encoding="utf-8")
        init.chmod(0o755)
        console = folder / "console"
        with console.open("wb") as console_file:
            over = boot(init, folder, console_file, memory=memory, time_out_s=time_out_s)
        if over:
            raise GuestError(
                f"the guest was ended after {time_out_s:g} s: {shlex.join(command)}", EXIT_TIME_OUT
            )
        try:
            return int((folder / STATUS_FILE).read_text(encoding="ascii"))
        except (FileNotFoundError, ValueError):
            text = console.read_text(encoding="utf-8", errors="replace")
            raise GuestError(
                f"the guest did not run the command; its console:\n{text}", EXIT_GUEST_FAILED
            ) from None


def boot(init: Path, folder: Path, console: BinaryIO, *, memory: str, time_out_s: float) -> bool:
    """Boot the guest and wait for its end; return True if it had to be ended after the timeout."""
    with contextlib.ExitStack() as stack:
        # each guest console needs a separate descriptor, even if both streams are the same file
        streams = [os.dup(sys.stdout.fileno()), os.dup(sys.stderr.fileno())]
        for descriptor in streams:
            stack.callback(os.close, descriptor)
        kernel = [
            shutil.which("linux.uml", path=SYSTEM_PATH) or "linux.uml",
            f"mem={memory}",
            "rootfstype=hostfs",
            "rootflags=/",
            "ro",
            f"init={init}",
            "con=null",
            f"con0=null,fd:{console.fileno()}",
            f"con1=null,fd:{streams[0]}",
            f"con2=null,fd:{streams[1]}",
            f"uml_dir={folder}/",
            "quiet",
        ]
        process = subprocess.Popen(
            kernel,
            stdin=subprocess.DEVNULL,
            stdout=console,
            stderr=console,
            pass_fds=(console.fileno(), *streams),
            start_new_session=True,
        )
        stack.callback(end_group, process)
        try:
            process.wait(timeout=time_out_s)
        except subprocess.TimeoutExpired:
            return True
    return False


def end_group(process: subprocess.Popen[bytes]) -> None:
    """End the kernel of the guest and any remaining process of it."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(timeout=KILL_GRACE_S)


# --- in the guest ---


def guest_main(job_file: Path) -> None:
    """Run as the guest's first process: set up the machine, run the command, report its status, power off."""
    libc = ctypes.CDLL(None, use_errno=True)
    try:
        job = json.loads(job_file.read_text(encoding="utf-8"))
        report = prepare_root(libc, job)
        add_can()
        status = run_command(job)
        descriptor = os.open(report / STATUS_FILE, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        os.write(descriptor, str(status).encode("ascii"))
        os.fsync(descriptor)
        os.close(descriptor)
    except (OSError, subprocess.CalledProcessError, ValueError, KeyError) as error:
        print(f"vcan_guest: setting up the guest failed: {error}", file=sys.stderr, flush=True)
    finally:
        os.sync()
        libc.reboot(POWER_OFF)


def mount(
    libc: ctypes.CDLL, kind: str, target: str | Path, *, source: str = "none", data: str | None = None
) -> None:
    """Mount a file system; the error names the target."""
    options = None if data is None else os.fsencode(data)
    if libc.mount(os.fsencode(source), os.fsencode(str(target)), kind.encode("ascii"), 0, options) != 0:
        number = ctypes.get_errno()
        raise OSError(number, f"mount of {kind}: {os.strerror(number)}", str(target))


def insert_modules(names: tuple[str, ...]) -> None:
    """Load modules of the running guest kernel."""
    root = f"/usr/lib/uml/modules/{os.uname().release}/kernel"
    for name in names:
        subprocess.run(["insmod", f"{root}/{name}.ko"], check=True)


def prepare_root(libc: ctypes.CDLL, job: dict[str, Any]) -> Path:
    """Mount a writable in-memory layer over the host's root and enter it; return the folder for the status."""
    mount(libc, "proc", "/proc")
    insert_modules((OVERLAY_MODULE,))
    mount(libc, "tmpfs", "/mnt", data="mode=755,size=80%")
    for name in ("upper", "work", "root"):
        Path("/mnt", name).mkdir()
    root = Path("/mnt/root")
    mount(libc, "overlay", root, source="overlay", data="lowerdir=/,upperdir=/mnt/upper,workdir=/mnt/work")
    mount(libc, "proc", root / "proc")
    mount(libc, "sysfs", root / "sys")
    mount(libc, "devtmpfs", root / "dev")
    for name, kind in (("pts", "devpts"), ("shm", "tmpfs")):
        (root / "dev" / name).mkdir(exist_ok=True)
        mount(libc, kind, root / "dev" / name)
    mount(libc, "tmpfs", root / "run")
    report = root / "run" / "vcan-guest"
    report.mkdir()
    mount(libc, "hostfs", report, data=job["job_folder"])
    # the guest runs on the host's processor: machine code that the host has compiled is found by its description
    subprocess.run(["mount", "--bind", report / PROCESSOR_FILE, root / "proc" / "cpuinfo"], check=True)
    for share in job["shares"]:
        mount(libc, "hostfs", root / share.lstrip("/"), data=share)
    os.chroot(root)
    os.chdir(job["folder"])
    return Path("/run/vcan-guest")


def add_can() -> None:
    """Bring up the loopback interface and vcan0."""
    insert_modules(MODULES)
    for words in ("link set lo up", "link add dev vcan0 type vcan", "link set vcan0 up"):
        subprocess.run(["ip", *words.split()], check=True)


def run_command(job: dict[str, Any]) -> int:
    """Run the command with its output on two consoles of the guest; 127 or 126 if it cannot start."""
    consoles = [os.open(f"/dev/tty{number}", os.O_WRONLY | os.O_NOCTTY) for number in (1, 2)]
    for console in consoles:
        tty.setraw(console)
    try:
        process = subprocess.Popen(
            job["command"],
            env=job["environment"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
    except OSError as error:
        os.write(consoles[1], f"vcan_guest: {error}\n".encode())
        status = 127 if isinstance(error, FileNotFoundError) else 126
    else:
        pumps = [
            threading.Thread(target=pump, args=(source, sink), daemon=True)
            for source, sink in zip((process.stdout, process.stderr), consoles, strict=True)
        ]
        for thread in pumps:
            thread.start()
        status = process.wait()
        for thread in pumps:
            thread.join(timeout=KILL_GRACE_S)  # a remaining grandchild may hold the stream open
    for console in consoles:
        termios.tcdrain(console)
    return status if status >= 0 else 128 - status


def pump(source: BinaryIO, sink: int) -> None:
    """Copy a stream to its end as data arrive."""
    while piece := os.read(source.fileno(), 65536):
        view = memoryview(piece)
        while view:
            view = view[os.write(sink, view) :]


# --- command line ---


def main() -> int:
    """Parse the arguments, run the command in a guest, return the exit status."""
    if len(sys.argv) == 3 and sys.argv[1] == "--inside-guest":
        guest_main(Path(sys.argv[2]))
    parser = argparse.ArgumentParser(
        prog="vcan_guest.py", description="Run a command in a User-Mode Linux guest that has a real vcan0."
    )
    parser.add_argument("--share", action="append", default=[], type=Path, help="folder that stays writable")
    parser.add_argument("--time-out", type=float, default=300.0, metavar="SECONDS", help="default 300")
    parser.add_argument("--memory", default="3G", help="of the guest, default 3G")
    parser.add_argument("--check", action="store_true", help="only report whether a guest is available")
    parser.add_argument("command", nargs=argparse.REMAINDER, metavar="COMMAND")
    arguments = parser.parse_args()
    command = arguments.command[1:] if arguments.command[:1] == ["--"] else arguments.command
    if arguments.check:
        command = ["ip", "link", "show", "vcan0"]
    if not command:
        parser.error("missing command")
    for share in arguments.share:
        if not share.is_dir():
            parser.error(f"--share {share}: no such folder")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    try:
        return run_in_guest(
            command, shares=arguments.share, time_out_s=arguments.time_out, memory=arguments.memory
        )
    except GuestError as error:
        print(f"vcan_guest: {error}", file=sys.stderr)
        return error.status
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
