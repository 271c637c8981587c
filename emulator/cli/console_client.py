"""The OBC of the console: a client of the bench on a link of the run."""

from __future__ import annotations

import time
from typing import Any

from starhil.emulator.console.obc import Exchange, ObcPort
from starhil.emulator.links.traffic import CONSOLE_ADDRESS
from starhil.hil_tests.client import AsyncObcClient
from starhil.hil_tests.client.links import CanHostLink, HostLink, SerialHostLink
from starhil.hil_tests.errors import BenchError, LinkLostError, NackError, NoReplyError
from starhil.protocol.icd.codec import Row


class ConsoleClient:
    """An OBC for console and recording."""

    def __init__(self, port: ObcPort) -> None:
        self._port = port
        self._client: AsyncObcClient | None = None
        self._settings: tuple[object, ...] = ()
        """Device settings with which the client was made."""

    async def start(self) -> None:
        port = self._port
        self._settings = self._present_settings()
        link: HostLink[Any]
        if port.bus == "can":
            link = CanHostLink(port.where, host_address=CONSOLE_ADDRESS, device_address=port.device_address())
        elif port.bus == "serial":
            link = SerialHostLink(port.icd, port.where, dialect=port.dialect())
        else:
            from starhil.hil_tests.client.canopen_link import CanopenHostLink

            link = CanopenHostLink(port.icd, port.where, node=port.device_address())
        self._client = AsyncObcClient(link, port.icd)
        await self._client.start()

    async def close(self) -> None:
        if self._client is not None:
            await self._client.close()
            self._client = None

    def _present_settings(self) -> tuple[object, ...]:
        return self._port.device_address(), self._port.dialect()

    async def exchange(self, row: Row, data: bytes) -> Exchange:
        """Send a telecommand, or request telemetry, and wait for the reply."""
        if self._settings != self._present_settings():  # a telecommand has changed them
            await self.close()
            await self.start()
        if self._client is None:
            return Exchange("link_lost", f"{row.name}: the link of the console is closed")
        request = self._port.icd.request(row, data)
        begin = time.perf_counter()
        try:
            reply, latency = await self._client.transact(request, row.name)
        except NackError as error:
            return Exchange(error.code_name, str(error), time.perf_counter() - begin, refused=True)
        except NoReplyError as error:
            return Exchange("no_reply", str(error))
        except LinkLostError as error:
            return Exchange("link_lost", str(error))
        except BenchError as error:
            return Exchange("not_sent", str(error))
        return Exchange("ok", "", latency, reply.data)
