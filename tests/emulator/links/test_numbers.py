"""Messages are numbered from 0 before the rows that report a start are sent."""

from __future__ import annotations

import asyncio

from starhil.emulator.links.serial import SerialLink
from tests.emulator.conftest import Bench
from tests.emulator.wire import Wire
from tests.user_units import packets, written

SEQUENCE = slice(6, 8)
"""Of a packet, after four bytes of sync and two of ID."""


def test_the_row_that_reports_a_start_has_number_0(tmp_path):
    unit = written(tmp_path, packets().replace("unsolicited = 2.0", 'unsolicited = ["start", "mode"]'))

    async def scenario():
        bench = Bench(unit=str(unit)).start()
        uart = Wire()
        link = SerialLink(bench.requests, uart)
        await link.start()
        for _ in range(3):
            bench.device.reset("watchdog")
            assert int.from_bytes(uart.take()[-1][SEQUENCE], "big") & 0x3FFF == 0
            bench.step(1.0)
        await link.close()

    asyncio.run(scenario())
