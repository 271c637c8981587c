"""A minimal device for tests of the bench: canned telemetry, and switches for misbehaviour."""

from __future__ import annotations

import asyncio
import threading
from dataclasses import dataclass, field

from starhil.protocol.can.cubespace import CanDeviceReceiver, encode_reply_frames
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.errors import ProtocolError
from starhil.protocol.image_transfer import file_checksum
from starhil.protocol.messages import ErrorCode, LinkFault, Reply, ReplyKind, Request, RequestKind
from starhil.protocol.serial.cubespace import Dialect
from starhil.protocol.serial.stack import SerialStack
from starhil.protocol.transports.can import open_can
from starhil.protocol.transports.serial import open_serial
from starhil.protocol.unit import load_unit

ICD = load_unit()
EDGE = 64


def bmp_file() -> bytes:
    """A grey BMP file of 64 x 64 pixels with a ramp."""
    import cv2
    import numpy as np

    ramp = np.add.outer(np.arange(EDGE), np.arange(EDGE)).astype(np.uint8)
    return cv2.imencode(".bmp", ramp)[1].tobytes()


@dataclass
class FakeDevice:
    """Answers like the device; its telemetry is in `telemetry`, its telecommands in `received`."""

    dialect: Dialect = Dialect.B
    telemetry: dict[str, dict] = field(default_factory=dict)
    received: list[tuple[str, dict]] = field(default_factory=list)
    mute: int = 0
    """Requests that are not answered."""
    late_s: float = 0.0
    """Delay of the reply to a muted request."""
    refuse: dict[str, ErrorCode] = field(default_factory=dict)
    lost_packets: set[int] = field(default_factory=set)
    """Burst packets that get lost in the first burst."""
    pixels: bytes = bytes((row + column) % 256 for row in range(EDGE) for column in range(EDGE))
    bad_checksums: int = 0
    parameters: dict[int, float] = field(
        default_factory=lambda: {p.id: p.to_number(p.default) for p in ICD.parameters.values()}
    )
    frame: int = 0
    position: int = 0
    holes: dict[str, bytes] = field(default_factory=dict)
    block: bytes = b""

    def __post_init__(self):
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._stack = SerialStack(ICD)
        self._receiver = self._stack.device()
        self._can_receiver = CanDeviceReceiver(4)
        self._file = bmp_file()

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *error):
        self.close_links()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def open_serial(self) -> str:
        """Open a pty and return its path."""
        self._serial = open_serial("auto", paced=False)
        asyncio.run_coroutine_threadsafe(self._serial.start(self._on_bytes), self._loop).result()
        return self._serial.description

    def open_can(self, spec: str) -> str:
        """Join a bus and return its channel."""
        self._can = open_can(spec)
        asyncio.run_coroutine_threadsafe(self._can.start(self._on_frame), self._loop).result()
        return self._can.description

    def close_links(self) -> None:
        """Close port and bus."""
        asyncio.run_coroutine_threadsafe(self._close(), self._loop).result()

    async def _close(self):
        for name in ("_serial", "_can"):
            if hasattr(self, name):
                await getattr(self, name).close()

    def say(self, name: str, values: dict) -> None:
        """Send unsolicited telemetry on CAN."""
        row = ICD.telemetry[name]
        reply = Reply(ReplyKind.UNSOLICITED, row.id, row.encode(values), destination=1)
        self._loop.call_soon_threadsafe(self._send_can, reply)

    def _on_bytes(self, data: bytes) -> None:
        for event in self._receiver.feed(data, self._loop.time()):
            if not isinstance(event, LinkFault):
                self._answer(
                    event, lambda reply: self._serial.send(self._stack.encode_reply(reply, self.dialect))
                )

    def _on_frame(self, frame: CanFrame) -> None:
        for event in self._can_receiver.feed(frame, self._loop.time()):
            if not isinstance(event, LinkFault):
                self._answer(event, self._send_can)

    def _send_can(self, reply: Reply) -> None:
        for frame in encode_reply_frames(Reply(reply.kind, reply.id, reply.data, reply.code, 1), 4):
            self._can.send(frame)

    def _answer(self, request: Request, send) -> None:
        replies = self._replies(request)
        if self.mute:
            self.mute -= 1
            if self.late_s:
                self._loop.call_later(self.late_s, lambda: [send(reply) for reply in replies])
            return
        for reply in replies:
            send(reply)

    def _replies(self, request: Request) -> list[Reply]:
        row = ICD.row(request.id)
        if row is None:
            return [Reply(ReplyKind.NACK, request.id, code=ErrorCode.INVALID_ID)]
        if row.name in self.refuse:
            return [Reply(ReplyKind.NACK, request.id, code=self.refuse[row.name])]
        if request.kind is RequestKind.TELEMETRY:
            return [Reply(ReplyKind.TELEMETRY, row.id, row.encode(self._telemetry(row.name), check=False))]
        try:
            values = row.decode(request.data)
        except ProtocolError as error:
            return [Reply(ReplyKind.NACK, request.id, code=error.code)]
        self.received.append((row.name, values))
        return [Reply(ReplyKind.ACK, request.id), *self._perform(row.name, values)]

    def _telemetry(self, name: str) -> dict:
        if name == "parameter":
            identifier = int(self.telemetry.get("selected", {"id": 1})["id"])
            return {"parameter": identifier, "value": self.parameters[identifier], "maximum": 1.0}
        if name == "image_status":
            return {"percent": 100, "status": "ok"}
        if name == "image_frame":
            return {"data": self.pixels[self.frame * 128 : self.frame * 128 + 128]}
        if name == "image_frame_info":
            wrong = self.bad_checksums > 0
            self.bad_checksums -= wrong
            return {
                "frame": self.frame,
                "checksum": (sum(self.pixels[self.frame * 128 : self.frame * 128 + 128]) + wrong) % 256,
            }
        if name == "file_info":
            if self.position:
                return {}
            return {
                "type": 4,
                "counter": 1,
                "size": len(self._file),
                "time": 1,
                "crc": file_checksum(self._file),
            }
        if name == "file_block":
            return {
                "ready": bool(self.block),
                "checksum": file_checksum(self.block),
                "length": len(self.block),
            }
        return self.telemetry.get(name, {})

    def _perform(self, name: str, values: dict) -> list[Reply]:
        if name == "select_parameter":
            self.telemetry["selected"] = {"id": values["parameter"]}
        elif name == "set_parameter":
            self.parameters[values["parameter"]] = values["value"]
        elif name == "init_image_download":
            self.frame = 0
        elif name == "advance_image_download":
            self.frame = values["next_frame"]
        elif name == "load_file_block":
            self.block = self._file[values["offset"] : values["offset"] + values["length"]]
        elif name == "reset_file_list":
            self.position = 0
        elif name == "advance_file_list":
            self.position += 1
        elif name.startswith("set_hole_map"):
            self.holes[name] = values["map"]
        elif name == "start_burst":
            return self._burst(ignore_holes=values["ignore_hole_map"])
        return []

    def _burst(self, *, ignore_holes: bool) -> list[Reply]:
        whole = b"".join(self.holes.get(f"set_hole_map_{n}", bytes(16)) for n in range(1, 9))
        arrived = 0 if ignore_holes else int.from_bytes(whole, "little")
        replies = []
        for number in range(-(-len(self.block) // 20)):
            if arrived >> number & 1 or number in self.lost_packets:
                continue
            part = self.block[number * 20 : number * 20 + 20].ljust(20, b"\0")
            replies.append(Reply(ReplyKind.BURST, 119, number.to_bytes(2, "little") + part))
        self.lost_packets = set()
        return replies
