"""The link between the console's OBC and the device."""

from __future__ import annotations

import os
from collections.abc import Callable

from starhil.emulator.console.obc import MakeClient, ObcConnection, ObcPort
from starhil.emulator.links.base import AnyLink
from starhil.emulator.links.can import CanLink
from starhil.emulator.links.serial import SerialLink
from starhil.emulator.links.table import LINKS, LinkName
from starhil.emulator.links.traffic import CONSOLE_BUS
from starhil.emulator.run.head import Head
from starhil.protocol.icd import InterfaceDefinition


async def open_obc(head: Head, make_client: MakeClient, closers: list[Callable[[], object]]) -> ObcConnection:
    """Open an OBC on the CAN bus of the run, or on a separate link if the run has no CAN bus.

    Parameters
    ----------
    closers
        Receives a function to close each opened resource, in order of opening.
    """
    icd, parameters = head.icd, head.device.parameters
    separate: AnyLink | None = None
    where, bus = "", obc_bus(icd)
    address = LINKS[bus].address
    if bus == "serial":
        from starhil.protocol.transports.serial import open_serial

        separate = SerialLink(head.requests, open_serial("auto", paced=False), console=True)
    elif bus in head.links:
        where = head.ready_fields["can"]
    else:
        separate = _open_virtual_bus(head)
    if separate is not None:
        closers.append(separate.close)
        head.traffic.add(separate, CONSOLE_BUS)
        where = await separate.start()
    client = make_client(
        ObcPort(
            bus,
            where,
            icd,
            device_address=lambda: int(parameters[address]) if address else 0,
            dialect=lambda: None if separate is None else separate.dialect,
        )
    )
    closers.append(client.close)
    await client.start()
    return client


def _open_virtual_bus(head: Head) -> AnyLink:
    """Return a link of the device to a private virtual CAN bus."""
    from starhil.protocol.transports.can import open_can

    transport = open_can(f"virtual:starhil-console-{os.getpid()}-{id(head)}")
    if not head.icd.canopen_only:
        return CanLink(head.requests, transport)
    from starhil.emulator.links.canopen import CanopenLink

    return CanopenLink(head.requests, transport)


def obc_bus(icd: InterfaceDefinition) -> LinkName:
    """Return the bus on which an OBC talks to a unit."""
    if icd.canopen_only:
        return "canopen"
    return "can" if icd.link.can is not None else "serial"
