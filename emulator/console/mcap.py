"""Recording of a run in an MCAP file; docs/console.md lists its topics.

Frames, modes, faults and the traffic of the links arrive as signals, telemetry by the recorder's own requests on the
bus. Everything is written in one thread, which also decodes the traffic.
"""

from __future__ import annotations

import asyncio
import base64
import dataclasses
import functools
import importlib.metadata
import io
import json
import logging
import math
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final

from mcap.writer import CompressionType, IndexType, Writer

from starhil.emulator.console.events import EventLog, RunEvent
from starhil.emulator.console.history import COLUMNS, MODES, UNITS, History, Numbers, json_row
from starhil.emulator.console.obc import POLL_S, ObcConnection, decode
from starhil.emulator.device.measurement import Measurement
from starhil.emulator.links.traffic import Decoder, WireItem
from starhil.emulator.run.head import Head
from starhil.emulator.simulation.guard import log_internal_error
from starhil.emulator.simulation.output_file import OutputFile
from starhil.protocol.canopen.device_dictionary import DeviceDictionary
from starhil.protocol.icd.codec import Row
from starhil.protocol.icd.conventions import NANOSECONDS

log = logging.getLogger("starhil.record")

MAX_PENDING: Final = 64
"""Write-queue limit; further messages are dropped."""

CHUNK_BYTES: Final = 1 << 18
"""Size of the chunks in which messages are compressed and written; the last one is lost if the run is killed."""

MCAP_TIMES_NS: Final = range(1 << 64)
"""Times that an MCAP file can hold: Unix time, nanoseconds."""

TRAFFIC_S: Final = 0.05
"""Wall time for which traffic is collected before it is written, seconds."""

_TIME: Final = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}
_TEXT: Final = {"type": "string"}
_NUMBER: Final = {"type": "number"}


def _numbers(*names: str) -> dict[str, Any]:
    return {"type": "object", "properties": dict.fromkeys(names, _NUMBER)}


SCHEMAS: Final[dict[str, dict[str, Any]]] = {
    "foxglove.CompressedImage": {
        "timestamp": _TIME,
        "frame_id": _TEXT,
        "data": {"type": "string", "contentEncoding": "base64"},
        "format": _TEXT,
    },
    "foxglove.FrameTransform": {
        "timestamp": _TIME,
        "parent_frame_id": _TEXT,
        "child_frame_id": _TEXT,
        "translation": _numbers("x", "y", "z"),
        "rotation": _numbers("x", "y", "z", "w"),
    },
    "foxglove.Log": {
        "timestamp": _TIME,
        "level": {"type": "integer"},
        "message": _TEXT,
        "name": _TEXT,
    },
    "starhil.Measurement": {
        name: _NUMBER | ({"unit": UNITS[name]} if name in UNITS else {}) for name in COLUMNS
    }
    | {"mode": _TEXT, "reason": _TEXT, "valid": {"type": "boolean"}},
    "starhil.Features": {},
    "starhil.Faults": {},
    "starhil.Traffic": {"out": {"type": "boolean"}, "raw": _TEXT, "kind": _TEXT, "text": _TEXT},
}
"""Schema → properties. The first three are defined, and displayed, by Foxglove. `out` is true for what the device sent."""


KEPT_SCHEMAS: Final = ("starhil.Measurement", "foxglove.Log", "starhil.Traffic")
"""Schemas of a recording of what the console keeps."""


def _telemetry_schema(row: Row) -> dict[str, Any]:
    """Return the properties of a telemetry row, with units and meanings."""
    return {
        name: {key: text for key, text in (("unit", field.unit), ("description", field.doc)) if text}
        for name, field in row.named_fields.items()
    }


LEVELS: Final = {"info": 2, "good": 2, "bad": 3}
"""Level of an event → level of foxglove.Log: information or warning."""


def _end_without_index() -> bytes:
    stream = io.BytesIO()
    writer = Writer(
        stream, index_types=IndexType.NONE, repeat_channels=False, repeat_schemas=False,
        use_statistics=False, use_summary_offsets=False,
    )  # fmt: skip
    writer.finish()  # type: ignore[no-untyped-call]
    return stream.getvalue()


_END_WITHOUT_INDEX: Final = _end_without_index()
"""What ends a file as long as its index is not written, so that it can be read however the run ends."""


class McapRecorder:
    """Records a run. Log times are simulation time since `run.start_unix_s`, whatever the device's clock shows."""

    def __init__(
        self, head: Head, client: ObcConnection, events: EventLog, path: Path, *, overwrite: bool = False
    ) -> None:
        self._head = head
        self._client = client
        self._events = events
        self._history = History(1)
        self._room = threading.Semaphore(MAX_PENDING)
        self._start_ns = round(head.profile.run.start_unix_s * NANOSECONDS)
        """Unix time of the start of the simulation, to which all log times refer."""
        self._stamp_missing = False
        self.dropped = 0
        """Writes that were dropped because the disk was too slow."""
        self._task: asyncio.Task[None] | None = None
        self._stream = _Records()
        stream: Any = self._stream
        self._writer = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile="", library="starhil")
        self.file = OutputFile(
            "recording", path, header=self._stream.take(), tail=_END_WITHOUT_INDEX, overwrite=overwrite
        )
        telemetry = {
            f"starhil.Telemetry.{row.name}": _telemetry_schema(row) for row in head.icd.telemetry.values()
        }
        self._schemas = _register(self._writer, SCHEMAS | telemetry)
        objects = DeviceDictionary(head.icd) if "canopen" in head.links else None
        self._decoder = Decoder(head.icd, head.serial_dialect, objects)
        self._traffic: list[tuple[int, WireItem]] = []
        """Traffic that is not queued yet, each item with its simulation time, nanoseconds."""
        self._on_disk(functools.partial(self._writer.add_metadata, "starhil.run", _metadata(head)))
        self._channels: dict[str, int] = {}
        self._disk = ThreadPoolExecutor(max_workers=1, thread_name_prefix="record")

    def start(self) -> None:
        head = self._head
        head.imager.watchers.add(self)
        head.device.signals.frame_published.connect(self._record_frame)
        self._events.added.connect(self._record_event)
        head.device.signals.faults_changed.connect(self._record_faults)
        head.traffic.passed.connect(self._record_traffic)
        self._task = asyncio.create_task(self._record_telemetry())

    async def close(self) -> None:
        """Write pending messages and the index, and close the file."""
        head = self._head
        head.imager.watchers.discard(self)
        head.device.signals.frame_published.disconnect(self._record_frame)
        self._events.added.disconnect(self._record_event)
        head.device.signals.faults_changed.disconnect(self._record_faults)
        head.traffic.passed.disconnect(self._record_traffic)
        self._write_traffic()
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
        await asyncio.to_thread(self._disk.shutdown, wait=True)
        self.file.append_last(lambda: self._records_of(self._writer.finish))
        self.file.close()
        if self.dropped:
            log.warning(
                "recording %s: %d messages dropped, as the disk was too slow", self.file.path, self.dropped
            )

    # --- sources ---

    def _record_frame(self, measurement: Measurement) -> None:
        at_ns, stamp = measurement.mid_ns, self._stamp(measurement.mid_unix_ns)
        preview = measurement.result.preview
        if preview is not None:
            data = base64.b64encode(preview.jpeg).decode()
            image = {**stamp, "frame_id": "sensor", "data": data, "format": "jpeg"}
            self._write("/image", "foxglove.CompressedImage", at_ns, image)
        quaternion = measurement.truth.attitude.quaternion_xyzw.tolist()
        truth = {
            **stamp,
            "parent_frame_id": "icrs",
            "child_frame_id": "sensor",
            "translation": {"x": 0.0, "y": 0.0, "z": 0.0},
            "rotation": dict(
                zip("xyzw", [-quaternion[0], -quaternion[1], -quaternion[2], quaternion[3]], strict=True)
            ),
        }
        self._write("/truth", "foxglove.FrameTransform", at_ns, truth)
        row = dict(zip(COLUMNS, json_row(self._history.add(measurement)), strict=True))
        known = {name: value for name, value in row.items() if value is not None}  # a schema has no null
        values = _named(known, measurement.reason)
        self._write("/measurement", "starhil.Measurement", at_ns, values)
        if measurement.result.features is not None:
            features = dataclasses.asdict(measurement.result.features)
            if math.isnan(features["error_psi"]):
                del features["error_psi"]
            self._write("/features", "starhil.Features", at_ns, features)

    def _record_faults(self, _request: dict[str, Any]) -> None:
        self._write("/faults", "starhil.Faults", self._head.clock.now_ns(), self._head.faults.describe())

    def _record_event(self, event: RunEvent) -> None:
        at_ns = round(event.t * NANOSECONDS)
        stamp = self._stamp(self._head.device.time.unix_ns(at_ns))
        self._write("/events", "foxglove.Log", at_ns, {**stamp, **_log_entry(event)})

    def _record_traffic(self, item: WireItem) -> None:
        if not self._traffic:
            asyncio.get_running_loop().call_later(TRAFFIC_S, self._write_traffic)
        self._traffic.append((self._head.clock.now_ns(), item))

    def _write_traffic(self) -> None:
        """Queue the traffic since the last call, which the disk thread decodes."""
        passed, self._traffic = self._traffic, []
        if passed:
            self._queue(functools.partial(self._add_traffic, passed))

    def _add_traffic(self, passed: list[tuple[int, WireItem]]) -> None:
        for run_ns, item in passed:
            line = self._decoder.line(item)
            if not line["own"]:
                content = {name: line[name] for name in SCHEMAS["starhil.Traffic"]}
                self._add_to_file(f"/bus/{item.bus}", "starhil.Traffic", self._start_ns + run_ns, content)

    async def _record_telemetry(self) -> None:
        """Read the telemetry rows in turn."""
        device = self._head.device
        rows = list(device.icd.telemetry.values())
        while True:
            for row in rows:
                try:
                    exchange = await self._client.exchange(row, b"")
                except Exception as error:  # noqa: BLE001 (the recording continues without this row)
                    log_internal_error(f"recording: {row.name}", error)
                else:
                    if values := decode(row, exchange):
                        self._write(
                            f"/telemetry/{row.name}",
                            f"starhil.Telemetry.{row.name}",
                            device.clock.now_ns(),
                            values,
                        )
                await asyncio.sleep(POLL_S / len(rows))

    # --- the file ---

    def _stamp(self, unix_ns: int) -> dict[str, Any]:
        """Return a device time as a Foxglove timestamp; nothing if it does not fit."""
        if unix_ns in MCAP_TIMES_NS:
            return {"timestamp": {"sec": unix_ns // NANOSECONDS, "nsec": unix_ns % NANOSECONDS}}
        if not self._stamp_missing:
            self._stamp_missing = True
            log.warning(
                "recording %s: the device's clock is set to before 1970 or after 2554; its times are left out",
                self.file.path,
            )
        return {}

    def _write(self, topic: str, schema: str, run_ns: int, content: dict[str, Any]) -> None:
        """Queue a message for the disk thread; its time is that of the run."""
        self._queue(functools.partial(self._add_to_file, topic, schema, self._start_ns + run_ns, content))

    def _queue(self, write: Callable[[], object]) -> None:
        """Pass a write to the disk thread, unless its queue is full."""
        if self.file.output.failed:
            return
        if not self._room.acquire(blocking=False):
            self.dropped += 1
            return
        self._disk.submit(self._on_disk, write).add_done_callback(self._written)

    def _written(self, _future: object) -> None:
        self._room.release()

    def _add_to_file(self, topic: str, schema: str, at_ns: int, content: dict[str, Any]) -> None:
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(
                topic=topic, message_encoding="json", schema_id=self._schemas[schema]
            )
        self._writer.add_message(
            channel_id=self._channels[topic],
            log_time=at_ns,
            publish_time=at_ns,
            data=json.dumps(content).encode(),
        )

    def _on_disk(self, action: Callable[[], object]) -> None:
        """Write to the file, unless writing has failed."""
        self.file.append(lambda: self._records_of(action))

    def _records_of(self, action: Callable[[], object]) -> bytes:
        action()
        return self._stream.take()


class _Records(io.BufferedIOBase):
    """Where a writer of MCAP writes: the records since the last `take`, at the position that they will have in the file."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._position = 0

    def write(self, data: Any) -> int:
        self._parts.append(bytes(data))
        self._position += len(data)
        return len(data)

    def tell(self) -> int:
        return self._position

    def take(self) -> bytes:
        """Return what was written since the last call."""
        parts, self._parts = self._parts, []
        return b"".join(parts)


def _register(writer: Writer, schemas: dict[str, dict[str, Any]]) -> dict[str, int]:
    """Register schemas; return their numbers by name."""
    return {
        name: writer.register_schema(
            name=name,
            encoding="jsonschema",
            data=json.dumps({"title": name, "type": "object", "properties": properties}).encode(),
        )
        for name, properties in schemas.items()
    }


def _metadata(head: Head) -> dict[str, str]:
    """Return what identifies the run."""
    profile = head.profile
    return {
        "starhil": importlib.metadata.version("starhil"),
        "head": str(head.number),
        "unit": profile.unit_source,
        "unit_version": head.icd.version,
        "profile": profile.source,
        "seed": str(profile.run.seed),
        "clock": profile.run.clock,
        "start_unix_s": repr(profile.run.start_unix_s),
        "settings": profile.model_dump_json(exclude_unset=True),
    }


def _named(numbers: dict[str, float], reason: str) -> dict[str, Any]:
    """Return the known numbers of a row with names for mode and reason."""
    return {
        **numbers,
        "mode": MODES[int(numbers["mode"])],
        "valid": numbers["valid"] == 1.0,
        "reason": reason,
    }


def _log_entry(event: RunEvent) -> dict[str, Any]:
    """Return an event as foxglove.Log without its timestamp."""
    return {"level": LEVELS[event.level], "message": event.text, "name": event.kind}


def recorded(
    head: Head, rows: Numbers, reasons: Sequence[str], events: Sequence[RunEvent], items: Sequence[WireItem]
) -> bytes:
    """Return a recording of what is kept: numbers of frames, events, traffic; without images and telemetry of the console.

    Traffic has the machine's times; its log time is found by the last event before it, whose both times are known.
    """
    stream = io.BytesIO()
    writer = Writer(stream, compression=CompressionType.ZSTD)
    writer.start(profile="", library="starhil")
    schemas = _register(writer, {name: SCHEMAS[name] for name in KEPT_SCHEMAS})
    writer.add_metadata("starhil.run", _metadata(head))
    start_ns = round(head.profile.run.start_unix_s * NANOSECONDS)
    channels: dict[str, int] = {}

    def add(topic: str, schema: str, run_s: float, content: dict[str, Any]) -> None:
        if topic not in channels:
            channels[topic] = writer.register_channel(
                topic=topic, message_encoding="json", schema_id=schemas[schema]
            )
        at_ns = max(0, start_ns + round(run_s * NANOSECONDS))
        data = json.dumps(content).encode()
        writer.add_message(channel_id=channels[topic], log_time=at_ns, publish_time=at_ns, data=data)

    for row in rows:
        fields = {
            name: value for name, value in zip(COLUMNS, json_row(row), strict=True) if value is not None
        }
        add(
            "/measurement",
            "starhil.Measurement",
            fields["run_s"],
            _named(fields, reasons[int(fields["reason"])]),
        )
    for event in events:
        add("/events", "foxglove.Log", event.t, _log_entry(event))
    objects = DeviceDictionary(head.icd) if "canopen" in head.links else None
    decoder = Decoder(head.icd, head.serial_dialect, objects)
    known_times = iter([*((event.wall_s, event.t) for event in events), (math.inf, 0.0)])
    (wall_s, run_s), following = next(known_times), next(known_times)
    for item in items:
        while following[0] <= item.at_s:
            (wall_s, run_s), following = following, next(known_times)
        line = decoder.line(item)
        if not line["own"]:
            content = {name: line[name] for name in SCHEMAS["starhil.Traffic"]}
            add(f"/bus/{item.bus}", "starhil.Traffic", run_s + max(0.0, item.at_s - wall_s), content)
    writer.finish()  # type: ignore[no-untyped-call]
    return stream.getvalue()
