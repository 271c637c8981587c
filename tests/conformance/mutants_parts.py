"""Mutants in the parts of the device: telemetry, images, parameters, unsolicited telemetry."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from starhil.emulator.device.device import Device
from starhil.emulator.device.snapshot import Snapshot
from starhil.protocol.messages import ErrorCode, Reply, ReplyKind
from tests.conformance.mutant_seams import (
    Damage,
    enter,
    handling,
    mutant,
    only_acknowledged,
)
from tests.conformance.simulated import SimulatedUnit


@mutant("boots are not counted", "both", "reset.acknowledged")
def boots_not_counted(unit: SimulatedUnit) -> None:
    unit.device.signals.started.connect(lambda _cause: setattr(unit.device, "boot_count", 1))


@mutant("attitudes stay valid in standby", "both", "modes.standby")
def stale_attitude(unit: SimulatedUnit) -> None:
    original = unit.requests.telemetry

    def changed(name: str, snapshot: Snapshot) -> bytes:
        data = bytearray(original(name, snapshot))
        if name == "precise_attitude":
            field = unit.device.icd.telemetry[name].named_fields["valid"]
            data[field.offset] |= 1 << field.shift
        return bytes(data)

    unit.requests.telemetry = changed


def _newest(device: Device) -> bytes:
    """Return the number of the newest image."""
    stored = device.images.state.stored
    return bytes((0 if stored is None else stored.number,))


def _reversed_tail(replies: list[Reply]) -> list[Reply]:
    """Keep the first reply and turn the others round."""
    return replies[:1] + replies[:0:-1]


def _telemetry_bytes(name: str, field: str, change: Callable[[bytes], bytes]) -> Damage:
    """Change the bytes of one field of a row."""

    def damage(unit: SimulatedUnit) -> None:
        original = unit.requests.telemetry
        item = unit.device.icd.telemetry[name].named_fields[field]

        def changed(asked: str, snapshot: Snapshot) -> bytes:
            data = original(asked, snapshot)
            if asked != name:
                return data
            end = item.offset + item.size
            return data[: item.offset] + change(data[item.offset : end]) + data[end:]

        unit.requests.telemetry = changed

    return damage


def _of_files(name: str, change: Callable[..., object]) -> Damage:
    """Replace a method of the device's files; `change` gets the files, the method and its arguments."""

    def damage(unit: SimulatedUnit) -> None:
        files = unit.device.files
        original = getattr(files, name)
        setattr(files, name, lambda *arguments: change(files, original, *arguments))

    return damage


def _number(size: int, change: Callable[[int], int]) -> Callable[[bytes], bytes]:
    return lambda raw: (change(int.from_bytes(raw, "little")) % (1 << 8 * size)).to_bytes(size, "little")


enter(
    "frame checksums are wrong",
    "both",
    "images.frames",
    _telemetry_bytes("image_frame_info", "checksum", _number(1, lambda v: v + 1)),
)
enter(
    "frame numbers count from 1",
    "both",
    "images.frames",
    _telemetry_bytes("image_frame_info", "frame", _number(2, lambda v: v + 1)),
)
enter(
    "block checksums are wrong",
    "both",
    "bursts.block",
    _telemetry_bytes("file_block", "checksum", _number(2, lambda v: v ^ 0x8000)),
)
enter(
    "the attitude is not normalised",
    "both",
    "modes.attitude",
    _telemetry_bytes("precise_attitude", "q_w", lambda raw: raw[:3] + bytes([raw[3] ^ 0x01])),
)
enter(
    "the time of exposure is that of the request",
    "both",
    "modes.attitude",
    _telemetry_bytes("precise_attitude", "time_of_exposure", lambda _raw: bytes(8)),
)
enter(
    "parameters report no limits",
    "both",
    "parameters.exposure.limits",
    _telemetry_bytes("parameter", "maximum", lambda _raw: bytes(8)),
)
enter(
    "the runtime stands still",
    "both",
    "time.uptime",
    _telemetry_bytes("device_status", "uptime", lambda _raw: bytes(4)),
)
enter(
    "an image may be downloaded beyond its end",
    "both",
    "images.beyond",
    only_acknowledged(65, b"\x20\x00"),
)
enter(
    "the hole map is not obeyed",
    "both",
    "bursts.holes",
    handling(
        lambda _d, r, h: h(
            dataclasses.replace(r, data=b"\x14\x01") if r.id == 119 and len(r.data) == 2 else r
        )
    ),
)
for _name, _case, _row in (
    ("the file list does not begin again", "files.list", 118),
    ("the file list stays at its first file", "files.list", 113),
    ("a file is not erased", "files.erase", 108),
    ("the card is not formatted", "files.erase-all", 33),
):
    enter(_name, "both", _case, only_acknowledged(_row))
enter(
    "the file list goes round",
    "both",
    "files.end",
    _of_files(
        "advance",
        lambda files, _h: files._go_to((files.state.position + 1) % (len(files._images.state.files) + 1)),
    ),
)
enter("an image is not converted", "both", "jpg.converted", only_acknowledged(57))
enter(
    "every conversion has the same quality",
    "both",
    "jpg.quality",
    handling(lambda _d, r, h: h(dataclasses.replace(r, data=r.data[:1] + b"\x50\0") if r.id == 57 else r)),
)
enter(
    "the newest image is converted",
    "both",
    "jpg.missing",
    handling(lambda d, r, h: h(dataclasses.replace(r, data=_newest(d) + r.data[1:]) if r.id == 57 else r)),
)
enter(
    "the packets of a burst stay at the first",
    "both",
    "bursts.one-by-one",
    _of_files("next_packet", lambda _f, _h: None),
)
enter(
    "a block beyond the end of the file is refused",
    "both",
    "bursts.file",
    _of_files(
        "load",
        lambda files, h, kind, counter, offset, length: h(
            kind, counter, offset, length if offset + length <= len(files._file(kind, counter)) else 0
        ),
    ),
)
enter(
    "a length in packets is taken as one in bytes",
    "both",
    "bursts.file",
    _of_files(
        "load",
        lambda _f, h, kind, counter, offset, length: h(kind, counter, offset, length - (length == 1024)),
    ),
)
enter(
    "the checksum of a file is wrong",
    "both",
    "bursts.file",
    _telemetry_bytes("file_info", "crc", _number(2, lambda v: v ^ 1)),
)
enter(
    "burst packets are in reverse order",
    "both",
    "bursts.block",
    handling(lambda _d, r, h: _reversed_tail(h(r))),
)
enter(
    "an other camera is taken for the star camera",
    "both",
    "images.other-camera",
    handling(
        lambda _d, r, h: h(
            dataclasses.replace(r, data=b"\x02" + r.data[1:]) if r.id == 80 and len(r.data) == 2 else r
        )
    ),
)
enter(
    "unsolicited telemetry comes at half its rate",
    "can",
    "unsolicited.rate",
    handling(
        lambda _d, r, h: h(
            dataclasses.replace(r, data=r.data[:1] + b"\x00\x00\xa0\x40")
            if r.id == 104 and r.data[1:] == b"\x00\x00\x20\x41"
            else r
        )
    ),
)
enter(
    "unsolicited telemetry does not stop",
    "can",
    "unsolicited.rate",
    handling(
        lambda _d, r, h: (
            [Reply(ReplyKind.ACK, 104, destination=r.source)]
            if r.id == 104 and r.data[1:] == bytes(4)
            else h(r)
        )
    ),
)
enter(
    "parameters are clipped instead of refused",
    "both",
    "parameters.exposure.refusals",
    handling(
        lambda _d, r, h: (
            [dataclasses.replace(a, kind=ReplyKind.ACK, code=ErrorCode.OK) for a in h(r)]
            if r.id == 98
            else h(r)
        )
    ),
)
enter(
    "the exposure cannot be set below 10 ms",
    "both",
    "parameters.exposure.values",
    handling(
        lambda _d, r, h: (
            [Reply(ReplyKind.NACK, 98, code=ErrorCode.INVALID_PARAMETER, destination=r.source)]
            if r.id == 98 and r.data[:1] == b"\x01" and r.data[1:] == b"\0\0\0\0\0\0\xf0\x3f"
            else h(r)
        )
    ),
)
enter(
    "set_star_config takes effect in part",
    "both",
    "store.config",
    handling(
        lambda d, r, h: [
            (
                d.parameters.set({"exposure": 161})
                if a.code is ErrorCode.INVALID_PARAMETER and r.id == 37
                else None,
                a,
            )[1]
            for a in h(r)
        ]
    ),
)
