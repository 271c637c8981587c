"""The link of the console's OBC to the device."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Literal

from starhil.emulator.console.obc import MakeClient, ObcClient, ObcPort
from starhil.emulator.emulation import Emulation
from starhil.emulator.links.can import CanLink
from starhil.emulator.links.serial import SerialLink


async def open_obc(
    emulation: Emulation, make_client: MakeClient, closers: list[Callable[[], object]]
) -> ObcClient:
    """Open an OBC on the CAN bus of the run, or on a separate link if the unit has no bus there.

    Parameters
    ----------
    emulation
        The run, open.
    make_client
        Makes the OBC.
    closers
        Gets the closers of what is opened, in that order.
    """
    device, has = emulation.device, emulation.icd.link
    bus: Literal["can", "serial", ""] = "can" if has.can is not None else ""
    where = emulation.ready_fields["can"] if emulation.can is not None else ""
    separate: SerialLink | CanLink | None = None
    if bus and not where:
        from starhil.protocol.transports.can import open_can

        where = f"virtual:starhil-console-{os.getpid()}"
        separate = CanLink(emulation.requests, open_can(where))
    elif not bus and has.serial is not None:
        from starhil.protocol.transports.serial import open_serial

        bus = "serial"
        separate = SerialLink(emulation.requests, open_serial("auto", paced=False))
    if separate is not None:
        closers.append(separate.close)
        where = await separate.start()
    client = make_client(
        ObcPort(
            bus,
            where,
            emulation.icd,
            device_address=lambda: int(device.parameters["can_address"]),
            dialect=lambda: separate.dialect if isinstance(separate, SerialLink) else None,
        )
    )
    closers.append(client.close)
    await client.start()
    return client
