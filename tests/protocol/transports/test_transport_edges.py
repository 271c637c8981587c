"""Hosts that cannot be, and a hub that goes in the moment in which it was joined."""

import asyncio

import pytest

from starhil.protocol.transports.base import TransportError
from starhil.protocol.transports.can import open_can
from starhil.protocol.transports.serial import open_serial
from tests.waiting import until

pytestmark = pytest.mark.long


@pytest.mark.parametrize("host", ["127.0.0..1", "x" * 300])
@pytest.mark.parametrize("kind", ["socket", "listen", "socketcand"])
def test_an_invalid_host_is_reported_in_one_line(kind, host):
    transport = (
        open_can(f"socketcand:{host}:29536/x") if kind == "socketcand" else open_serial(f"{kind}://{host}:1")
    )

    async def main():
        with pytest.raises(TransportError, match="cannot") as refusal:
            await transport.start(lambda _: None)
        assert host in str(refusal.value)
        assert "\n" not in str(refusal.value)

    asyncio.run(main())


def test_a_hub_that_ends_after_its_last_answer_is_lost():
    async def serve(reader, writer):
        writer.write(b"< hi >")
        for _ in range(3):
            await reader.readuntil(b">")
            writer.write(b"< ok >")
        writer.close()

    async def main():
        errors = []
        async with await asyncio.start_server(serve, "127.0.0.1", 0) as server:
            transport = open_can(f"socketcand:127.0.0.1:{server.sockets[0].getsockname()[1]}/vcan0")
            await transport.start(lambda _: None, errors.append)
            await until(lambda: bool(errors))
            assert "lost: the hub closed the connection" in str(errors[0])
            await until(lambda: transport.statistics.reconnects > 1)  # joined again, and lost again
            await transport.close()

    asyncio.run(main())
