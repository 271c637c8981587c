"""A page of the console, as the tests open it."""

import asyncio
import json

import aiohttp
import numpy as np

from starhil.emulator.cli.console_client import ConsoleClient
from starhil.emulator.console.history import COLUMNS
from starhil.emulator.launch import ConsoleOptions, RunOptions

OPTIONS = RunOptions(control="auto", console=ConsoleOptions(ConsoleClient, view="auto"))


WITHIN_S = 20.0


class Page:
    """A page of a console."""

    def __init__(self, emulation, head=None, field="view"):
        self.address = emulation.ready_fields[field] + (f"&head={head}" if head is not None else "")
        self.messages = []
        self.frames = []
        self.history = None
        self.acknowledges = True
        self._parts = []
        self._number = 0

    def url(self, path):
        return self.address.replace("/?", f"{path}?")

    async def __aenter__(self):
        self.session = aiohttp.ClientSession()
        self.socket = await self.session.ws_connect(self.url("/ws"), max_msg_size=0)
        hello = await self.until(lambda: self.history is not None)
        assert hello
        return self

    async def refusal(self):
        """Return the text with which a page is refused."""
        async with aiohttp.ClientSession() as session, session.get(self.url("/ws")) as response:
            return await response.text()

    async def __aexit__(self, *_):
        await self.socket.close()
        await self.session.close()

    async def receive(self):
        message = await asyncio.wait_for(self.socket.receive(), WITHIN_S)
        if message.type is aiohttp.WSMsgType.TEXT:
            self.messages.append(json.loads(message.data))
        elif message.data[:1] == b"F":
            sizes = [int.from_bytes(message.data[start : start + 4], "little") for start in (1, 5)]
            middle, end = 9 + sizes[0], 9 + sum(sizes)
            head = json.loads(message.data[9:middle]) | json.loads(message.data[middle:end])
            self.frames.append((head, message.data[end:]))
            if self.acknowledges:
                await self.socket.send_str(json.dumps({"do": "received"}))
        elif message.data[8:]:
            self._parts.append(np.frombuffer(message.data[8:]).reshape(-1, len(COLUMNS)))
        else:
            self.history = np.vstack([np.empty((0, len(COLUMNS))), *self._parts])

    async def until(self, condition):
        """Receive until a condition holds."""
        for _ in range(1000):
            if found := condition():
                return found
            await self.receive()
        raise AssertionError("never came")

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
