#!/usr/bin/env python3
"""Run a command inside a Linux guest that has a real SocketCAN interface, vcan0.

    tools/vcan_guest.py [--machine uml|qemu] [--share FOLDER]... [--time-out SECONDS] [--memory SIZE] -- COMMAND [ARGUMENT...]

The guest is User-Mode Linux, which runs at the speed of the host but does not boot on processors with AMX; or QEMU
without KVM with Debian's kernel, which runs everywhere and some ten times slower. Without --machine, QEMU is taken where
User-Mode Linux is not installed or does not boot. Numba compiles too slowly under QEMU: warm its cache with
`NUMBA_CPU_NAME=generic` on the host first, and run the command with the same.

For machines whose kernel has no CAN. The guest sees the host's file system under the same paths, so the
virtual environment of this clone works unchanged. Files written by the guest are discarded, except below the
folders named by --share. The command gets the caller's environment, working folder and arguments, but no
standard input. Its output is passed on as it is written, and its exit status is returned.

Other exit statuses: 2 for a wrong call, 69 if a package is missing or the guest does not boot, 124 after a timeout,
125 if the guest died (its console is printed then). Root is not needed. Requires the Debian packages of
`tools/install_test_packages vcan uml` or `vcan qemu`. Uses only the standard library and leaves no files.
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
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, Final, TextIO

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
BOOT_MODULES: Final = ("virtio_pci", "9pnet_virtio", "9p")
"""Modules with which a guest in QEMU finds the host's file system."""

UML: Final = "uml"
QEMU: Final = "qemu"
CONSOLES: Final = {UML: ("/dev/tty1", "/dev/tty2"), QEMU: ("/dev/ttyS1", "/dev/ttyS2")}
"""Terminals of a guest for the output and the errors of the command."""

BOOT_S: Final = 180.0
"""Time in which a guest boots, even on a busy machine."""
JOB_FILE: Final = "job.json"
STATUS_FILE: Final = "status"
STARTED_FILE: Final = "started"
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


def run_in_guest(
    command: list[str], *, machine: str, shares: list[Path], time_out_s: float, memory: str
) -> int:
    """Run a command in a new guest and return its exit status.

    Raises
    ------
    GuestError
        A package is missing, the guest did not boot or died, or the command timed out.
    """
    listing = [str(Path(__file__).with_name("install_test_packages")), "--list", "vcan", machine]
    if missing := subprocess.run(listing, stdout=subprocess.PIPE, text=True, check=True).stdout.strip():
        raise GuestError(f"{machine}: Debian packages missing: {missing}", EXIT_UNAVAILABLE)
    with tempfile.TemporaryDirectory(prefix="vcan-guest-") as name:
        folder = Path(name)
        job = {
            "machine": machine,
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
        with console.open("wb") as console_file, contextlib.ExitStack() as stack:
            if machine == UML:
                # each guest console needs a separate descriptor, even if both streams are the same file
                streams = [os.dup(stream.fileno()) for stream in (sys.stdout, sys.stderr)]
                for descriptor in streams:
                    stack.callback(os.close, descriptor)
                kernel = uml_command(init, folder, memory, [console_file.fileno(), *streams])
            else:
                streams = [stack.enter_context(piped_to(stream)) for stream in (sys.stdout, sys.stderr)]
                kernel = qemu_command(init, folder, memory, streams, job["shares"])
            over = boot(kernel, folder, console_file, streams, time_out_s=time_out_s)
        started = (folder / STARTED_FILE).exists()
        if over and started:
            raise GuestError(
                f"the guest was ended after {time_out_s:g} s: {shlex.join(command)}", EXIT_TIME_OUT
            )
        try:
            return int((folder / STATUS_FILE).read_text(encoding="ascii"))
        except (FileNotFoundError, ValueError):
            text = console.read_text(encoding="utf-8", errors="replace")
            raise GuestError(
                f"{machine}: the guest did not run the command; its console:\n{text}",
                EXIT_GUEST_FAILED if started else EXIT_UNAVAILABLE,
            ) from None


def uml_command(init: Path, folder: Path, memory: str, streams: list[int]) -> list[str]:
    """Return the command of a User-Mode Linux guest with descriptors for its console, output and errors."""
    consoles = [f"con{number}=null,fd:{descriptor}" for number, descriptor in enumerate(streams)]
    return [
        shutil.which("linux.uml", path=SYSTEM_PATH) or "linux.uml",
        f"mem={memory}",
        "rootfstype=hostfs",
        "rootflags=/",
        "ro",
        f"init={init}",
        "con=null",
        *consoles,
        f"uml_dir={folder}/",
        "quiet",
    ]


def qemu_command(init: Path, folder: Path, memory: str, streams: list[int], shares: list[str]) -> list[str]:
    """Return the command of a guest in QEMU with descriptors for its output and errors.

    The processor is an old one, because wide vectors are slow to emulate. KVM is not used: it may be there and hang.
    """
    kernel = max(Path("/boot").glob("vmlinuz-*-amd64"), key=lambda path: path.stat().st_mtime)
    initrd = folder / "initrd"
    initrd.write_bytes(boot_archive(kernel.name.removeprefix("vmlinuz-"), init))
    command = [
        "qemu-system-x86_64", "-machine", "q35", "-accel", "tcg,thread=multi", "-cpu", "Nehalem", "-smp", "2",
        "-m", memory, "-nodefaults", "-no-user-config", "-no-reboot", "-display", "none",
        "-kernel", str(kernel), "-initrd", str(initrd), "-append", "console=ttyS0 quiet panic=-1 mitigations=off",
        "-serial", "stdio",
    ]  # fmt: skip
    for number, descriptor in enumerate(streams):
        command += ["-add-fd", f"fd={descriptor},set={number}"]
        command += ["-chardev", f"file,id=stream{number},path=/dev/fdset/{number},append=on"]
        command += ["-serial", f"chardev:stream{number}"]
    mounts = {"host": "/", "job": str(folder), **{f"share{n}": share for n, share in enumerate(shares)}}
    for tag, path in mounts.items():
        options = "security_model=none,multidevs=remap" + (",readonly=on" if tag == "host" else "")
        command += ["-fsdev", f"local,id={tag},path={path.replace(',', ',,')},{options}"]
        command += ["-device", f"virtio-9p-pci,fsdev={tag},mount_tag={tag}"]
    return command


def boot_archive(version: str, init: Path) -> bytes:
    """Return the first file system of a guest in QEMU, whose only work is to mount the host's and run `init` there."""
    busybox = Path(shutil.which("busybox", path=SYSTEM_PATH) or "/bin/busybox")
    modprobe = shutil.which("modprobe", path=SYSTEM_PATH) or "modprobe"
    listing = subprocess.run(
        [modprobe, "--set-version", version, "--show-depends", "--all", *BOOT_MODULES],
        stdout=subprocess.PIPE, text=True, check=True,
    ).stdout  # fmt: skip
    lines = [line.split() for line in listing.splitlines()]
    modules = dict.fromkeys(Path(words[1]) for words in lines if words[0] == "insmod")
    script = [
        "#!/busybox sh",
        *(f"/busybox insmod /{path.name}" for path in modules),
        f"/busybox mount -t 9p -o {_p9_options('cache=loose,ro')} host /host",
        f"exec /busybox chroot /host {init}",
        "",
    ]
    files = {path.name: path.read_bytes() for path in [*modules, busybox]}
    files["init"] = "\n".join(script).encode()
    entries = [cpio_entry("host", 0o040755, b""), cpio_entry("dev", 0o040755, b"")]
    entries += [cpio_entry(name, 0o100755, content) for name, content in files.items()]
    return b"".join([*entries, cpio_entry("TRAILER!!!", 0, b"")])


def cpio_entry(name: str, mode: int, content: bytes) -> bytes:
    """Return a file or folder in the format of an initial file system (cpio, "newc")."""
    fields = (0, mode, 0, 0, 1, 0, len(content), 0, 0, 0, 0, len(name) + 1, 0)
    head = b"070701" + b"".join(b"%08X" % field for field in fields) + name.encode() + b"\0"
    return b"".join(part + bytes(-len(part) % 4) for part in (head, content))


def _p9_options(others: str) -> str:
    return f"trans=virtio,version=9p2000.L,msize=512000,{others}"


@contextlib.contextmanager
def piped_to(stream: TextIO) -> Iterator[int]:
    """Yield a descriptor whose input is passed on to a stream, to its end."""
    source, sink = os.pipe()
    with os.fdopen(source, "rb") as reader:
        thread = threading.Thread(target=pump, args=(reader, stream.fileno()), daemon=True)
        thread.start()
        try:
            yield sink
        finally:
            os.close(sink)
            thread.join(timeout=KILL_GRACE_S)


def boot(
    kernel: list[str], folder: Path, console: BinaryIO, streams: list[int], *, time_out_s: float
) -> bool:
    """Boot a guest and wait for its end; return True if it had to be ended because it did not boot, or after the timeout."""
    process = subprocess.Popen(
        kernel,
        stdin=subprocess.DEVNULL,
        stdout=console,
        stderr=console,
        pass_fds=(console.fileno(), *streams),
        process_group=0,  # of this session, whose processes give way to each other by their niceness
    )
    try:
        for limit_s in (min(BOOT_S, time_out_s), max(time_out_s - BOOT_S, 0.0)):
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(timeout=limit_s)
                return False
            if not (folder / STARTED_FILE).exists():
                break
        return True
    finally:
        end_group(process)


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
        add_can(job["machine"])
        (report / STARTED_FILE).touch()
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


def insert_modules(machine: str, names: tuple[str, ...]) -> None:
    """Load modules of the running guest kernel."""
    if machine == QEMU:
        subprocess.run(["modprobe", "--all", *(Path(name).name for name in names)], check=True)
        return
    root = f"/usr/lib/uml/modules/{os.uname().release}/kernel"
    for name in names:
        subprocess.run(["insmod", f"{root}/{name}.ko"], check=True)


def mount_share(libc: ctypes.CDLL, job: dict[str, Any], tag: str, path: str, target: Path) -> None:
    """Mount a folder of the host that stays writable."""
    if job["machine"] == QEMU:
        mount(libc, "9p", target, source=tag, data=_p9_options("cache=none"))
    else:
        mount(libc, "hostfs", target, data=path)


def prepare_root(libc: ctypes.CDLL, job: dict[str, Any]) -> Path:
    """Mount a writable in-memory layer over the host's root and enter it; return the folder for the status."""
    mount(libc, "proc", "/proc")
    insert_modules(job["machine"], (OVERLAY_MODULE,))
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
    mount_share(libc, job, "job", job["job_folder"], report)
    # machine code that the host has compiled is found by the description of the host's processor
    subprocess.run(["mount", "--bind", report / PROCESSOR_FILE, root / "proc" / "cpuinfo"], check=True)
    for number, share in enumerate(job["shares"]):
        mount_share(libc, job, f"share{number}", share, root / share.lstrip("/"))
    os.chroot(root)
    os.chdir(job["folder"])
    return Path("/run/vcan-guest")


def add_can(machine: str) -> None:
    """Bring up the loopback interface and vcan0."""
    insert_modules(machine, MODULES)
    for words in ("link set lo up", "link add dev vcan0 type vcan", "link set vcan0 up"):
        subprocess.run(["ip", *words.split()], check=True)


def run_command(job: dict[str, Any]) -> int:
    """Run the command with its output on two consoles of the guest; 127 or 126 if it cannot start."""
    consoles = [os.open(name, os.O_WRONLY | os.O_NOCTTY) for name in CONSOLES[job["machine"]]]
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
        prog="vcan_guest.py", description="Run a command in a Linux guest that has a real vcan0."
    )
    parser.add_argument(
        "--machine", choices=(UML, QEMU), help="default: User-Mode Linux where it boots, else QEMU"
    )
    parser.add_argument("--share", action="append", default=[], type=Path, help="folder that stays writable")
    parser.add_argument("--time-out", type=float, default=300.0, metavar="SECONDS", help="default 300")
    parser.add_argument("--memory", default="3G", help="of the guest, default 3G")
    parser.add_argument("command", nargs=argparse.REMAINDER, metavar="COMMAND")
    arguments = parser.parse_args()
    command = arguments.command[1:] if arguments.command[:1] == ["--"] else arguments.command
    if not command:
        parser.error("missing command")
    for share in arguments.share:
        if not share.is_dir():
            parser.error(f"--share {share}: no such folder")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    problems = []
    for machine in (UML, QEMU) if arguments.machine is None else (arguments.machine,):
        try:
            return run_in_guest(
                command,
                machine=machine,
                shares=arguments.share,
                time_out_s=arguments.time_out,
                memory=arguments.memory,
            )
        except GuestError as error:
            problems.append(f"vcan_guest: {error}")
            status = error.status
            if status == EXIT_TIME_OUT:
                break
        except KeyboardInterrupt:
            return 130
    print("\n".join(problems), file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())
