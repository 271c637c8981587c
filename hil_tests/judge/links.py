"""The table of links of the bench: the bus of each, and the parameter without which a unit cannot be reached on it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal, TypeAlias, get_args

BusName: TypeAlias = Literal["serial", "can"]
"""What a unit is plugged into; options, fixtures and logs have these names."""
LinkName: TypeAlias = Literal["serial", "can", "canopen"]
"""Protocols on the buses: `can` is that of CubeSpace."""

BUSES: Final[tuple[BusName, ...]] = get_args(BusName)


@dataclass(frozen=True)
class LinkKind:
    """A row of the table."""

    bus: BusName
    address: str
    """Parameter with the address, or with the format of replies."""


LINKS: Final[Mapping[str, LinkKind]] = {
    "serial": LinkKind("serial", "serial_dialect"),
    "can": LinkKind("can", "can_address"),
    "canopen": LinkKind("can", "canopen_node"),
}
