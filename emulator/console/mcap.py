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
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final

from mcap.writer import CompressionType, Writer

from starhil.emulator.console.history import COLUMNS, MODES, UNITS, History, json_row
from starhil.emulator.console.obc import POLL_S, ObcConnection, decode
from starhil.emulator.device.measurement import Measurement
from starhil.emulator.device.modes import Transition
from starhil.emulator.links.traffic import Decoder, WireItem
from starhil.emulator.run.head import Head
from starhil.emulator.simulation.guard import log_internal_error
from starhil.emulator.simulation.output_file import OutputFile
from starhil.protocol.icd.codec import Row
from starhil.protocol.icd.conventions import NANOSECONDS

log = logging.getLogger("starhil.record")

MAX_PENDING: Final = 64
"""Write-queue limit; further messages are dropped."""

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


def _telemetry_schema(row: Row) -> dict[str, Any]:
    """Return the properties of a telemetry row, with units and meanings."""
    return {
        name: {key: text for key, text in (("unit", field.unit), ("description", field.doc)) if text}
        for name, field in row.named_fields.items()
    }


INFO: Final = 2
"""Level of foxglove.Log."""


class McapRecorder:
    """Records a run. Log times are simulation time since `run.start_unix_s`, whatever the device's clock shows."""

    def __init__(self, head: Head, client: ObcConnection, path: Path, *, overwrite: bool = False) -> None:
        self._head = head
        self._client = client
        self._history = History(1)
        self._room = threading.Semaphore(MAX_PENDING)
        self._start_ns = round(head.profile.run.start_unix_s * NANOSECONDS)
        """Unix time of the start of the simulation, to which all log times refer."""
        self._stamp_missing = False
        self.dropped = 0
        """Writes that were dropped because the disk was too slow."""
        self._task: asyncio.Task[None] | None = None
        self.file = OutputFile("recording", path, overwrite=overwrite)
        self._stream = io.BufferedWriter(self.file.stream)
        self._writer = Writer(self._stream, compression=CompressionType.ZSTD)
        self._writer.start(profile="", library="starhil")
        telemetry = {
            f"starhil.Telemetry.{row.name}": _telemetry_schema(row) for row in head.icd.telemetry.values()
        }
        self._schemas = {
            name: self._writer.register_schema(
                name=name,
                encoding="jsonschema",
                data=json.dumps({"title": name, "type": "object", "properties": properties}).encode(),
            )
            for name, properties in (SCHEMAS | telemetry).items()
        }
        self._decoder = Decoder(head.icd, head.serial_dialect)
        self._traffic: list[tuple[int, WireItem]] = []
        """Traffic that is not queued yet, each item with its simulation time, nanoseconds."""
        self._on_disk(functools.partial(self._writer.add_metadata, "starhil.run", self._metadata()))
        self._channels: dict[str, int] = {}
        self._disk = ThreadPoolExecutor(max_workers=1, thread_name_prefix="record")

    def start(self) -> None:
        """Start recording."""
        head = self._head
        head.imager.watchers.add(self)
        head.device.signals.frame_published.connect(self._record_frame)
        head.device.signals.mode_changed.connect(self._record_mode)
        head.device.signals.faults_changed.connect(self._record_faults)
        head.traffic.passed.connect(self._record_traffic)
        self._task = asyncio.create_task(self._record_telemetry())

    async def close(self) -> None:
        """Write pending messages and the index, and close the file."""
        self._head.imager.watchers.discard(self)
        self._head.traffic.passed.disconnect(self._record_traffic)
        self._write_traffic()
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
        await asyncio.to_thread(self._disk.shutdown, wait=True)
        self._on_disk(self._writer.finish)
        self._on_disk(self._stream.flush)
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
        values: dict[str, Any] = {**known, "valid": measurement.valid, "reason": measurement.reason}
        values["mode"] = MODES[int(row["mode"] or 0)]
        self._write("/measurement", "starhil.Measurement", at_ns, values)
        if measurement.result.features is not None:
            features = dataclasses.asdict(measurement.result.features)
            if math.isnan(features["error_psi"]):
                del features["error_psi"]
            self._write("/features", "starhil.Features", at_ns, features)

    def _metadata(self) -> dict[str, str]:
        """Return what identifies the run."""
        head, profile = self._head, self._head.profile
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

    def _record_mode(self, transition: Transition) -> None:
        self._record_event(
            f"mode {transition.before.value} → {transition.after.value} ({transition.cause.value})"
        )

    def _record_faults(self, request: dict[str, Any]) -> None:
        self._record_event(f"fault {json.dumps(request)}" if request else "faults ended")
        self._write("/faults", "starhil.Faults", self._head.clock.now_ns(), self._head.faults.describe())

    def _record_event(self, text: str) -> None:
        device = self._head.device
        content = {**self._stamp(device.time.unix_ns()), "level": INFO, "message": text, "name": "device"}
        self._write("/events", "foxglove.Log", device.clock.now_ns(), content)

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
        if not self.file.output.failed:
            with self.file.output.guarded():
                action()
