"""A viewer of a console without a screen, for measurements: `python -m starhil.hil_tests.console_viewer ADDRESS`.

It asks for what an open page asks for, images and the rows that the page shows first, and reads all that
comes.
"""

from __future__ import annotations

import asyncio
import json
import sys
from typing import Final
from urllib.parse import urlsplit

ROWS: Final = ("identification", "boot_status", "unix_time", "communication_status", "precise_attitude")


async def view(address: str) -> None:
    """Read what the console sends until it closes."""
    import aiohttp

    parts = urlsplit(address)
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(f"http://{parts.netloc}/ws?{parts.query}", max_msg_size=0) as socket,
    ):
        await socket.send_str(json.dumps({"id": 1, "do": "subscribe", "frames": True, "rows": ROWS}))
        async for _ in socket:
            pass


if __name__ == "__main__":
    asyncio.run(view(sys.argv[1]))
