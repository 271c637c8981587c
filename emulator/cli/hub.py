"""`starhil hub`: a CAN bus over TCP."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from starid.cli.output import output_help, prepare_output


def command(
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="TCP port; 0 for a free one.")] = 29536,
    log: Annotated[
        Path | None, typer.Option(help=output_help("Log all CAN frames to this file in candump format."))
    ] = None,
) -> None:
    """Serve a CAN bus over TCP (socketcand protocol) for machines without SocketCAN.

    Connect python-can with interface socketcand, host, port and channel vcan0, and starhil
    with --can socketcand:HOST:PORT/vcan0; `starhil docs walkthrough` shows the protocol. SIGINT or SIGTERM ends the hub.
    """
    import asyncio

    from starhil.emulator.cli.termination import ended_by_signals
    from starhil.emulator.simulation.guard import log_loop_errors_once
    from starhil.protocol.transports.hub import DEFAULT_BUS, CanHub
    from starid.storage.files import open_output

    if log is not None:
        prepare_output(log, "--log")

    async def serve() -> None:
        hub = CanHub(host, port, log=log, opener=open_output)
        await hub.start()
        ended = asyncio.Event()
        log_loop_errors_once(asyncio.get_running_loop())
        with ended_by_signals(ended.set):
            print(f"ready can=socketcand:{hub.host}:{hub.port}/{DEFAULT_BUS}", flush=True)
            await ended.wait()
            await hub.close()
        counters = hub.statistics
        print(
            f"frames={counters.frames} delivered={counters.delivered} dropped={counters.dropped} "
            f"errors={counters.errors}",
            flush=True,
        )

    asyncio.run(serve())
