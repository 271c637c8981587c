"""A transport without a wire, for links of every kind."""

from __future__ import annotations

from starhil.protocol.transports.base import Transport


class Wire(Transport):
    """Keeps what the device sends, and its changes of the bit rate; a test puts in what arrives."""

    def __init__(self) -> None:
        super().__init__("virtual:wire")  # a bus that no other process can join
        self.sent: list = []

    async def _open(self) -> None:
        return

    def send(self, item) -> bool:
        self.sent.append(item)
        return True

    async def drain(self) -> None:
        return

    async def close(self) -> None:
        return

    def arrive(self, item) -> None:
        self._receive(item)

    def set_baud(self, baud: int) -> None:
        self.sent.append(baud)

    def take(self) -> list:
        sent, self.sent = self.sent, []
        return sent
