"""Jitter of what a CAN node sends by itself: messages are counted, intervals averaged, and a node that does not do it is named."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from dataclasses import dataclass, field

import pytest

from starhil.hil_tests.errors import BenchError
from starhil.hil_tests.timing import jitter
from starhil.hil_tests.timing.figures import Jitter
from starhil.hil_tests.timing.jitter import (
    event_timer_jitter,
    heartbeat_jitter,
    sync_to_pdo,
    unsolicited_jitter,
)
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.messages import Reply, ReplyKind, Request
from starhil.protocol.transports.can import open_can
from starhil.protocol.transports.hub import CanHub
from starhil.protocol.unit import load_unit
from tests.hil_tests.timing.test_can_load import DEVICE, HOST, can_device, good

pytestmark = pytest.mark.long

NODE = 44
PERIOD_MS = 5
SECONDS = 0.15
ICD = load_unit()
TPDO = 0x181 + NODE - 1


@dataclass
class Node:
    """A node with a heartbeat and one TPDO, which it sends by timer or at each SYNC."""

    spec: str
    refuses: int = 0
    """Index of the object that it refuses to write."""
    ignores_sync: bool = False
    objects: dict[tuple[int, int], int] = field(default_factory=lambda: {(0x1800, 1): 0x4000_0000 | TPDO})
    commands: list[int] = field(default_factory=list)
    tasks: list[asyncio.Task[None]] = field(default_factory=list)

    async def start(self) -> None:
        self.transport = open_can(self.spec)
        await self.transport.start(self.take)

    async def close(self) -> None:
        for task in self.tasks:
            task.cancel()
        await self.transport.close()

    def send(self, can_id: int, data: bytes = b"") -> None:
        self.transport.send(CanFrame(can_id, data, extended=False))

    def take(self, frame: CanFrame) -> None:
        match frame.id:
            case 0x000:
                self.commands.append(frame.data[0])
                if frame.data[0] == 1 and (period_ms := self.objects.get((0x1800, 5))):
                    self.repeat(TPDO, period_ms)
            case 0x080 if self.objects.get((0x1800, 2)) == 1 and not self.ignores_sync:
                self.send(0x701)  # of another node
                self.send(TPDO, b"\7")
            case number if number == 0x600 + NODE:
                self.answer(frame.data)

    def answer(self, data: bytes) -> None:
        index, subindex = int.from_bytes(data[1:3], "little"), data[3]
        self.send(0x581, b"\x60" + data[1:])  # of another node
        if index == self.refuses:
            self.send(0x580 + NODE, b"\x80" + data[1:4] + 0x0609_0030.to_bytes(4, "little"))
            return
        if data[0] == 0x40:
            value = self.objects[index, subindex]
            self.send(0x580 + NODE, b"\x43" + data[1:4] + value.to_bytes(4, "little"))
            return
        self.objects[index, subindex] = int.from_bytes(data[4:], "little")
        self.send(0x580 + NODE, b"\x60" + data[1:4] + bytes(4))
        if index == 0x1017 and self.objects[index, subindex]:
            self.repeat(0x700 + NODE, self.objects[index, subindex])

    def repeat(self, can_id: int, period_ms: int) -> None:
        async def run() -> None:
            while True:
                self.send(can_id, b"\5")
                await asyncio.sleep(period_ms / 1000.0)

        self.tasks.append(asyncio.ensure_future(run()))


@contextlib.asynccontextmanager
async def node_on_a_bus(**options: object) -> AsyncIterator[Node]:
    """A hub with a node on it."""
    hub = CanHub(port=0)
    await hub.start()
    node = Node(f"socketcand:127.0.0.1:{hub.port}/vcan0", **options)  # type: ignore[arg-type]
    await node.start()
    try:
        yield node
    finally:
        await node.close()
        await hub.close()


MEASURED = {
    "heartbeat": (lambda spec: heartbeat_jitter(spec, SECONDS, PERIOD_MS, node=NODE), "heartbeat every 5 ms", []),
    "event timer": (
        lambda spec: event_timer_jitter(spec, SECONDS, PERIOD_MS, node=NODE), "TPDO by event timer every 5 ms", [128, 1],
    ),
    "SYNC": (lambda spec: sync_to_pdo(spec, 0.6, 0.15, node=NODE), "SYNC to TPDO", [128, 1]),
}  # fmt: skip


@pytest.mark.parametrize("name", MEASURED)
def test_periodic_messages_are_counted_and_the_node_is_reset_afterwards(name: str) -> None:
    measure, what, commands = MEASURED[name]

    async def main() -> tuple[Jitter, Node]:
        async with node_on_a_bus() as node:
            result = await measure(node.spec)
            return result, node

    result, node = asyncio.run(main())
    assert result.what == what
    assert result.messages >= 3
    assert result.period_ms > 0.0
    assert 0.0 <= result.deviation.p50_ms <= result.deviation.p99_ms <= result.deviation.max_ms
    assert node.commands == [*commands, 130]  # reset communication
    if name == "SYNC":
        assert (node.objects[0x1800, 1], node.objects[0x1800, 2]) == (0x4000_0000 | TPDO, 1)
    if name == "event timer":
        assert (node.objects[0x1800, 2], node.objects[0x1800, 5]) == (255, PERIOD_MS)


@pytest.mark.parametrize(
    ("options", "node", "message"),
    [
        ({"refuses": 0x1800}, NODE, "jitter: node 44 refuses 1800h:1 with abort code 06090030h"),
        ({}, 9, "jitter: CANopen node 9 does not answer; is it on this bus?"),
        ({"ignores_sync": True}, NODE, "SYNCs were not followed by a PDO of node 44"),
    ],
)
def test_a_node_that_cannot_be_measured_is_named(
    monkeypatch: pytest.MonkeyPatch, options: dict[str, object], node: int, message: str
) -> None:
    if node != NODE:
        monkeypatch.setattr(jitter, "ANSWER_S", 0.1)

    async def main() -> None:
        async with node_on_a_bus(**options) as there:
            with pytest.raises(BenchError, match=message):
                await sync_to_pdo(there.spec, 0.05, 0.02, node=node)

    asyncio.run(main())


def test_only_unsolicited_messages_of_the_row_are_counted_and_the_first_are_left_out() -> None:
    clock, other = ICD.telemetry["unix_time"], ICD.telemetry["quaternion"]

    def sending(request: Request, number: int) -> list[Reply]:
        rows = [clock, other] * 8 if request.data[:1] == bytes([clock.id]) and number == 0 else []
        unasked = [Reply(ReplyKind.UNSOLICITED, row.id, row.encode(), destination=HOST) for row in rows]
        return [*good(request, number), *unasked]

    async def main() -> Jitter:
        async with can_device(sending) as spec:
            return await unsolicited_jitter(ICD, spec, 0.2, 20.0, device=DEVICE)

    result = asyncio.run(main())
    assert result.what == "unsolicited telemetry at 20 Hz"
    assert result.messages == 8 - jitter.WARM_UP
