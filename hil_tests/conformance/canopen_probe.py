"""The tester's side of a CANopen node: frames and SDO requests, with a log of the traffic."""

from __future__ import annotations

from binascii import crc_hqx
from collections.abc import Callable, Collection, Iterable
from enum import IntEnum
from typing import Any, Final, TypeVar

from canopen.objectdictionary import ObjectDictionary, ODVariable, datatypes

from starhil.hil_tests.client.raw_traffic import matches, pattern
from starhil.hil_tests.conformance.case import CaseFailed, CaseSkipped, Probe, check, check_equal
from starhil.hil_tests.conformance.link_probe import checked_values
from starhil.hil_tests.conformance.ports import CanFrame, Port
from starhil.hil_tests.judge.canopen import (
    ABORT,
    EMERGENCY,
    EXPEDITED,
    HEARTBEAT,
    NMT,
    SDO_REQUEST,
    SDO_RESPONSE,
    SDO_SIZE,
    AbortedError,
    BadResponseError,
    Entry,
    abort_code,
    download,
    row_data,
    slots,
    upload,
    upload_request,
    written,
)
from starhil.hil_tests.judge.messages import Value
from starhil.hil_tests.judge.rows import Field, Row

T = TypeVar("T")

LSS_FROM_SLAVE: Final = 0x7E4
LSS_TO_SLAVE: Final = 0x7E5

START: Final = 1
STOP: Final = 2
PRE_OPERATIONAL: Final = 128
RESET_NODE: Final = 129
RESET_COMMUNICATION: Final = 130

TEXTS: Final = {"name": 0x1008, "hardware": 0x1009, "software": 0x100A}
"""Objects that describe the node."""
ANSWER_S: Final = 0.5
"""Maximum time for an answer."""
BOOT_S: Final = 3.0
"""Maximum time from a communication reset to the boot-up message."""
FIRST_OWN_OBJECT: Final = 0x2000

SETTLING_S: Final = 0.05
"""Time in which a node obeys an NMT command and frames in transit arrive."""

MAX_WAITING: Final = 20_000
"""Number of unread frames above which a node is considered to flood the bus."""

PDO_OFF: Final = 1 << 31
NO_RTR: Final = 1 << 30


class Abort(IntEnum):
    """Abort codes of SDO transfers (CiA 301 7.2.4.3.17)."""

    TOGGLE = 0x05030000
    TIMEOUT = 0x05040000
    COMMAND = 0x05040001
    BLOCK_SIZE = 0x05040002
    SEQUENCE = 0x05040003
    CRC = 0x05040004
    ACCESS = 0x06010000
    WRITE_ONLY = 0x06010001
    READ_ONLY = 0x06010002
    NO_OBJECT = 0x06020000
    NOT_MAPPABLE = 0x06040041
    PDO_LENGTH = 0x06040042
    INCOMPATIBLE = 0x06040043
    LENGTH = 0x06070010
    LENGTH_HIGH = 0x06070012
    LENGTH_LOW = 0x06070013
    NO_SUBINDEX = 0x06090011
    VALUE = 0x06090030
    VALUE_HIGH = 0x06090031
    VALUE_LOW = 0x06090032
    GENERAL = 0x08000000
    NOT_STORED = 0x08000020
    LOCAL_CONTROL = 0x08000021
    DEVICE_STATE = 0x08000022
    NO_DATA = 0x08000024


VALUE_ABORTS: Final = (Abort.VALUE, Abort.VALUE_HIGH, Abort.VALUE_LOW)
"""Abort codes with which a node may refuse a value."""
WATCHED_NODE: Final = 0x05
"""Node ID of a simulated watched node; no other node on the bus may have it."""


class CanopenProbe(Probe):
    """Talks to one node.

    `od` is the object dictionary of the EDS, whose text is `eds`; empty if there is none. `entries` are those of the unit's definition.
    """

    link = "canopen"

    def __init__(
        self,
        port: Port[CanFrame],
        node: int,
        od: ObjectDictionary,
        eds: str = "",
        entries: Iterable[Entry] = (),
    ) -> None:
        super().__init__(port)
        self.node = node
        self.od = od
        self.eds = eds
        self.entries = list(entries)
        self._boots = True
        self._multiplexer = bytes(3)
        self._found: dict[tuple[int, int], bytes] = {}

    # Around a run

    def identity(self) -> str:
        """Return names, versions and numbers of the node, as far as it has them."""
        texts = {what: self.try_read(index) for what, index in TEXTS.items() if index in self.od}
        parts = {what: text.decode("latin-1") for what, text in texts.items() if isinstance(text, bytes)}
        for subindex, what in enumerate(("vendor", "product", "revision", "serial number"), 1):
            if isinstance(number := self.try_read(0x1018, subindex), bytes):
                parts[what] = f"0x{int.from_bytes(number, 'little'):08X}"
        return ", ".join(f"{what} {text}" for what, text in parts.items())

    def silence(self, *, booting: bool) -> str | None:
        """Return `nothing` if the node does not answer a read of its device type, None if it does.

        The request is repeated for a node that may be booting or stopped; its boot-up message counts as an
        answer too.
        """
        if booting:
            self.drain()
            self.nmt(RESET_COMMUNICATION)
        mine = {base + self.node for base in (EMERGENCY, SDO_RESPONSE, HEARTBEAT)}
        # a node that boots loses requests
        for _ in range(3):
            self.send_request(upload_request(0x1000, 0))
            if self.wait_for(mine, max(ANSWER_S, BOOT_S / 3) if booting else ANSWER_S) is not None:
                return None
        return "nothing"

    def prepare(self) -> None:
        """Record the values of the application objects, except those above 4 bytes, such as the clock."""
        self.abandon_transfer()
        self._found = {
            (item.index, item.subindex): self.read(item.index, item.subindex)
            for item in self.variables()
            if item.index >= FIRST_OWN_OBJECT
            and item.access_type == "rw"
            and 0 < (size_of(item) or 0) <= EXPEDITED
        }

    def restore(self) -> None:
        """Restore the values that `prepare` recorded, and store them.

        Raises CaseFailed: the node does not accept them.
        """
        if not self._found:
            return
        self.reset_to_stored_values()
        changed = {item: value for item, value in self._found.items() if self.read(*item) != value}
        refused = {item: value for item, value in changed.items() if self.write(*item, value)}
        for item, value in refused.items():  # one that is limited by another
            self.set(*item, value)
        if 0x1010 in self.od:
            self.set(0x1010, 1, b"save")

    # Around a case

    def begin(self, *, intrusive: bool) -> None:
        """Begin a case; an intrusive one begins with a communication reset."""
        if intrusive:
            self.reset_to_stored_values()
        else:
            self.abandon_transfer()

    def end(self, *, intrusive: bool, passed: bool) -> None:  # noqa: ARG002 (the same after any case)
        """End a case; an intrusive one ends with a communication reset."""
        if intrusive:
            self.reset_to_stored_values()

    def recover(self) -> None:
        """Do nothing: the next case begins by aborting any transfer."""

    # Frames

    def sleep(self, seconds: float) -> None:
        """Wait; frames received are discarded."""
        self.wait_for((), seconds)

    def send(
        self, can_id: int, data: bytes | str = b"", *, remote: bool = False, extended: bool = False
    ) -> None:
        """Send a frame; text is hexadecimal."""
        payload = bytes.fromhex(data) if isinstance(data, str) else data
        self.send_frame(CanFrame(can_id, payload, extended=extended, remote=remote))

    def send_frame(self, frame: CanFrame) -> None:
        self.log.append(f"{self.now():.4f} -> {frame!s}")
        self.port.send(frame)

    def receive(self, timeout_s: float) -> CanFrame | None:
        """Return the next frame, or None if none arrives in time."""
        frame = self.port.receive(timeout_s)
        if frame is not None:
            self.log.append(f"{self.now():.4f} <- {frame!s}")
        return frame

    def drain(self) -> None:
        """Discard everything received; fail if the node floods the bus."""
        for _ in range(MAX_WAITING):
            if self.receive(0.0) is None:
                return
        raise CaseFailed("a node that comes to rest", f"more than {MAX_WAITING} frames")

    def wait_for(
        self,
        can_ids: int | Collection[int],
        timeout_s: float | None = None,
        accept: Callable[[bytes], bool] = lambda _data: True,
    ) -> bytes | None:
        """Return the data of the next accepted frame with one of the CAN IDs, or None."""
        accepted_ids = {can_ids} if isinstance(can_ids, int) else can_ids
        end = self.now() + (ANSWER_S if timeout_s is None else timeout_s)
        while (left := end - self.now()) >= 0:
            frame = self.receive(left)
            if frame is None:
                return None
            if frame.id in accepted_ids and not frame.extended and not frame.remote and accept(frame.data):
                return frame.data
        return None

    def expect(
        self,
        can_id: int,
        what: str,
        timeout_s: float | None = None,
        accept: Callable[[bytes], bool] = lambda _data: True,
    ) -> bytes:
        """Return the data of the next such frame; fail if none arrives."""
        data = self.wait_for(can_id, timeout_s, accept)
        if data is None:
            raise CaseFailed(f"{what} with CAN ID 0x{can_id:03X}", "nothing")
        return data

    def expect_silence(self, can_ids: int | Collection[int], what: str, for_s: float = 0.1) -> None:
        """Fail if a frame with one of the CAN IDs arrives within a time."""
        data = self.wait_for(can_ids, for_s)
        if data is not None:
            raise CaseFailed(f"no {what}", data.hex(" ") or "an empty frame")

    def count(self, can_id: int, for_s: float) -> list[tuple[float, bytes]]:
        """Return time and data of the frames with a CAN ID within a time."""
        end, frames = self.now() + for_s, []
        while (left := end - self.now()) > 0:
            data = self.wait_for(can_id, left)
            if data is None:
                break
            frames.append((self.now(), data))
        return frames

    # SDO

    def ask(self, request: bytes, timeout_s: float | None = None) -> bytes | None:
        """Send an SDO request, padded to 8 bytes; return the answer, or None."""
        self.send_request(request)
        return self.wait_for(SDO_RESPONSE + self.node, timeout_s)

    def send_request(self, data: bytes) -> None:
        """Send an SDO request, padded to 8 bytes."""
        # initiates a download, an upload, a block upload or a block download: an abort has to name its object
        if data[0] >> 5 in {1, 2} or data[0] & 0xE3 == 0xA0 or data[0] & 0xE1 == 0xC0:
            self._multiplexer = data[1:4]
        self.send(SDO_REQUEST + self.node, data.ljust(SDO_SIZE, b"\0"))

    def abandon_transfer(self) -> None:
        """Abort the last transfer, so that it does not continue into the next case.

        Segments of a block may still be under way, so the device type is read, too: what comes after its answer is of the next case.
        """
        self.send_request(b"\x80" + self._multiplexer + bytes.fromhex("00000008"))
        self.send_request(upload_request(0x1000, 0))
        # the answer to an upload, with or without its size, or an abort; no segment of a block has these bits and this object
        self.wait_for(
            SDO_RESPONSE + self.node,
            accept=lambda data: data[1:4] == b"\x00\x10\x00" and (data[0] >> 5 == 2 or data[0] == ABORT),
        )
        self.drain()

    def expect_unreadable(self, index: int, subindex: int, *codes: int) -> None:
        """Fail unless a read is aborted with one of the codes."""
        request = upload_request(index, subindex)
        check_abort(self.ask(request), *codes, multiplexer=request[1:].hex())

    def value(self, item: ODVariable | Entry) -> bytes:
        """Read an object of the EDS or of the definition."""
        return self.read(item.index, item.subindex)

    def read(self, index: int, subindex: int = 0) -> bytes:
        """Read an object, expedited or segmented; fail if that is not possible."""
        result = self.try_read(index, subindex)
        if isinstance(result, int):
            raise CaseFailed(f"a value of {index:04X}h:{subindex:02X}h", f"abort 0x{result:08X}")
        return result

    def try_read(self, index: int, subindex: int = 0) -> bytes | int:
        """Read an object; return its value, or the abort code as a number."""
        return self._transfer(upload, index, subindex)

    def _transfer(self, transfer: Callable[..., T], *details: Any) -> T | int:
        """Run a transfer; return its result, or the abort code as a number."""
        try:
            return transfer(self.ask, *details)
        except AbortedError as abort:
            return abort.code
        except BadResponseError as error:
            raise CaseFailed(error.expected, _seen(error.seen)) from None

    def upload_blocks(self, mux: bytes, block: int, *, crc: bool = True) -> bytes:
        """Read an object by block upload with this many segments in a block, checking every part of the protocol."""
        response = SDO_RESPONSE + self.node
        self.send_request(bytes([0xA4 if crc else 0xA0]) + mux + bytes([block]))
        begun = self.expect(response, "answer to the block upload")
        check(begun[0] & 0xF9 == 0xC0, "answer C0h to C6h", begun)
        check_equal(begun[1:4], mux, "multiplexer")
        data, request, is_last = b"", b"\xa3", False
        while not is_last:
            self.send_request(request)
            number = 0
            while number < block and not is_last:
                number += 1
                frame = self.expect(response, f"segment {number} of the block")
                check_equal(frame[0] & 0x7F, number, "segment number")
                data, is_last = data + frame[1:], frame[0] > 0x7F
            request = bytes([0xA2, number, block])
        self.send_request(request)
        end = self.expect(response, "end of the block upload")
        check(end[0] & 0xE3 == 0xC1, "end C1h to DDh", end)
        data = data[: len(data) - (end[0] >> 2 & 7)]
        if begun[0] & 0x02:
            check_equal(len(data), int.from_bytes(begun[4:], "little"), "bytes")
        if begun[0] & 0x04 and crc:
            check_equal(int.from_bytes(end[1:3], "little"), crc_hqx(data, 0), "CRC")
        self.send_request(b"\xa1")
        self.expect_silence(response, "answer to the end of an upload", 0.05)
        return data

    def number(self, index: int, subindex: int = 0) -> int:
        return int.from_bytes(self.read(index, subindex), "little")

    def write(self, index: int, subindex: int, value: int | bytes, size: int = 4) -> int:
        """Write up to 4 bytes; return 0 or the abort code."""
        data = value if isinstance(value, bytes) else value.to_bytes(size, "little")
        return self._transfer(download, index, subindex, data) or 0

    def put(self, item: ODVariable | Entry, data: bytes) -> None:
        """Write an object of the EDS or of the definition; fail if it is refused."""
        self.set(item.index, item.subindex, data)

    def set(self, index: int, subindex: int, value: int | bytes, size: int = 4) -> None:
        """Write; fail if it is refused."""
        code = self.write(index, subindex, value, size)
        if code:
            raise CaseFailed(f"{index:04X}h:{subindex:02X}h taken", f"abort 0x{code:08X}")

    def expect_refusal(self, index: int, subindex: int, data: bytes, *codes: int) -> None:
        """Fail unless a write is refused with one of the codes."""
        code = self.write(index, subindex, data)
        if code not in codes:
            names = " or ".join(f"0x{wanted:08X}" for wanted in codes)
            raise CaseFailed(f"abort {names}", f"abort 0x{code:08X}" if code else "the value accepted")

    # States

    def nmt(self, specifier: int, node: int | None = None) -> None:
        self.send(NMT, bytes([specifier, self.node if node is None else node]))

    def state(self) -> int:
        """Return the state in the next heartbeat, after frames in transit have arrived."""
        self.sleep(SETTLING_S)
        self.drain()
        return self.expect(HEARTBEAT + self.node, "heartbeat", 1.0)[0]

    def send_watched_heartbeat(self) -> None:
        """Send a heartbeat of the watched node, in OPERATIONAL."""
        self.send(HEARTBEAT + WATCHED_NODE, b"\x05")

    def reset_to_stored_values(self) -> None:
        """Bring the node to PRE-OPERATIONAL with its stored values.

        A missing boot-up message is ignored, because most cases do not test it.
        """
        self.abandon_transfer()
        self.nmt(RESET_COMMUNICATION)
        if self.wait_for(HEARTBEAT + self.node, 3.0 if self._boots else 0.1, _is_boot_up) is None:
            self._boots = False
            self.nmt(PRE_OPERATIONAL)
        self.drain()

    def expect_boot_up(self) -> None:
        """Fail unless the boot-up message arrives; heartbeats in transit are ignored."""
        self.expect(HEARTBEAT + self.node, "boot-up message 00", 5.0, _is_boot_up)

    def quiet(self) -> None:
        """Switch off the heartbeat and all PDOs, so that only the case causes traffic."""
        if 0x1017 in self.od:
            self.set(0x1017, 0, 0, 2)
        for index in (*self.pdo_indices(0x1400), *self.pdo_indices(0x1800)):
            self.disable_pdo(index)

    def disable_pdo(self, index: int) -> None:
        """Disable a PDO, given the index of its communication record."""
        self.set(index, 1, self.number(index, 1) | PDO_OFF)

    def emergency_id(self) -> int:
        """Read the CAN ID of EMCY; skip the case if the node has none."""
        self.require("1014")
        return self.number(0x1014) & 0x7FF

    # Rows, read and written by the entries that hold them

    def telecommands(self) -> Iterable[Row]:
        return [entry.command for entry in self.entries if entry.command is not None and entry.part is None]

    def telemetry_rows(self) -> Iterable[Row]:
        return {entry.row.name: entry.row for entry in self.entries if entry.row is not None}.values()

    def carries(self, row: Row, item: Field) -> bool:
        return any(slot.offset == item.offset for _, slot in slots(row, self.entries))

    def values(self, row: Row) -> dict[str, Value]:
        """Read the values of a row; one outside its limits fails the case.

        The entries are read repeatedly, until no new sample has come in between.
        """
        samples = [b"", bytes(row.size)]
        for _ in range(10):
            samples.append(row_data(row, self.entries, self._part))
            if samples[-1] == samples[-2]:
                break
        return checked_values(row, samples[-1])

    def _part(self, entry: Entry) -> bytes:
        data = self.value(entry)
        if entry.size:
            check_equal(len(data), entry.size, f"bytes of {entry.name}h")
        return data

    def command(self, name: str, **values: Value) -> None:
        """Write an entry that executes a telecommand, which must be accepted."""
        whole = [entry for entry in self.entries if entry.part is None]
        found = {entry.command.name: (entry, entry.command) for entry in whole if entry.command is not None}
        entry, command = found[name]
        self.put(entry, written(entry, command, command.encode(values)))

    # Content of the dictionary

    def variables(self) -> list[ODVariable]:
        """Return all variables of the EDS, without those that only describe data types."""
        variables: list[ODVariable] = []
        for index in sorted(self.od.indices):
            if index < 0x1000:
                continue
            item = self.od.indices[index]
            if isinstance(item, ODVariable):
                variables.append(item)
            else:
                variables += [item.subindices[subindex] for subindex in sorted(item.subindices)]
        return variables

    def lacks(self, entry: str) -> bool:
        """Return whether the EDS lacks an object or entry, `INDEX` or `INDEX:SUBINDEX` in hexadecimal."""
        index, _, subindex = entry.partition(":")
        item = self.od.get(int(index, 16))
        members = {0} if isinstance(item, ODVariable) else getattr(item, "subindices", {})
        return item is None or bool(subindex and int(subindex, 16) not in members)

    def find(self, what: str, wanted: Callable[[ODVariable], bool]) -> ODVariable:
        """Return the first variable that is wanted; skip the case if there is none."""
        for item in self.variables():
            if wanted(item):
                return item
        raise CaseSkipped(f"the EDS has no {what}")

    def require(self, *entries: str) -> None:
        """Skip the case if an object or entry is missing."""
        for entry in filter(self.lacks, entries):
            raise CaseSkipped(
                f"the EDS has no object {entry.replace(':', 'h:', 1) if ':' in entry else entry + 'h'}"
            )

    def pdo_indices(self, first: int) -> list[int]:
        """Return the indices of communication records from 1400h or 1800h on."""
        return [index for index in sorted(self.od.indices) if first <= index < first + 0x200]


def check_abort(answer: bytes | None, *codes: int, multiplexer: str = "") -> None:
    """Fail unless an SDO answer is an abort with one of the codes; an empty multiplexer matches any."""
    expected = "abort " + " or ".join(f"0x{code:08X}" for code in codes)
    if answer is None or len(answer) != 8 or answer[0] != ABORT or abort_code(answer) not in codes:
        raise CaseFailed(expected, _seen(answer))
    if multiplexer not in ("", answer[1:4].hex()):
        raise CaseFailed(f"{expected} for object {multiplexer}", _seen(answer))


def check_answer(data: bytes | None, answer: str) -> None:
    """Fail unless an SDO answer has these bytes, of which `..` is any one, and a final `*` any others."""
    if data is None or not matches(pattern(answer), data.hex().upper()):
        raise CaseFailed(f"SDO answer {answer}", _seen(data))


def size_of(item: ODVariable) -> int | None:
    """Return the size of a variable in bytes, or None if it varies."""
    packer = ODVariable.STRUCT_TYPES.get(item.data_type if item.data_type is not None else -1)
    return None if packer is None else packer.size


def encoded(item: ODVariable, number: int) -> bytes:
    return number.to_bytes(size_of(item) or 1, "little", signed=item.data_type in datatypes.SIGNED_TYPES)


def is_integer(item: ODVariable) -> bool:
    return item.data_type in datatypes.INTEGER_TYPES


def _is_boot_up(data: bytes) -> bool:
    return data == b"\0"


def _seen(data: bytes | None) -> str:
    return "nothing" if data is None else data.hex(" ")
