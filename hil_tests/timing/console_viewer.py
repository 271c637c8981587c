"""A headless viewer of the console, for measurements: `python -m starhil.hil_tests.timing.console_viewer ADDRESS`.

Like an open page, it subscribes to images and to the rows that the page shows first, reads everything, and acknowledges each
turn.
"""

from __future__ import annotations

import asyncio
import json
import sys
from typing import Final
from urllib.parse import urlsplit

ROWS: Final = ("identification", "boot_status", "unix_time", "communication_status", "precise_attitude")


async def view(address: str) -> None:
    """Read from the console until it closes the connection."""
    import aiohttp

    parts = urlsplit(address)
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(f"http://{parts.netloc}/ws?{parts.query}", max_msg_size=0) as socket,
    ):
        await socket.send_str(json.dumps({"id": 1, "do": "subscribe", "frames": True, "rows": ROWS}))
        async for message in socket:
            if message.type is aiohttp.WSMsgType.BINARY:
                await socket.send_str(json.dumps({"do": "received"}))


if __name__ == "__main__":
    asyncio.run(view(sys.argv[1]))
