"""The console's OBC: the client of the bench on the bus of a run."""

from __future__ import annotations

import time
from collections.abc import Callable

from starhil.emulator.console.obc import Exchange
from starhil.hil_tests.async_client import AsyncObcClient
from starhil.hil_tests.errors import BenchError, NackError, NoReplyError
from starhil.hil_tests.links import CanHostLink
from starhil.protocol.codec import Row
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.messages import Request, RequestKind


class ConsoleClient:
    """An OBC for the console on a CAN channel.

    Parameters
    ----------
    channel
        Channel of the bus.
    icd
        Interface definition.
    host_address
        CAN address of this OBC.
    device_address
        Returns the device's present CAN address, which a telecommand may change.
    """

    def __init__(
        self, channel: str, icd: InterfaceDefinition, host_address: int, device_address: Callable[[], int]
    ) -> None:
        self._device_address = device_address
        self._link = CanHostLink(channel, host_address=host_address, device_address=device_address())
        self._client = AsyncObcClient(self._link, icd)

    async def start(self) -> None:
        """Join the bus."""
        await self._client.start()

    async def close(self) -> None:
        """Leave the bus."""
        await self._client.close()

    async def exchange(self, row: Row, data: bytes) -> Exchange:
        """Send a telecommand, or request telemetry, and wait for the reply."""
        telecommand = row.kind == "telecommand"
        kind = RequestKind.TELECOMMAND if telecommand else RequestKind.TELEMETRY
        if self._link.device_address != self._device_address():
            self._link.device_address = self._device_address()
            self._link.reset_receiver()
        begin = time.perf_counter()
        try:
            reply, latency = await self._client.transact(
                Request(kind, row.id, data), row.name, 0 if telecommand else row.size
            )
        except NackError as error:
            return Exchange(error.code_name, str(error), time.perf_counter() - begin, refused=True)
        except NoReplyError as error:
            return Exchange("no_reply", str(error))
        except BenchError as error:
            return Exchange("link_lost", str(error))
        return Exchange("ok", "", latency, reply.data)
