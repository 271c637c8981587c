"""Hosts that cannot be, and a hub that goes in the moment in which it was joined."""

import asyncio

import pytest

from starhil.protocol.transports import TransportError, open_can
from starhil.protocol.transports.hub_client import HubTransport
from starhil.protocol.transports.serial import open_serial


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


def test_a_hub_that_ends_after_its_last_answer_is_not_joined(monkeypatch):
    shake = HubTransport._shake_hands

    async def shake_and_see_it_go(self, connection):
        await shake(self, connection)
        while connection.transport is not None:
            await asyncio.sleep(0)

    monkeypatch.setattr(HubTransport, "_shake_hands", shake_and_see_it_go)

    async def serve(reader, writer):
        writer.write(b"< hi >")
        for _ in range(3):
            await reader.readuntil(b">")
            writer.write(b"< ok >")
        writer.close()

    async def main():
        async with await asyncio.start_server(serve, "127.0.0.1", 0) as server:
            transport = open_can(f"socketcand:127.0.0.1:{server.sockets[0].getsockname()[1]}/vcan0")
            with pytest.raises(TransportError, match="closed the connection"):
                await transport.start(lambda _: None)
            await transport.close()

    asyncio.run(main())
