"""Selection of the CAN transport: kernel CAN, the TCP hub, or another bus of python-can."""

from __future__ import annotations

import errno
import fcntl
import socket
import struct
from functools import partial
from typing import Any, Final

import can
from can.interfaces.socketcan import SocketcanBus

from starhil.protocol.can.frame import CanFrame
from starhil.protocol.transports.base import Transport, TransportError
from starhil.protocol.transports.hub import DEFAULT_BUS, DEFAULT_HOST, DEFAULT_PORT
from starhil.protocol.transports.hub_client import AutoHubTransport, HubTransport
from starhil.protocol.transports.python_can import PythonCanTransport

CanTransport = Transport[CanFrame]

_OPTIONS: Final[dict[str, dict[str, Any]]] = {
    "slcan": {"bitrate": 1_000_000},
    "udp_multicast": {"hop_limit": 0},
}
"""Options of python-can's interfaces."""

RECEIVE_BUFFER: Final = 4 * 1024 * 1024
"""Receive buffer of a kernel CAN socket (bytes), where the system allows it."""

_SO_RCVBUFFORCE: Final = 33
_SIOCGIFFLAGS: Final = 0x8913
_IFF_UP: Final = 1
_FORMS: Final = "auto, a kernel interface (vcan0), socketcand:HOST:PORT/BUS, virtual:NAME, udp_multicast:GROUP, slcan:PORT"


def kernel_can_is_up(name: str) -> bool:
    family = getattr(socket, "AF_CAN", None)
    if family is None:
        return False
    try:
        with socket.socket(family, socket.SOCK_RAW, socket.CAN_RAW) as probe:
            request = struct.pack("16sh14x", name.encode()[:15], 0)
            answer = fcntl.ioctl(probe.fileno(), _SIOCGIFFLAGS, request)
    except OSError:
        return False
    return bool(struct.unpack_from("16sh", answer)[1] & _IFF_UP)


def open_can(spec: str = "auto") -> CanTransport:
    """Return the CAN transport that a specification names; `start` opens it.

    It is `auto` (vcan0 if the kernel has it, otherwise the hub at the default address, which is started in this
    process if none answers there), a kernel interface such as `vcan0` or `socketcan:can0`,
    `socketcand:HOST:PORT/BUS`, `virtual:NAME` (one process), `udp_multicast:GROUP` (this machine only),
    or `slcan:PORT`.

    Raises TransportError: the specification is invalid.
    """
    if spec == "auto":
        if kernel_can_is_up(DEFAULT_BUS):
            return _python_can("socketcan", DEFAULT_BUS)
        return AutoHubTransport(DEFAULT_HOST, DEFAULT_PORT)
    interface, colon, channel = spec.partition(":")
    if not colon:
        interface, channel = "socketcan", spec
    if interface == "socketcand":
        return _socketcand(spec, channel)
    if interface in can.VALID_INTERFACES and channel:
        return _python_can(interface, channel)
    raise TransportError(f"CAN {spec}: must be {_FORMS}")


def new_hub() -> CanTransport:
    """Return the transport of a hub that `start` starts in this process, on a free port."""
    return AutoHubTransport(DEFAULT_HOST, 0)


def _socketcand(spec: str, where: str) -> CanTransport:
    address, slash, bus = where.partition("/")
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535 or (slash and not bus):
        raise TransportError(f"CAN {spec}: must be socketcand:HOST:PORT/BUS")
    return HubTransport(host, int(port), bus or DEFAULT_BUS)


def _python_can(interface: str, channel: str) -> CanTransport:
    opener = partial(_open_bus, interface, channel)
    return PythonCanTransport(f"{interface}:{channel}", opener, echoes=interface == "udp_multicast")


def _open_bus(interface: str, channel: str) -> can.BusABC:
    if interface != "socketcan":
        return can.Bus(interface=interface, channel=channel, **_OPTIONS.get(interface, {}))
    _check_kernel(channel)
    bus = SocketcanBus(channel)
    _enlarge_receive_buffer(bus.socket)
    return bus


def _enlarge_receive_buffer(kernel_socket: socket.socket) -> None:
    """Enlarge the buffer of a socket, if permitted: the kernel drops frames when it is full."""
    try:
        kernel_socket.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, RECEIVE_BUFFER)
    except PermissionError:
        kernel_socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)


def _check_kernel(channel: str) -> None:
    """Raise OSError with the reason and the remedy if a kernel interface is not available."""
    remedy = "name another; for an emulator, auto falls back to the TCP hub"
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except (OSError, AttributeError):
        raise OSError(errno.EAFNOSUPPORT, f"this kernel has no CAN; {remedy}") from None
    if channel not in (name for _, name in socket.if_nameindex()):
        raise OSError(errno.ENODEV, f"no such interface; {remedy}")
    if not kernel_can_is_up(channel):
        raise OSError(errno.ENETDOWN, f"interface is down; bring it up: ip link set {channel} up")
