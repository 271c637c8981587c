"""A slave on the table: frames go in and out by hand, and the `canopen` library is its master."""

from __future__ import annotations

import io
from collections import deque
from collections.abc import Iterable
from functools import lru_cache

import canopen
import pytest

from starhil.hil_tests.conformance.canopen_probe import CanopenProbe
from starhil.hil_tests.conformance.canopen_suite import CANOPEN_CASES
from starhil.hil_tests.conformance.case import CaseFailed
from starhil.hil_tests.conformance.runner import run_case
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.canopen.application import GreyImage
from starhil.protocol.canopen.device_dictionary import DeviceDictionary
from starhil.protocol.canopen.slave import CanopenSlave
from starhil.protocol.canopen.storage import ParameterStorage
from starhil.protocol.export import eds
from starhil.protocol.unit import load_unit
from tests.protocol.canopen.stand_in import StandInApplication

NODE = 0x2C


@lru_cache
def shared_dictionary(unit: str) -> DeviceDictionary:
    """Build the dictionary of a unit once: most of the time of a test would go there, and a slave connects all of it again."""
    return DeviceDictionary(load_unit(unit))


class Bench:
    """One slave, a manual clock, and the frames and events of the slave; the benches of a unit are used one after the other."""

    def __init__(
        self, node_id: int = NODE, storage: ParameterStorage | None = None, unit: str = "cubestar", **options
    ) -> None:
        self.dictionary = shared_dictionary(unit)
        self.dictionary.changed.clear()
        self.dictionary.new_instant()
        self.application = StandInApplication(self.dictionary.icd)
        self.dictionary.application = self.application
        self.storage = storage
        self.slave = CanopenSlave(self.dictionary, node_id, storage=storage, **options)
        self.now = 100.0
        self.sent: list[CanFrame] = []
        self.node = node_id

    def power_on(self) -> Bench:
        self.sent += self.slave.start(self.now)
        return self

    def frame(
        self, identifier: int, data: bytes | Iterable[int] | str = b"", **fields
    ) -> list[tuple[int, bytes]]:
        """Give the slave a frame; return what it sends as (identifier, data)."""
        data = bytes.fromhex(data) if isinstance(data, str) else bytes(data)
        frames = self.slave.receive(
            CanFrame(
                identifier,
                data,
                extended=fields.get("extended", False),
                **{key: value for key, value in fields.items() if key != "extended"},
            ),
            self.now,
        )
        self.sent += frames
        return [(frame.id, frame.data) for frame in frames]

    def sdo(self, request: str | bytes) -> str:
        """Give an SDO request (spaces allowed, padded to 8 bytes); return the answers as hexadecimal text."""
        data = bytes.fromhex(request) if isinstance(request, str) else request
        answers = self.frame(0x600 + self.node, data.ljust(8, b"\0"))
        assert all(identifier == 0x580 + self.node for identifier, _ in answers)
        return " ".join(data.hex() for _, data in answers)

    def read(self, index: int, subindex: int = 0) -> bytes:
        """Read by SDO, expedited or segmented."""
        mux = index.to_bytes(2, "little").hex() + f"{subindex:02x}"
        answer = bytes.fromhex(self.sdo(f"40{mux}"))
        if answer[0] == 0x80:
            raise canopen.SdoAbortedError(int.from_bytes(answer[4:], "little"))
        if answer[0] & 2:
            return answer[4 : 8 - (answer[0] >> 2 & 3)]
        size, data, toggle = int.from_bytes(answer[4:], "little"), b"", 0
        while len(data) < size or not size:
            part = bytes.fromhex(self.sdo(bytes([0x60 | toggle])))
            data += part[1 : 8 - (part[0] >> 1 & 7)]
            toggle ^= 0x10
            if part[0] & 1:
                break
        assert len(data) == size
        return data

    def number(self, index: int, subindex: int = 0) -> int:
        return int.from_bytes(self.read(index, subindex), "little")

    def write(self, index: int, subindex: int, value: int | bytes, size: int = 4) -> int:
        """Write by expedited SDO; return 0 or the abort code."""
        data = value if isinstance(value, bytes) else value.to_bytes(size, "little")
        command = 0x23 | (4 - len(data)) << 2
        answer = bytes.fromhex(
            self.sdo(bytes([command]) + index.to_bytes(2, "little") + bytes([subindex]) + data)[:16]
        )
        return 0 if answer[0] == 0x60 else int.from_bytes(answer[4:], "little")

    def nmt(self, command: int, node: int | None = None) -> list[tuple[int, bytes]]:
        return self.frame(0, bytes([command, self.node if node is None else node]))

    def operational(self) -> list[tuple[int, bytes]]:
        return self.nmt(1)

    def advance(self, seconds: float) -> list[tuple[float, int, bytes]]:
        """Let time pass, calling `tick` whenever the slave asks for it; return (time, identifier, data)."""
        end, result = self.now + seconds, []
        while (deadline := self.slave.next_deadline()) is not None and deadline <= end + 1e-9:
            self.now = max(self.now, deadline)
            frames = self.slave.tick(self.now)
            self.sent += frames
            result += [(self.now, frame.id, frame.data) for frame in frames]
        self.now = end
        return result

    def show(self, pixels: bytes) -> bytes:
        """Give the application a frame of these pixels, in one row."""
        self.application.images["frame"] = GreyImage(len(pixels), 1, 7, pixels)
        return pixels

    def events(self) -> list[tuple[str, float]]:
        return [(event.kind.value, event.value) for event in self.slave.take_events()]


class DirectNetwork(canopen.Network):
    """The master of the `canopen` library with a slave at the other end of a function call: no bus, no thread."""

    def __init__(self, bench: Bench) -> None:
        super().__init__()
        self._bench = bench
        self.frames = 0

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self.frames += 1
        answers = self._bench.slave.receive(
            CanFrame(can_id, bytes(data), extended=False, remote=remote), self._bench.now
        )
        for frame in answers:
            self.frames += 1
            self.notify(frame.id, bytearray(frame.data), self._bench.now)


class SimulatedBus:
    """A bus in simulated time with one slave on it, for the conformance cases: an hour passes in no time.

    A slave that never comes to rest fails the case instead of hanging it.
    """

    MAX_FRAMES = 100_000
    MAX_TICKS = 5_000

    def __init__(self, slave) -> None:
        self._slave = slave
        self._now = 0.0
        self._frames = deque(slave.start(0.0))
        self.budget = self.MAX_FRAMES

    def now(self) -> float:
        return self._now

    def send(self, frame: CanFrame) -> None:
        self._frames.extend(self._slave.receive(frame, self._now))

    def receive(self, timeout_s: float) -> CanFrame | None:
        end = self._now + timeout_s
        for _ in range(self.MAX_TICKS):
            if self._frames:
                self.budget -= 1
                if self.budget < 0:
                    raise CaseFailed("a node that comes to rest", "frames without end")
                return self._frames.popleft()
            deadline = self._slave.next_deadline()
            if deadline is None or deadline > end:
                self._now = end
                return None
            self._now = max(self._now, deadline)
            self._frames.extend(self._slave.tick(self._now))
        raise CaseFailed("a node that comes to rest", "a deadline without end")


@lru_cache(maxsize=16)
def import_eds(text: str, node_id: int) -> canopen.ObjectDictionary:
    """Read an EDS with the library."""
    with io.StringIO(text) as file:
        file.name = "node.eds"
        return canopen.import_od(file, node_id)


def simulated_probe(dictionary: DeviceDictionary | None = None) -> CanopenProbe:
    """Put the slave on a simulated bus, with the tester at its other end; its dictionary is built now or given."""
    dictionary = DeviceDictionary(load_unit()) if dictionary is None else dictionary

    class RestlessApplication(StandInApplication):
        """Each look at the attitude finds a new one, so that values of two samples cannot be taken for one."""

        reads = 0

        def telemetry(self, row):
            if row.name == "precise_attitude":
                self.reads += 1
                self.rows[row.name] = {"frame_counter": self.reads}
            return super().telemetry(row)

    dictionary.application = RestlessApplication(dictionary.icd)
    slave = CanopenSlave(dictionary, NODE)
    text = eds.render(dictionary.icd)
    return CanopenProbe(SimulatedBus(slave), NODE, import_eds(text, NODE), text)


@pytest.fixture(name="simulated_probe", scope="session")
def simulated_probe_fixture():
    return simulated_probe


@pytest.fixture(scope="session")
def read_eds():
    return lambda text: import_eds.__wrapped__(text, NODE)


@pytest.fixture(scope="session")
def run_conformance():
    """Run all cases against the node on a bus; return case ids by outcome."""

    def run(bus, text: str) -> dict[str, set[str]]:
        probe = CanopenProbe(bus, NODE, import_eds(text, NODE), text)
        outcomes: dict[str, set[str]] = {"passed": set(), "failed": set(), "skipped": set()}
        for case in CANOPEN_CASES:
            outcomes[run_case(probe, case).status].add(case.id)
        return outcomes

    return run


@pytest.fixture
def new_bench() -> type[Bench]:
    return Bench


@pytest.fixture
def bench() -> Bench:
    return Bench().power_on()


@pytest.fixture
def master(bench: Bench) -> canopen.RemoteNode:
    network = DirectNetwork(bench)
    node = canopen.RemoteNode(bench.node, bench.dictionary.od)
    network.add_node(node)
    return node
