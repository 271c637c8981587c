"""The table of links: what a unit must have for a link, the keys of the profile that open it, and how it is opened.

A new link is a class like `starhil.emulator.links.can.CanLink`, its keys in `LinksConfig`, and a row here.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Final, Literal, Protocol, TypeAlias

from starhil.emulator.device.requests import Requests
from starhil.emulator.errors import EmulatorError
from starhil.emulator.links.base import AnyLink
from starhil.emulator.links.bus_address import in_use
from starhil.emulator.links.can import CanLink
from starhil.emulator.links.name_lock import lock_symlink
from starhil.emulator.links.serial import SerialLink
from starhil.emulator.profile import Profile
from starhil.emulator.profile.sections import LinksConfig
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.errors import IcdError
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.serial.stack import chosen_dialect
from starhil.protocol.transports.base import Transport
from starhil.protocol.transports.paced import SerialTransport

log = logging.getLogger("starhil.run")

LinkName: TypeAlias = Literal["serial", "can", "canopen"]
"""Names of the links in `LINKS`."""

BUSES: Final[Mapping[str, str]] = {"serial": "serial line", "can": "CAN bus"}
"""Buses, for people."""


class Ports(Protocol):
    """Gives a link its transport, opened by a function, or another one in its place."""

    def serial(self, name: str, make: Callable[[], SerialTransport]) -> SerialTransport:
        """Return the transport of a link that carries bytes."""

    def can(self, name: str, make: Callable[[], Transport[CanFrame]]) -> Transport[CanFrame]:
        """Return the transport of a link that carries CAN frames."""


@dataclass(frozen=True)
class LinkSite:
    """What the links of a head are opened with."""

    requests: Requests
    ports: Ports
    state_dir: Path | None
    """Folder for state that survives a restart; None: it is kept in memory."""
    automatic: str
    """CAN bus for the channel `auto`, such as that of another head."""
    opened: Mapping[str, str]
    """Ports and buses that are open already, as on the ready line."""
    closers: list[Callable[[], object]]
    """Receives what is to be closed after the links."""

    @property
    def profile(self) -> Profile:
        return self.requests.device.profile

    @property
    def channel(self) -> str:
        """CAN channel of the profile; `off` without one."""
        channel = self.profile.links.can.channel
        return self.automatic if channel == "auto" else channel

    def can(self, name: LinkName, channel: str) -> Transport[CanFrame]:
        """Return the transport of a link on a CAN channel, or on a new hub if the usual bus has the head's addresses."""
        from starhil.protocol.transports.can import new_hub, open_can

        def make() -> Transport[CanFrame]:
            usual = open_can(channel)
            return usual if channel != "auto" or self._is_free(usual.description) else new_hub()

        return self.ports.can(name, make)

    def _is_free(self, bus: str) -> bool:
        """Return whether no other emulator uses the addresses of this head on a bus; log the one that does."""
        device = self.requests.device
        for kind in LINKS.values():
            if kind.address and kind.opens(self.profile.links, device.icd):
                why = in_use(kind.role, bus, int(device.parameters[kind.address]))
                if why:
                    log.warning("%s; this one starts a CAN hub on a free port", why)
                    return False
        return True


class LinkKind(ABC):
    """A row of the table."""

    bus: ClassVar[str]
    """Key in `BUSES`, and of its faults."""
    title: ClassVar[str]
    """Name for people."""
    carries: ClassVar[type[bytes | CanFrame]]
    key: ClassVar[str]
    """Key of `[links]` that opens the link."""
    off: ClassVar[str | int] = "off"
    """Value of the key without the link."""
    address: ClassVar[str] = ""
    """Parameter with the address on the bus; empty for a point-to-point line."""
    role: ClassVar[str] = ""
    """What the address is called in messages."""

    @abstractmethod
    def is_of(self, icd: InterfaceDefinition) -> bool:
        """Return whether a unit has the link."""

    def usual(self, icd: InterfaceDefinition) -> str | int:  # noqa: ARG002 (for others)
        """Return the value of the key with which a unit has the link where it is usually looked for."""
        return "auto"

    def setting(self, links: LinksConfig) -> Any:
        """Return the value of the key."""
        section, key = self.key.split(".")
        return getattr(getattr(links, section), key)

    def requested(self, links: LinksConfig) -> bool:
        return bool(self.setting(links) != self.off)

    def opens(self, links: LinksConfig, icd: InterfaceDefinition) -> bool:
        return self.requested(links) and self.is_of(icd)

    @abstractmethod
    def exclusive(self, links: LinksConfig) -> tuple[str, str, int]:
        """Return what only one head can have: a key, and the bus and the number there; an empty bus if nothing."""

    def problem(self, links: LinksConfig, icd: InterfaceDefinition) -> str:  # noqa: ARG002 (for others)
        """Return why a unit cannot have the link as the profile describes it; empty if it can."""
        return ""

    @abstractmethod
    def make(self, site: LinkSite) -> AnyLink:
        """Return the link, which is not started yet."""


class _Serial(LinkKind):
    bus, title, carries, key = "serial", "serial", bytes, "serial.port"

    def is_of(self, icd: InterfaceDefinition) -> bool:
        return icd.link.serial is not None

    def exclusive(self, links: LinksConfig) -> tuple[str, str, int]:
        port = links.serial.port
        return "links.serial.port", "" if port in ("auto", "off") or port.endswith(":0") else port, 0

    def problem(self, links: LinksConfig, icd: InterfaceDefinition) -> str:
        if "dialect" in links.serial.model_fields_set:
            try:
                chosen_dialect(icd, links.serial.dialect)
            except IcdError as error:
                return f"links.serial.dialect: {error}"
        return ""

    def make(self, site: LinkSite) -> AnyLink:
        from starhil.protocol.transports.serial import open_serial

        device, config = site.requests.device, site.profile.links.serial
        baud = int(device.parameters["serial_baud"])
        symlink = Path(config.symlink) if config.symlink else None
        if symlink is not None:
            site.closers.append(lock_symlink(symlink).close)
        # on the stepped clock, no time passes between two items of one event
        pace = None if config.pace and device.clock.stepped is None else False
        transport = site.ports.serial(
            "serial", lambda: open_serial(config.port, baud, symlink=symlink, paced=pace)
        )
        return SerialLink(site.requests, transport, site.profile.run.seed)


class _Can(LinkKind):
    bus, title, carries, key = "can", "CAN", CanFrame, "can.channel"
    address, role = "can_address", "address"

    def is_of(self, icd: InterfaceDefinition) -> bool:
        return icd.link.can is not None

    def exclusive(self, links: LinksConfig) -> tuple[str, str, int]:
        return "links.can.address", "" if links.can.channel == "off" else links.can.channel, links.can.address

    def make(self, site: LinkSite) -> AnyLink:
        gap_s = site.profile.links.can.frame_gap_s if site.requests.device.clock.stepped is None else 0.0
        return CanLink(site.requests, site.can("can", site.channel), gap_s, site.profile.run.seed)


class _Canopen(LinkKind):
    bus, title, carries, key = "can", "CANopen", CanFrame, "canopen.node"
    off = 0
    address, role = "canopen_node", "node"

    def is_of(self, icd: InterfaceDefinition) -> bool:
        return icd.canopen is not None

    def usual(self, icd: InterfaceDefinition) -> int:
        return int(icd.device_parameters[self.address].default)

    def opens(self, links: LinksConfig, icd: InterfaceDefinition) -> bool:
        return self.requested(links) or (icd.canopen_only and links.can.channel != "off")

    def exclusive(self, links: LinksConfig) -> tuple[str, str, int]:
        return "links.canopen.node", links.can.channel if links.canopen.node else "", links.canopen.node

    def problem(self, links: LinksConfig, icd: InterfaceDefinition) -> str:
        lacking = links.canopen.node and not self.is_of(icd)
        return f"links.canopen.node: unit {icd.name} has no CANopen" if lacking else ""

    def make(self, site: LinkSite) -> AnyLink:
        from starhil.emulator.links.canopen import open_canopen  # a slave takes a tenth of a second

        bus = site.opened.get("can") or (site.automatic if site.channel == "off" else site.channel)
        transport = site.can("canopen", bus)
        return open_canopen(site.requests, transport, site.state_dir, site.profile.run.seed)


LINKS: Final[Mapping[str, LinkKind]] = {"serial": _Serial(), "can": _Can(), "canopen": _Canopen()}
"""The links, in the order of opening, which is also that of the ready line."""


def check_links(profile: Profile, icd: InterfaceDefinition) -> None:
    """Check that the unit has at least one of the requested links; log those that it lacks."""
    links, buses = profile.links, {kind.bus for kind in LINKS.values() if kind.is_of(icd)}
    for kind in LINKS.values():
        if problem := kind.problem(links, icd):
            raise EmulatorError(problem)
    requested = [kind for kind in LINKS.values() if kind.requested(links)]
    lacking = [kind for kind in requested if kind.bus not in buses]
    if requested and lacking == requested:
        raise EmulatorError(f"links.{requested[0].key}: unit {icd.name} has none of the links requested")
    for kind in lacking:
        if kind.setting(links) != "auto":
            log.warning("links.%s: unit %s has no such link; it is not opened", kind.key, icd.name)
