"""The targets of fuzzing: each decoder of the wire and each reader of files, as a function of bytes.

A target raises nothing but what is documented, as one line of text; anything else is a defect. `tools/fuzz` drives the targets
by coverage; `test_corpus.py` repeats the inputs that were worth keeping.
"""

from __future__ import annotations

import ast
import asyncio
import json
import logging
import struct
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np

from starhil.emulator.cli.endurance import read_life
from starhil.emulator.console.console import Console
from starhil.emulator.console.obc import Exchange
from starhil.emulator.console.runs import Runs
from starhil.emulator.console.server import ConsoleServer
from starhil.emulator.console.stepping import StepRunner
from starhil.emulator.console.viewer import Viewer
from starhil.emulator.control.channel import ControlServer
from starhil.emulator.control.scenario import load_scenario
from starhil.emulator.device.pending import PendingAnswer
from starhil.emulator.device.state_store import FileStore
from starhil.emulator.errors import EmulatorError
from starhil.emulator.profile import Profile, load_profile
from starhil.emulator.replay import EVENTS_FILE, RUN_FILE, read_events, read_run
from starhil.emulator.run import Run as EmulatorRun
from starhil.emulator.truth.ccsds_file import write_aem
from starhil.emulator.truth.feed_message import JsonFormat
from starhil.emulator.truth.feed_rates import FeedError
from starhil.emulator.truth.file import read_truth_file
from starhil.emulator.truth.simulator_42 import Format42
from starhil.emulator.truth.table import FileTruth
from starhil.hil_tests.emulator_process import parse_ready_line
from starhil.hil_tests.errors import BenchError, ScriptError
from starhil.hil_tests.images import decode_bmp
from starhil.hil_tests.raw_traffic import parse_frame as parse_cansend
from starhil.hil_tests.raw_traffic import pattern
from starhil.hil_tests.script import load_script
from starhil.hil_tests.truth_log import TruthLogReader
from starhil.protocol.can_framing import (
    CanDeviceReceiver,
    CanFrame,
    CanHostReceiver,
    encode_reply_frames,
    encode_request_frames,
)
from starhil.protocol.canopen.storage import FileStorage
from starhil.protocol.errors import ProtocolError
from starhil.protocol.export import FORMATS, export
from starhil.protocol.icd import load_unit
from starhil.protocol.image_transfer import parse_burst_packet
from starhil.protocol.messages import LinkFault, Reply, ReplyKind, Request
from starhil.protocol.serial_stack import build_serial_stack
from starhil.protocol.socketcand import CommandSplitter, format_frame, format_send, parse_frame, parse_send
from starhil.protocol.unit_folders import bundled_units
from starid.attitude import Attitude
from starid.camera_file import load_camera
from starid.errors import StaridError
from starid.hipparcos import read_hip2
from starid.imaging.image_io import read_image
from starid.result_store import read_results
from starid.thesis.database_file import MAGIC, load_database
from tests.emulator.conftest import Bench, FakePipeline
from tests.emulator.runs import FakeImager
from tests.fuzzing.edits import edited, toml
from tests.protocol.canopen.conftest import Bench as CanopenBench

CONFIGS = Path(__file__).parents[2] / "configs"
CORPUS = Path(__file__).parent / "corpus"
UNITS = tuple(bundled_units())
DOCUMENTED = (EmulatorError, ProtocolError, BenchError, StaridError)
"""The errors that a caller of the readers expects."""
NESTED = b"[" * 5000
"""Deeper than a recursive parser can follow."""
ATTITUDE = {"ra_deg": 1.0, "dec_deg": 2.0, "roll_deg": 3.0}

Run = Callable[[bytes], object]


@dataclass(frozen=True)
class Target:
    """A target: `make` returns the function of bytes, which may write files into the folder that `make` is given."""

    make: Callable[[Path], Run]
    seeds: Callable[[], list[bytes]]

    def runner(self, folder: Path) -> Run:
        """Return the function of bytes; a documented error is fine if it is one line for each of its problems."""
        run = self.make(folder)

        def guarded(data: bytes) -> None:
            try:
                run(data)
            except DOCUMENTED as error:
                lines = str(error).splitlines()
                if len(lines) != (len(error.args) if isinstance(error, ScriptError) else 1):
                    raise AssertionError(f"an error of {len(lines)} lines") from error

        return guarded


TARGETS: dict[str, Target] = {}


def target(
    name: str, seeds: Callable[[], list[bytes]]
) -> Callable[[Callable[[Path], Run]], Callable[[Path], Run]]:
    """Enter a target in the table."""

    def enter(make: Callable[[Path], Run]) -> Callable[[Path], Run]:
        TARGETS[name] = Target(make, seeds)
        return make

    return enter


def read_corpus(name: str) -> list[bytes]:
    """Return the inputs of a target that were kept: one a line, as Python writes bytes."""
    path = CORPUS / f"{name}.txt"
    return [ast.literal_eval(line) for line in path.read_text("ascii").splitlines()] if path.exists() else []


def chunks(data: bytes) -> Iterator[bytes]:
    """Split bytes as a line may do: the first byte is the size of the chunks."""
    size = data[0] % 32 + 1 if data else 1
    for start in range(1, len(data), size):
        yield data[start : start + size]


# --- serial lines and CAN, of each unit ---


def rows_of(unit: str) -> tuple[list[Request], list[Reply]]:
    """Return a good request and a good reply of each row."""
    icd = load_unit(unit)
    requests, replies = [], []
    for row in icd.rows:
        is_command = row.kind == "telecommand"
        requests.append(icd.request(row, row.encode(row.example()) if is_command else b""))
        kind = ReplyKind.ACK if is_command else ReplyKind.TELEMETRY
        data = b"" if is_command else row.encode()
        if len(data) < 200:
            replies.append(Reply(kind, row.id, data, klass=row.klass))
    return requests, replies


def examined(unit: str, events: Any) -> int:
    """Decode the data of each message as its row says; return how many messages there were."""
    rows, count = load_unit(unit).rows_by_key, 0
    for event in events:
        if isinstance(event, LinkFault):
            continue
        count += 1
        row = rows.get((event.klass, event.id or 0))
        if row is not None:
            try:
                row.decode(event.data)
            except ProtocolError:
                continue
    return count


def serial_seeds(unit: str, *, device: bool) -> list[bytes]:
    """Good messages, each as one chunk."""
    stack = build_serial_stack(load_unit(unit))
    requests, replies = rows_of(unit)
    messages = map(stack.encode_request, requests) if device else map(stack.encode_reply, replies)
    return [bytes([31]) + message for message in messages if message]


def serial_device(unit: str, _folder: Path) -> Run:
    """The device's end of a serial line; afterwards it reads a good request."""
    stack = build_serial_stack(load_unit(unit))
    good = rows_of(unit)[0][-1]

    def run(data: bytes) -> None:
        receiver, now = stack.device(), 0.0
        for chunk in chunks(data):
            now += 0.001
            examined(unit, receiver.feed(chunk, now))
        receiver.flush(now + 10.0)
        assert not receiver.busy
        assert examined(unit, receiver.feed(stack.encode_request(good), now + 20.0)) >= 1

    return run


def serial_host(unit: str, _folder: Path) -> Run:
    """The OBC's end of a serial line, which expects the reply to the row that the first byte selects."""
    icd = load_unit(unit)
    stack = build_serial_stack(icd)
    rows = list(icd.rows)

    def run(data: bytes) -> None:
        receiver, now = stack.host(), 0.0
        row = rows[(data[0] if data else 0) % len(rows)]
        receiver.expect(icd.request(row))
        for chunk in chunks(data):
            now += 0.001
            examined(unit, receiver.feed(chunk, now))
        receiver.flush(now + 10.0)
        assert not receiver.busy

    return run


for _unit in UNITS:
    if load_unit(_unit).link.serial is not None:
        TARGETS[f"serial-device-{_unit}"] = Target(
            partial(serial_device, _unit), partial(serial_seeds, _unit, device=True)
        )
        TARGETS[f"serial-host-{_unit}"] = Target(
            partial(serial_host, _unit), partial(serial_seeds, _unit, device=False)
        )


def frames_of(data: bytes, identifiers: list[int], *, extended: bool) -> Iterator[CanFrame]:
    """Read frames, ten bytes each: identifier by number, one bit of it flipped or flags, eight data bytes."""
    for start in range(0, len(data), 10):
        part = data[start : start + 10]
        identifier = identifiers[part[0] % len(identifiers)]
        flags = part[1] if len(part) > 1 else 0
        if flags >= 224:
            yield CanFrame(identifier, b"", extended=extended != (flags % 2 == 1), remote=flags % 4 > 1)
            continue
        if flags >= 192:
            identifier ^= 1 << flags % (29 if extended else 11)
        yield CanFrame(identifier, part[2 : 10 - (flags % 9 if 128 <= flags < 192 else 0)], extended=extended)


CUBESTAR_REQUESTS, CUBESTAR_REPLIES = rows_of("cubestar")
REQUEST_FRAMES = [frame for item in CUBESTAR_REQUESTS for frame in encode_request_frames(item, 1, 4)]
REPLY_FRAMES = [
    frame
    for item in CUBESTAR_REPLIES
    for kind in (item.kind, ReplyKind.UNSOLICITED)
    for frame in encode_reply_frames(Reply(kind, item.id, item.data, destination=1), 4)
]


def numbered(frames: list[CanFrame]) -> tuple[list[int], list[bytes]]:
    """Return the identifiers (at most 256), and frames as `frames_of` reads them."""
    identifiers = sorted({frame.id for frame in frames})[:256]
    known = [frame for frame in frames if frame.id in identifiers]
    return identifiers, [
        bytes([identifiers.index(frame.id), 128 + 8 - len(frame.data)]) + frame.data.ljust(8, b"\0")
        for frame in known
    ]


def in_runs(pieces: list[bytes]) -> list[bytes]:
    """Join five frames to a seed."""
    return [b"".join(pieces[start : start + 5]) for start in range(0, len(pieces), 5)]


@target("can-device", lambda: in_runs(numbered(REQUEST_FRAMES)[1]))
def _can_device(_folder: Path) -> Run:
    identifiers = numbered(REQUEST_FRAMES)[0]

    def run(data: bytes) -> None:
        receiver = CanDeviceReceiver(4, max_size=80)
        for number, frame in enumerate(frames_of(data, identifiers, extended=True)):
            for event in receiver.feed(frame, number * 0.001):
                assert isinstance(event, LinkFault) or len(event.data) <= 80
        receiver.flush(1e3)
        assert not receiver.busy

    return run


@target("can-host", lambda: in_runs(numbered(REPLY_FRAMES)[1]))
def _can_host(_folder: Path) -> Run:
    identifiers = numbered(REPLY_FRAMES)[0]

    def run(data: bytes) -> None:
        receiver = CanHostReceiver(1, 4, max_size=300)
        for number, frame in enumerate(frames_of(data, identifiers, extended=True)):
            examined("cubestar", receiver.feed(frame, number * 0.001))
        receiver.flush(1e3)
        assert not receiver.busy

    return run


# --- the device behind the links ---


def request_seeds(unit: str) -> list[bytes]:
    """Each row with good data."""
    return [
        bytes([number, len(item.data)]) + item.data
        for number, item in enumerate(rows_of(unit)[0])
        if max(number, len(item.data)) < 256
    ]


def requests_of(unit: str, _folder: Path) -> Run:
    """A device that is on, and is sent rows with any data while time passes."""
    icd = load_unit(unit)
    rows = list(icd.rows)

    def run(data: bytes) -> None:
        bench, at = Bench(unit=unit).start(), 0
        while at < len(data):
            row, size = rows[data[at] % len(rows)], data[at + 1] if at + 1 < len(data) else 0
            request = icd.request(row, data[at + 2 : at + 2 + size])
            answer = bench.requests.handle(request)
            if isinstance(answer, PendingAnswer):
                answer.when_done(bench.later.extend)
            else:
                bench.later.extend(answer)
            bench.step(0.01 * (size % 50))
            at += 2 + size
        assert all(isinstance(reply, Reply) for reply in bench.later)

    return run


for _unit in UNITS:
    if not load_unit(_unit).canopen_only:
        TARGETS[f"device-{_unit}"] = Target(partial(requests_of, _unit), partial(request_seeds, _unit))

NODE = 0x2C
CANOPEN_IDENTIFIERS = [
    0x600 + NODE, 0x7E5, 0x000, 0x080, 0x100, 0x080 + NODE, 0x180 + NODE, 0x200 + NODE, 0x300 + NODE, 0x400 + NODE,
    0x500 + NODE, 0x580 + NODE, 0x700 + NODE, 0x601, 0x705, 0x7E4,
]  # fmt: skip
CANOPEN_SEEDS = [
    "0080 4000100000000000", "0080 2310100173617665", "0080 2b17100064000000", "0080 a020600004000000 0080 a300000000000000",
    "0080 c020600014000000 0080 0141424344454647", "0080 2100200008000000 0080 0001020304050607", "0086 0100 0286 012c",
    "0180 0401000000000000 0180 5e00000000000000", "0180 5100000000000000 0180 4600000000000000", "0380 0", "0480 001122334455",
    "0780 0102030405060708", "0280 812c", "0c84 05", "0080 2314100180000000", "0080 2f00180005000000 0080 2300180100000080",
]  # fmt: skip


def canopen_slave(unit: str, folder: Path) -> Run:
    """A CANopen slave with stored parameters, sent any frames; it survives and answers with frames."""
    bench = CanopenBench(unit=unit, storage=FileStorage(folder / "parameters.json")).power_on()
    bench.show(bytes(300))

    def run(data: bytes) -> None:
        bench.now += 1e4
        for frame in frames_of(data, CANOPEN_IDENTIFIERS, extended=False):
            bench.now += 0.001
            answers = bench.slave.receive(frame, bench.now)
            deadline = bench.slave.next_deadline()
            if deadline is not None and deadline <= bench.now:
                answers = [*answers, *bench.slave.tick(bench.now)]
            assert len(answers) <= 200
            bench.slave.take_events()

    return run


for _unit in UNITS:
    if load_unit(_unit).canopen is not None:
        TARGETS[f"canopen-{_unit}"] = Target(
            partial(canopen_slave, _unit),
            lambda: [bytes.fromhex(text + "0" * (len(text.replace(" ", "")) % 2)) for text in CANOPEN_SEEDS],
        )


# --- lines of text on a bus ---


@target(
    "socketcand",
    lambda: [*map(format_send, REQUEST_FRAMES[:40]), *(format_frame(f, b"1.5") for f in REPLY_FRAMES[:40])],
)
def _socketcand(_folder: Path) -> Run:
    def run(data: bytes) -> None:
        splitter = CommandSplitter()
        for chunk in chunks(data):
            for command in splitter.feed(chunk):
                for parse in (parse_send, parse_frame):
                    try:
                        parse(command or b"")
                    except ProtocolError:
                        continue

    return run


@target(
    "cansend",
    lambda: [b"07360104#0001020304050601", b"123#R", b"1F 7F .. FF", b"123#00.."],
)
def _cansend(_folder: Path) -> Run:
    def run(data: bytes) -> None:
        for parse in (parse_cansend, pattern, parse_ready_line):
            try:
                parse(data.decode("latin-1"))
            except DOCUMENTED:
                continue

    return run


@target("burst", lambda: [bytes(22), b"\x00\x04" + bytes(20)])
def _burst(_folder: Path) -> Run:
    return parse_burst_packet


FEED = {
    "t": 12.25, "q": [0.0, 0.0, 0.0, 1.0], "rate": [0.0, 0.3, 0.0], "position_m": [7e6, 0.0, 0.0],
    "velocity_m_s": [0.0, 7e3, 0.0], "unix_s": 1.7e9,
}  # fmt: skip
BLOCK_42 = b"""TIME 2026-326-10:11:12.500000000
SC[0].qn = 0.0 0.0 0.0 1.0
SC[0].B[0].wn = 0.0 0.001 0.0
SC[0].PosR = 0.0 0.0 0.0
SC[0].VelR = 0.0 0.0 0.0
Orb[0].PosN = 7.0e6 0.0 0.0
Orb[0].VelN = 0.0 7.5e3 0.0
[ENDMSG]
"""


@target("feed", lambda: [json.dumps(FEED).encode(), NESTED, BLOCK_42])
def _feed(_folder: Path) -> Run:
    def run(data: bytes) -> None:
        for form in (JsonFormat(), JsonFormat("attitude", "wxyz"), Format42()):
            try:
                message = form.decode(data)
            except FeedError:
                continue
            assert np.isfinite(message.attitude.quaternion_xyzw).all()

    return run


# --- files ---


def of_file(name: str, read: Callable[[Path], object]) -> Callable[[Path], Run]:
    """Return a target that writes the bytes to a file and reads it."""

    def make(folder: Path) -> Run:
        path = folder / name

        def run(data: bytes) -> None:
            path.write_bytes(data)
            read(path)

        return run

    return make


def of_document(
    name: str,
    document: Callable[[], dict[str, Any]],
    dump: Callable[[Any], bytes],
    read: Callable[[Path], object],
) -> Target:
    """Return a target whose bytes edit a document; those that begin with a printable character are the file itself."""

    def make(folder: Path) -> Run:
        plain, good = of_file(name, read)(folder), document()

        def run(data: bytes) -> None:
            plain(data if data[:1] >= b" " else dump(edited(good, data[1:])))

        return run

    return Target(
        make, lambda: [b"\0", *(bytes([0, 0, n, k, 9 * n]) for n in range(9) for k in range(5)), NESTED]
    )


def toml_of(path: Path) -> Callable[[], dict[str, Any]]:
    """Return a reader of a file."""
    return lambda: tomllib.loads(path.read_text(encoding="utf-8"))


def exported(path: Path) -> None:
    """Read a unit, frame its rows and export it in every format."""
    icd = load_unit(path)
    if icd.link.serial is not None:
        stack = build_serial_stack(icd)
        for row in icd.rows:
            stack.encode_request(icd.request(row, bytes(row.size) if row.kind == "telecommand" else b""))
    for name in FORMATS:
        try:
            export(icd, name)
        except ProtocolError:
            continue


def units() -> Iterator[tuple[str, Path]]:
    """Yield files that define a unit on their own."""
    yield "st16", CONFIGS / "units" / "st16" / "st16.toml"
    yield "nos3", CONFIGS / "units" / "nos3" / "nos3.toml"
    yield "new", CONFIGS / "new_unit.toml"


def without_plugin(path: Path) -> Callable[[], dict[str, Any]]:
    """Return a reader of a definition that leaves out its plugin: that is code."""
    return lambda: {key: value for key, value in toml_of(path)().items() if key != "plugin"}


for _name, _path in units():
    TARGETS[f"definition-{_name}"] = of_document("unit.toml", without_plugin(_path), toml, exported)
TARGETS["profile"] = of_document(
    "profile.toml", toml_of(CONFIGS / "profiles" / "demo.toml"), toml, lambda path: load_profile(str(path))
)
TARGETS["session"] = of_document(
    "session.toml",
    toml_of(CONFIGS / "sessions" / "errors.toml"),
    toml,
    lambda path: load_script(path, load_unit()),
)
TARGETS["session-attitude"] = of_document(
    "session.toml",
    toml_of(CONFIGS / "sessions" / "slew_tracking.toml"),
    toml,
    lambda path: load_script(path, load_unit()),
)
TARGETS["scenario"] = of_document(
    "scenario.toml",
    toml_of(CONFIGS / "scenarios" / "bad_day.toml"),
    toml,
    lambda path: load_scenario(str(path)),
)
TARGETS["camera"] = of_document(
    "camera.toml",
    lambda: {"camera": {"width": 937, "height": 937, "fov_deg": 42.0, "distortion": [0.0] * 5}},
    toml,
    load_camera,
)


def as_json(document: Any) -> bytes:
    """Return a document as JSON."""
    return json.dumps(document).encode()


def run_document() -> dict[str, Any]:
    """Return the file of a recorded run."""
    return {"format": 1, "folder": ".", "profile": Profile().model_dump(mode="json"), "ends": True}


TAPE = [
    {"do": "in", "ns": 5, "link": "serial", "data": "1f7f801fff"},
    {"do": "out", "ns": 6, "link": "can", "data": [7, "0011", True, False]},
    {"do": "feed", "ns": 7, "data": "{}"},
    {"do": "truth", "ns": 8, "config": {"kind": "fixed", "attitude": ATTITUDE}, "start_s": 0.0},
    {"do": "fault", "ns": 9, "request": {"serial": {"drop": 0.5}}},
    {"do": "event", "ns": 9},
]

TARGETS["recording-run"] = of_document(RUN_FILE, run_document, as_json, lambda path: read_run(path.parent))
TARGETS["recording-tape"] = of_document(
    EVENTS_FILE,
    lambda: {str(number): line for number, line in enumerate(TAPE)},
    lambda document: b"".join(as_json(line) + b"\n" for line in document.values()),
    lambda path: list(read_events(path.parent)),
)
TARGETS["life"] = of_document(
    "life.json",
    lambda: {"links": ["serial"], "steps": [["send", 1, "00"]], "unit": "nos3", "seed": 1, "profile": {}},
    as_json,
    read_life,
)
TRUTH = "t,qx,qy,qz,qw,wx_deg_s,wy_deg_s,wz_deg_s\n0,0,0,0,1,0,0,1\n# text\n1.5,0,0,0.1,0.995,0,0,1\n"
LOG = "time_of_exposure_s,true_qx,true_qy,true_qz,true_qw\n0,0,0,0,1\n1,0,0,0.1,0.995\n"


def standard_truths() -> list[bytes]:
    """Return an AEM as KVN and XML, and an attitude file of STK."""
    file = FileTruth(np.array([0.0, 10.0]), [Attitude.identity()] * 2, np.zeros((2, 3)), start_unix_s=1.7e9)
    stk = (
        "stk.v.11.0\nBEGIN Attitude\nScenarioEpoch 1 Jan 2026 00:00:00.0\nCoordinateAxes ICRF\n"
        "AttitudeTimeQuatAngVels\n0 0 0 0 1 0 0 0.1\n1e1 0 0 0.00872654 0.99996192 0 0 0.1\nEND Attitude\n"
    )
    xml = (
        '<aem id="CCSDS_AEM_VERS" version="2.0"><body><segment><metadata><REF_FRAME_A>ICRF</REF_FRAME_A>'
        "<REF_FRAME_B>SC</REF_FRAME_B><TIME_SYSTEM>UTC</TIME_SYSTEM><ATTITUDE_TYPE>QUATERNION</ATTITUDE_TYPE></metadata><data>"
        "<attitudeState><quaternionEphemeris><EPOCH>2026-01-01T00:00:00</EPOCH><quaternion><Q1>0</Q1><Q2>0</Q2><Q3>0</Q3>"
        "<QC>1</QC></quaternion></quaternionEphemeris></attitudeState></data></segment></body></aem>"
    )
    return [write_aem(file, "INSTRUMENT_A").encode(), xml.encode(), stk.encode()]


def _truth(path: Path) -> None:
    truth = replace(read_truth_file(path), repeat=True)
    for t_s in (-1.0, 0.0, 0.7, 1e6):
        assert np.isfinite(truth.state(t_s).attitude.quaternion_xyzw).all()


target("truth-file", lambda: [TRUTH.encode(), b"t,ra_deg,dec_deg,roll_deg\n0,10,20,0\n100,10,20,50\n"])(
    of_file("truth.csv", _truth)
)
target("standard-truth-file", standard_truths)(of_file("truth", _truth))
target("truth-log", lambda: [LOG.encode()])(of_file("truth.csv", lambda path: TruthLogReader(path).at(0.5)))


def images() -> list[bytes]:
    """Return a small image in every format, grey of 8 and 16 bits and in colour."""
    grey = (np.arange(80, dtype=np.uint8) * 3).reshape(8, 10)
    deep, colour = grey.astype(np.uint16) * 257, np.dstack([grey] * 3)
    return [
        cv2.imencode(suffix, image)[1].tobytes()
        for suffix in (".png", ".tiff", ".bmp", ".jpg")
        for image in (grey, deep, colour)
        if image is not deep or suffix in (".png", ".tiff")
    ]


target("image", images)(of_file("image", lambda path: read_image(path, allow_colour=True)))
target("bmp", images)(lambda _folder: decode_bmp)
target("database", lambda: [MAGIC + struct.pack("<I", 5000) + NESTED, MAGIC + b"\2\0\0\0{}"])(
    of_file("database", load_database)
)
target("results", lambda: [b"PK\x03\x04", NESTED])(
    of_file("results.npz", lambda path: read_results(path, "campaign"))
)
target("catalogue", lambda: [b"     1 " + b" " * 160 + b"\n", b"\x1f\x8b\x08\0"])(
    of_file("hip2.dat", read_hip2)
)


@cache
def stored_state() -> dict[str, Any]:
    """Return what a device stores."""
    bench = Bench().start()
    bench.command("save_parameters")
    return json.loads(json.dumps(bench.store.load()))


def _stored(folder: Path) -> Run:
    """A device that finds any state, of an older version for instance, under a right checksum."""

    def run(data: bytes) -> None:
        store = FileStore(folder)
        try:
            if data[:1] >= b" ":
                store.path.write_bytes(data)
            else:
                content = edited({"state": stored_state()}, data[1:]).get("state")
                store.save(json.loads(json.dumps(content).replace("NaN", "0").replace("Infinity", "1")))
            Bench(store=store).start()
        finally:
            store.close()

    return run


target("state", TARGETS["life"].seeds)(_stored)


def _canopen_stored(path: Path) -> None:
    FileStorage(path).load("communication")


target("canopen-store", lambda: [b"{}", NESTED, b'{"crc32": 0, "groups": {}}'])(
    of_file("parameters.json", _canopen_stored)
)


# --- control channel and console ---


class _Loop:
    """A run whose pipeline renders nothing, and a loop to call it in."""

    def __init__(self) -> None:
        self.loop = asyncio.new_event_loop()
        pipeline = FakePipeline()
        keys = {"run": {"clock": "stepped"}, "links": {"serial": {"port": "off"}, "can": {"channel": "off"}}}
        with patch("starhil.emulator.run.make_imager", lambda *_, **__: FakeImager(pipeline.handle)):
            self.run = EmulatorRun([Profile.model_validate(keys)])
        self.call(self._start())
        self.control = ControlServer(self.run, lambda: None)

    async def _start(self) -> None:
        await self.run.open()
        self.run.begin()
        await self.run.ready()

    def call(self, awaitable: Any) -> Any:
        """Wait for a coroutine."""
        return self.loop.run_until_complete(asyncio.wait_for(awaitable, 20.0))


def opens_nothing(request: Any) -> bool:
    """Whether a request neither opens a port nor takes long: it sets no live truth and steps little."""
    if isinstance(request, dict):
        if isinstance(seconds := request.get("seconds"), (int, float)) and abs(seconds) > 60:
            return False
        return request.get("kind") not in ("live", "42") and all(map(opens_nothing, request.values()))
    return not isinstance(request, list) or all(map(opens_nothing, request))


REQUESTS = [
    {"do": "status"}, {"do": "truth", "run_time_s": 1.0}, {"do": "truth", "unix_s": 1.7e9}, {"do": "frames", "count": 3},
    {"do": "step", "seconds": 0.5}, {"do": "clear_faults"}, {"do": "quit"}, {"do": "scenario", "name": "bad_day"},
    {"do": "set_truth", "truth": {"kind": "fixed", "attitude": ATTITUDE}},
    {"do": "set_truth", "truth": {"kind": "rate", "attitude": ATTITUDE, "rate_deg_s": [0.0, 0.0, 2.0]}},
    {"do": "fault", "serial": {"drop": 0.2, "delay_s": 0.1}, "optical": {"false_stars": 40}, "device": {"stuck": True}},
]  # fmt: skip


def parsed(data: bytes, requests: list[dict[str, Any]]) -> Any:
    """Return an edited good request, or the bytes as JSON; None if they are not."""
    if data[:1] < b" ":
        request = requests[(data[0] if data else 0) % len(requests)]
        return edited({"r": request}, data[1:]).get("r")
    try:
        return json.loads(data)
    except (ValueError, RecursionError):
        return None


def request_edits(count: int) -> list[bytes]:
    """Good requests, and each with an edit."""
    return [
        bytes([number, *edit]) for number in range(count) for edit in (b"", b"\0\1\4\x10", b"\0\2\1\7")
    ] + [NESTED]


@target("control", lambda: request_edits(len(REQUESTS)))
def _control(_folder: Path) -> Run:
    run_ = _Loop()

    def run(data: bytes) -> None:
        request = parsed(data, REQUESTS)
        line = data if request is None else json.dumps(request)
        if opens_nothing(request):
            answer = run_.call(run_.control.answer(line))
            assert "internal error" not in answer.get("error", ""), answer
            json.dumps(answer)

    return run


class _Obc:
    """An OBC that is always answered with the row's own zeros."""

    async def start(self) -> None:
        """Nothing is opened."""

    async def close(self) -> None:
        """Nothing was opened."""

    async def exchange(self, row: Any, _data: bytes) -> Exchange:
        """Answer."""
        return Exchange("ok", latency_s=0.001, data=bytes(row.size if row.kind == "telemetry" else 0))


class _Socket:
    """A page that receives nothing."""

    async def send_str(self, data: str, /) -> None:
        """Take a message."""

    async def send_bytes(self, data: bytes, /) -> None:
        """Take a message."""


ASKED = [
    {"do": "subscribe", "rows": ["identification"], "frames": True, "wire": True},
    {"do": "control", "request": {"do": "fault", "can": {"drop": 0.5}}},
    {"do": "point", "to": {"ra_deg": 10.0, "dec_deg": 20.0}, "rate_deg_s": 1.0}, {"do": "point", "to": {"star": "Sirius"}},
    {"do": "clock", "speed": 2.0}, {"do": "clear_session"}, {"do": "read", "row": "identification"},
    {"do": "encode", "row": "set_mode", "values": {"mode": "standby"}}, {"do": "send", "row": "set_mode", "values": {"mode": "standby"}},
    {"do": "encode", "row": "set_parameter", "values": {"id": 1, "value": 1.5}},
]  # fmt: skip


def console_of(run_: _Loop) -> Console:
    """Return the console of a run."""
    return Console(run_.run, run_.run.heads[0], _Obc(), StepRunner(run_.control.execute), Runs())


@target("console", lambda: request_edits(len(ASKED)))
def _console(_folder: Path) -> Run:
    run_ = _Loop()
    console, viewer = console_of(run_), Viewer(_Socket())

    async def answer(request: Any) -> dict[str, Any]:
        reply = await console.answer(viewer, request)
        console.stepping.run(0.0)
        console.obc.session("fuzz")
        return reply

    def run(data: bytes) -> None:
        request = parsed(data, ASKED)
        if isinstance(request, dict) and opens_nothing(request):
            reply = run_.call(answer(request))
            assert "internal error" not in reply.get("error", ""), reply
            json.dumps(reply)

    return run


UPGRADE = (
    b"GET /ws?token=t HTTP/1.1\r\nHost: a\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n\x81\x83\0\0\0\0{}}"
)
REPORT = b'POST /runs?token=t HTTP/1.1\r\nHost: a\r\nOrigin: http://a\r\nContent-Length: 29\r\n\r\n{"run": "1", "event": "begin"}'
HTTP = [
    b"GET /?token=t HTTP/1.1\r\nHost: a\r\n\r\n", b"GET /session.toml?token=t&head=1 HTTP/1.1\r\nHost: a\r\n\r\n",
    b"GET /static/../x HTTP/1.1\r\nHost: a\r\n\r\n", b"GET /wire.log?token=t HTTP/1.0\r\n\r\n", UPGRADE, REPORT,
    b"POST /runs?token=t HTTP/1.1\r\nHost: a\r\nTransfer-Encoding: chunked\r\n\r\n2\r\n{}\r\n0\r\n\r\n",
]  # fmt: skip


class _Errors(logging.Handler):
    """Keeps what is logged as an error."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.seen: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a record."""
        self.seen.append(self.format(record))


@target("http", lambda: HTTP)
def _http(_folder: Path) -> Run:
    run_ = _Loop()
    server = ConsoleServer([console_of(run_)])
    server.token = "t"
    view = run_.call(server.start("127.0.0.1:0"))["view"]
    host, _, port = view.removeprefix("http://").partition("/")[0].partition(":")
    errors = _Errors()
    logging.getLogger().addHandler(errors)
    logging.getLogger("starhil").addHandler(errors)

    async def exchange(data: bytes) -> bytes:
        reader, writer = await asyncio.open_connection(host, int(port))
        try:
            writer.write(data)
            if writer.can_write_eof():
                writer.write_eof()
            async with asyncio.timeout(3.0):
                return await reader.read(65536)
        except (ConnectionError, TimeoutError):
            return b""
        finally:
            writer.transport.abort()

    def run(data: bytes) -> None:
        answer = run_.call(exchange(data))
        assert b" 500 " not in answer[:20], answer
        assert not errors.seen, "\n".join(errors.seen)

    return run
