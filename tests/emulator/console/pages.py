"""A page of the console, as the tests open it."""

import asyncio
import json
import struct

import aiohttp
import numpy as np

from starhil.emulator.cli.console_client import ConsoleClient
from starhil.emulator.console.history import COLUMNS, TIMES
from starhil.emulator.launch import ConsoleOptions, RunOptions
from tests.waiting import PATIENCE_S

OPTIONS = RunOptions(control="auto", console=ConsoleOptions(ConsoleClient, view="auto"))


class Page:
    """A page of a console."""

    def __init__(self, emulation, head=None, field="view"):
        self.address = emulation.ready_fields[field] + (f"&head={head}" if head is not None else "")
        self.messages = []
        self.frames = []
        self.rows = {}
        self.acknowledges = True
        self.rows_received = 0
        self.turns = 0
        self._number = 0

    def url(self, path):
        return self.address.replace("/?", f"{path}?")

    async def __aenter__(self):
        self.session = aiohttp.ClientSession()
        self.socket = await self.session.ws_connect(self.url("/ws"), max_msg_size=0)
        await self.message("hello")
        return self

    async def refusal(self):
        """Return the text with which a page is refused."""
        async with aiohttp.ClientSession() as session, session.get(self.url("/ws")) as response:
            return await response.text()

    async def __aexit__(self, *_):
        await self.socket.close()
        await self.session.close()

    async def receive(self):
        """Receive a turn."""
        data = (await asyncio.wait_for(self.socket.receive(), PATIENCE_S)).data
        self.turns += 1
        (length,) = struct.unpack_from("<I", data)
        turn = json.loads(data[4 : 4 + length])
        self.messages += turn["messages"]
        first, count = turn["rows"]
        self.rows_received += count
        middle = 4 + length + 8 * TIMES * count
        end = middle + 4 * (len(COLUMNS) - TIMES) * count
        times = np.frombuffer(data[4 + length : middle], "<f8").reshape(count, TIMES)
        others = np.frombuffer(data[middle:end], "<f4").reshape(count, len(COLUMNS) - TIMES)
        for number, row in enumerate(np.hstack([times, others]), first):
            self.rows[number] = row
        if "image" in turn:
            self.frames.append((turn["image"], data[end:]))
        if self.acknowledges:
            await self.acknowledge()

    async def acknowledge(self):
        """Acknowledge the last turn."""
        await self.socket.send_str(json.dumps({"do": "received", "at": 1.0}))

    @property
    def history(self):
        """The rows that have come, oldest first."""
        return np.array([self.rows[number] for number in sorted(self.rows)]).reshape(-1, len(COLUMNS))

    def items(self, kind):
        """Return the items of a log that have come."""
        return [item for message in self.messages if message["type"] == kind for item in message["items"]]

    async def until(self, condition):
        """Receive until a condition holds."""
        async with asyncio.timeout(PATIENCE_S):
            while not (found := condition()):
                await self.receive()
        return found

    async def ask(self, **request):
        """Make a request and return its answer."""
        self._number += 1
        number = self._number
        await self.socket.send_str(json.dumps({"id": number, **request}))
        return await self.until(
            lambda: next(
                (item for item in self.messages if item["type"] == "answer" and item["id"] == number), None
            )
        )

    async def message(self, kind, condition=lambda _message: True):
        """Wait for a message of a kind."""
        return await self.until(
            lambda: next((item for item in self.messages if item["type"] == kind and condition(item)), None)
        )

    async def until_frame(self, number):
        """Wait for the frame of a number."""
        await self.until(lambda: self.frames and column(self.frames[-1][0]["row"], "frame") == number)

    async def get(self, path):
        async with self.session.get(self.url(path)) as response:
            return await response.text()


def column(row, name):
    return row[COLUMNS.index(name)]


ALONG_X = {"matrix": [[0, 0, -1], [0, 1, 0], [1, 0, 0]]}
