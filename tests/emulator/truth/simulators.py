"""What dynamics simulators send: the blocks of 42, and a 42 that waits for its acknowledge."""

from __future__ import annotations

import asyncio
import math

import numpy as np

from starid.attitude import Attitude, propagate

ORION = Attitude.from_radec_roll(83.8, -1.2, 30.0)
RATE_DEG_S = (0.279, 0.385, 0.474)
POSITION_M = (6.369110518417e6, 1.427708321263e6, 1.827383319013e6)
VELOCITY_M_S = (-2.62361493475e3, 4.436324912759e3, 5.678236949775e3)


def numbers(values) -> str:
    return "[" + " ".join(f"{value:18.12e}" for value in values) + "]"


def block_of_42(
    t: float, attitude: Attitude, rate_deg_s=RATE_DEG_S, *, brackets: bool = True, bodies_only: bool = False
) -> bytes:
    """One message, as 42 writes it."""
    x, y, z, w = attitude.quaternion_xyzw
    quaternion, rate = numbers((-x, -y, -z, w)), numbers(np.radians(rate_deg_s))
    minutes, seconds = divmod(round(t * 1e9), 60_000_000_000)
    of_spacecraft = [
        f"SC[0].qn = {quaternion}",
        f"SC[0].wn = {rate}",
        f"SC[0].PosR = {numbers([10.0, 0, 0])}",
    ]
    lines = [
        f"TIME 2024-366-23:{minutes:02d}:{seconds / 1e9:012.9f}",
        *([] if bodies_only else of_spacecraft),
        f"SC[0].B[0].wn = {rate}",
        f"SC[0].B[0].qn = {quaternion}",
        f"Orb[0].PosN = {numbers(np.add(POSITION_M, np.multiply(t, VELOCITY_M_S)))}",
        f"Orb[0].VelN = {numbers(VELOCITY_M_S)}",
        "World[3].eph.PosN = [-1.4e+11 -4.7e+10 0.0]",
        "[ENDMSG]",
    ]
    text = "\n".join(lines) + "\n"
    return (
        text if brackets else text.replace("= [", "= ").replace("]\n", "\n").replace("[ENDMSG", "[ENDMSG]")
    ).encode()


def blocks_of_42(count: int, period_s: float = 0.1) -> list[bytes]:
    """Messages of a tumble at a constant rate."""
    rate = np.radians(RATE_DEG_S)
    return [block_of_42(n * period_s, propagate(ORION, rate, n * period_s)) for n in range(count)]


class Stub42:
    """A 42 that listens, sends its blocks and waits for `Ack` after each, or connects to do so."""

    def __init__(self, blocks: list[bytes]) -> None:
        self.blocks = blocks
        self.acknowledged = 0
        self.done = asyncio.Event()

    async def listen(self) -> int:
        """Listen; return the port."""
        self._server = await asyncio.start_server(self.send, "127.0.0.1", 0)
        return self._server.sockets[0].getsockname()[1]

    async def connect(self, port: int) -> None:
        """Connect and send everything."""
        await self.send(*await asyncio.open_connection("127.0.0.1", port))

    async def send(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Send the blocks, each after the acknowledge of the one before."""
        for block in self.blocks:
            middle = math.ceil(len(block) / 2)  # a block comes in pieces
            writer.write(block[:middle])
            await asyncio.sleep(0)
            writer.write(block[middle:])
            assert await reader.readexactly(4) == b"Ack\0"
            self.acknowledged += 1
        self.done.set()
        writer.close()
