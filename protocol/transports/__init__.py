"""Thin asyncio transports between the sans-I/O receivers and real ports and buses."""

from starhil.protocol.transports.base import Statistics, Transport, TransportError
from starhil.protocol.transports.can import CanTransport, open_can
from starhil.protocol.transports.paced import SerialTransport
from starhil.protocol.transports.serial import open_serial

__all__ = [
    "CanTransport",
    "SerialTransport",
    "Statistics",
    "Transport",
    "TransportError",
    "open_can",
    "open_serial",
]
