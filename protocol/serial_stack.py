"""The serial link of a unit according to its definition, sans-I/O.

A link is composed of a framing (`framings`), a check (`checks`) and headers (`envelope`) in `composed_stack`. The
framing `cubespace` has three dialects of replies and so a stack of its own (`cubespace_serial`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from starhil.protocol.checks import CheckFunction
from starhil.protocol.codec import Row
from starhil.protocol.composed_stack import ComposedStack
from starhil.protocol.conventions import Order
from starhil.protocol.cubespace_serial import CubeSpaceStack
from starhil.protocol.definition import InterfaceDefinition
from starhil.protocol.link_schema import CubeSpaceFraming, MessageClass, SerialLinkModel
from starhil.protocol.messages import RequestKind
from starhil.protocol.serial_interface import Dialect, RowShape, SerialStack
from starhil.protocol.values import IcdError


def build_stack(
    link: SerialLinkModel,
    classes: Sequence[MessageClass] = (),
    rows: Sequence[RowShape] = (),
    byte_order: Order = "little",
    *,
    framings: Mapping[str, Callable[[], object]] | None = None,
    checks: Mapping[str, CheckFunction] | None = None,
) -> SerialStack:
    """Return the serial link of a unit.

    Raises
    ------
    IcdError
        Parts of the link are incompatible.
    """
    if isinstance(link.framing, CubeSpaceFraming):
        return CubeSpaceStack(link, rows)
    return ComposedStack(link, classes, rows, byte_order, framings=framings, checks=checks)


def chosen_dialect(icd: InterfaceDefinition, wanted: str | None) -> Dialect | None:
    """Return the dialect of serial replies of a unit; None if it has no dialects.

    Parameters
    ----------
    icd
        Definition of the unit.
    wanted
        The user's choice; None for the default: the only dialect of the unit, otherwise b.

    Raises
    ------
    IcdError
        The unit does not have this dialect.
    """
    framing = None if icd.link.serial is None else icd.link.serial.framing
    if not isinstance(framing, CubeSpaceFraming):
        if wanted is not None:
            raise IcdError(f"unit {icd.name} has no reply dialects; do not select one")
        return None
    if framing.dialect is not None and wanted not in (None, framing.dialect):
        raise IcdError(f"unit {icd.name} has only dialect {framing.dialect}; do not select another")
    return Dialect(framing.dialect or wanted or Dialect.B)


def serial_answers(icd: InterfaceDefinition, row: Row) -> tuple[str, ...]:
    """Return the answers of a row on the serial line, of which there may be fewer than on other links."""
    framing = None if icd.link.serial is None else icd.link.serial.framing
    silent = isinstance(framing, CubeSpaceFraming) and row.name in framing.unanswered
    return () if silent else row.answers


def build_serial_stack(icd: InterfaceDefinition) -> SerialStack:
    """Return the serial link of a definition.

    Raises
    ------
    IcdError
        The unit has none, or parts of it are incompatible.
    """
    link = icd.link.serial
    if link is None:
        raise IcdError(f"unit {icd.name}: has no serial link")
    shapes = [
        RowShape(
            row.klass,
            row.id,
            RequestKind(row.kind),
            row.size if row.kind == "telecommand" else 0,
            row.size if row.kind == "telemetry" else 0,
            serial_answers(icd, row),
        )
        for row in icd.rows
    ]
    return build_stack(
        link,
        icd.classes,
        shapes,
        icd.conventions.byte_order,
        framings=icd.plugin.framings,
        checks=icd.plugin.checks,
    )
