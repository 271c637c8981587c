"""Targets that read files: definitions, configurations, recordings, truth, images, stored state."""

from __future__ import annotations

import json
import struct
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from starhil.emulator.cli.life_file import read_life
from starhil.emulator.control.scenario import load_scenario
from starhil.emulator.device.state_store import FileStore
from starhil.emulator.launch.recording import read_run
from starhil.emulator.launch.replay import read_events
from starhil.emulator.profile import Profile, load_profile
from starhil.emulator.run.recorder import EVENTS_FILE, RUN_FILE
from starhil.emulator.truth.ccsds_file import write_aem
from starhil.emulator.truth.file import read_truth_file
from starhil.emulator.truth.table import FileTruth, Span
from starhil.hil_tests.client.images import decode_bmp
from starhil.hil_tests.rig.truth_log import TruthLogReader
from starhil.hil_tests.session.script import load_script
from starhil.protocol.canopen.storage import FileStorage
from starhil.protocol.errors import ProtocolError
from starhil.protocol.export import FORMATS, export
from starhil.protocol.serial.stack import SerialStack
from starhil.protocol.unit import load_unit
from starid.attitude import Attitude
from starid.camera.file import load_camera
from starid.catalog.hipparcos import read_hip2
from starid.identification.thesis.database_file import MAGIC, load_database
from starid.imaging.image_io import read_image
from starid.storage.results import read_results
from tests.emulator.conftest import Bench
from tests.fuzzing.edits import edited, toml
from tests.fuzzing.target import ATTITUDE, NESTED, TARGETS, Run, Target, target

CONFIGS = Path(__file__).parents[2] / "configs"


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
        stack = SerialStack(icd)
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
CONFIGURATIONS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "profile": ("profiles/demo.toml", lambda path: load_profile(str(path))),
    "session": ("sessions/errors.toml", lambda path: load_script(path, load_unit())),
    "session-attitude": ("sessions/slew_tracking.toml", lambda path: load_script(path, load_unit())),
    "scenario": ("scenarios/bad_day.toml", lambda path: load_scenario(str(path))),
}
for _name, (_file, _read) in CONFIGURATIONS.items():
    TARGETS[_name] = of_document(Path(_file).name, toml_of(CONFIGS / _file), toml, _read)
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
    return {"format": 1, "folder": ".", "profile": Profile().model_dump(mode="json"), "machine": {}}


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
    lambda: {
        "links": ["serial"],
        "steps": [
            {"do": "request", "link": "serial", "row": ["", 1, "telemetry"], "data": "00"},
            {"do": "fault", "fault": {"serial": {"drop": 0.5}}},
        ],
        "unit": "nos3",
        "seed": 1,
        "profile": {},
    },
    as_json,
    read_life,
)
TRUTH = "t,qx,qy,qz,qw,wx_deg_s,wy_deg_s,wz_deg_s\n0,0,0,0,1,0,0,1\n# text\n1.5,0,0,0.1,0.995,0,0,1\n"
LOG = "time_of_exposure_s,true_qx,true_qy,true_qz,true_qw\n0,0,0,0,1\n1,0,0,0.1,0.995\n"


def standard_truths() -> list[bytes]:
    """Return an AEM of two segments as KVN, one as XML, and an attitude file of STK with a segment boundary."""
    spans = [Span(0, 1, 0.0, 9.0), Span(2, 3, 9.0, 20.0)]
    times = np.array([0.0, 10.0, 8.0, 20.0])
    file = FileTruth(times, [Attitude.identity()] * 4, np.zeros((4, 3)), spans=spans, start_unix_s=1.7e9)
    stk = (
        "stk.v.11.0\nBEGIN Attitude\nScenarioEpoch 1 Jan 2026 00:00:00.0\nCoordinateAxes ICRF\n"
        "BEGIN SegmentBoundaryTimes\n0.0\n5.0\nEND SegmentBoundaryTimes\nAttitudeTimeQuatAngVels\n"
        "0 0 0 0 1 0 0 0.1\n1e1 0 0 0.00872654 0.99996192 0 0 0.1\nEND Attitude\n"
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
