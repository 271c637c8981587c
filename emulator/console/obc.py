"""The console as an OBC: telecommands and readings over a link, and their export as a session."""

from __future__ import annotations

import json
import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final, Protocol

from starhil.emulator.errors import EmulatorError
from starhil.emulator.links.table import LinkName
from starhil.protocol.errors import escape_controls
from starhil.protocol.icd import FieldError, InterfaceDefinition
from starhil.protocol.icd.codec import Field, Row
from starhil.protocol.icd.values import Value
from starhil.protocol.serial.cubespace import Dialect

LARGEST_INTEGER: Final = 2**53
"""Integer up to which a page has all of them."""

KEPT_STEPS: Final = 1000
"""Number of latest transactions that can be saved as a session."""

SHOWN_STEPS: Final = 200
"""Number of latest transactions that a page shows."""

POLL_S: Final = 1.0
"""Period in which the console reads every telemetry row that a page shows, and a recording every row, seconds."""

SHORTEST_WAIT_S: Final = 0.05
"""Shortest pause that becomes a step of a session, seconds."""


@dataclass(frozen=True)
class Exchange:
    """Outcome of one request.

    Attributes
    ----------
    outcome
        `ok`, the name of an error code, or `no_reply`.
    detail
        The outcome in one line; empty if it is `ok`.
    latency_s
        Time from request to reply, seconds; None without a reply.
    """

    outcome: str
    detail: str = ""
    latency_s: float | None = None
    data: bytes = b""
    refused: bool = False


class ObcConnection(Protocol):
    """An OBC on a link to the device."""

    async def start(self) -> None:
        """Open the link."""

    async def close(self) -> None:
        """Close the link."""

    async def exchange(self, row: Row, data: bytes) -> Exchange:
        """Send a telecommand, or request telemetry, and wait for the reply."""


@dataclass(frozen=True)
class ObcPort:
    """Bus and address at which an OBC reaches the device.

    Attributes
    ----------
    bus
        Link on which it talks to the device.
    icd
        Interface definition of the device.
    device_address
        Returns the current address or node ID of the device on this bus; a telecommand may change it.
    dialect
        Returns the current dialect of serial replies; None for a unit without dialects.
    """

    bus: LinkName
    where: str
    icd: InterfaceDefinition
    device_address: Callable[[], int]
    dialect: Callable[[], Dialect | None]


MakeClient = Callable[[ObcPort], ObcConnection]
"""Makes the OBC for a port."""


@dataclass(frozen=True)
class SentStep:
    """A transaction for a step of a session, with the times of request and outcome."""

    begin_s: float
    end_s: float
    row: Row
    data: bytes
    values: Mapping[str, Value]
    exchange: Exchange
    wall_s: float
    """Unix time of the request."""

    def content(self) -> dict[str, Any]:
        """Return what a page shows of it."""
        return {
            "kind": str(self.row.kind),
            "row": self.row.name,
            "values": {key: json_value(value) for key, value in self.values.items()},
            "wall_s": self.wall_s,
            **exchange_content(self.exchange),
        }


class ConsoleObc:
    """Sends the requests of pages and records them.

    Parameters
    ----------
    icd
        Interface definition of the device.
    """

    def __init__(
        self, client: ObcConnection, icd: InterfaceDefinition, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.client = client
        self._icd = icd
        self._clock = clock
        self._steps: deque[SentStep] = deque(maxlen=KEPT_STEPS)

    @property
    def steps(self) -> int:
        """Number of recorded transactions."""
        return len(self._steps)

    def sent(self, most: int = SHOWN_STEPS) -> list[dict[str, Any]]:
        """Return the latest transactions for a page, oldest first."""
        return [step.content() for step in list(self._steps)[-most:]]

    def clear(self) -> None:
        """Discard the recorded transactions."""
        self._steps.clear()

    def encode(self, name: str, values: Mapping[str, Any]) -> tuple[Row, bytes, dict[str, Value], str]:
        """Encode a telecommand; limits are not enforced, so that the response of the device can be tested.

        Returns
        -------
        row, data, values, problem
            The row, its bytes, the values by field, and a violation of the definition, or an empty text.
        """
        row = self._row("telecommand", name)
        try:
            physical = {
                key: parse_value(field, values[key])
                for key, field in row.named_fields.items()
                if values.get(key) not in (None, "")
            }
            data = row.encode(physical, check=False)
        except (FieldError, ValueError) as error:
            raise EmulatorError(str(error)) from None
        try:
            row.encode(physical)
        except FieldError as error:
            return row, data, physical, str(error)
        return row, data, physical, ""

    async def send(self, name: str, values: Mapping[str, Any]) -> Exchange:
        row, data, physical, _ = self.encode(name, values)
        return await self._exchange(row, data, physical)

    async def read(self, name: str) -> tuple[Exchange, dict[str, Any]]:
        """Read a telemetry row and record this; return the outcome and the values by field."""
        row = self._row("telemetry", name)
        exchange = await self._exchange(row, b"", {})
        return exchange, decode(row, exchange)

    async def poll(self, name: str) -> tuple[Exchange, dict[str, Any]]:
        """Read a telemetry row without recording this."""
        row = self._row("telemetry", name)
        exchange = await self.client.exchange(row, b"")
        return exchange, decode(row, exchange)

    async def _exchange(self, row: Row, data: bytes, values: Mapping[str, Value]) -> Exchange:
        begin_s, wall_s = self._clock(), time.time()
        exchange = await self.client.exchange(row, data)
        self._steps.append(SentStep(begin_s, self._clock(), row, data, values, exchange, wall_s))
        return exchange

    def _row(self, kind: str, name: str) -> Row:
        rows = self._icd.telecommands if kind == "telecommand" else self._icd.telemetry
        if name not in rows:
            raise EmulatorError(f"{escape_controls(name)}: no such {kind}")
        if rows[name].only_sent:
            raise EmulatorError(f"{name}: is only sent, and no request reads it")
        return rows[name]

    def session(self, title: str) -> str:
        """Return the recorded transactions as a session script (TOML); pauses between them become waits."""
        if not self._steps:
            raise EmulatorError("nothing has been sent yet: send a telecommand or read a row first")
        lines = [f"title = {toml(title)}", "", "[defaults]", "timeout_s = 2.0"]
        end_s = math.inf
        for step in self._steps:
            if (pause_s := step.begin_s - end_s) >= SHORTEST_WAIT_S:
                lines += ["", "[[step]]", f"wait_s = {pause_s:.2f}"]
            lines += ["", *_step_lines(step)]
            end_s = step.end_s
        return "\n".join(lines) + "\n"


def _step_lines(step: SentStep) -> list[str]:
    telecommand = step.row.kind == "telecommand"
    lines = ["[[step]]", f"{'command' if telecommand else 'read'} = {toml(step.row.name)}"]
    if telecommand and step.data:
        if step.exchange.refused or any(isinstance(value, bytes) for value in step.values.values()):
            lines.append(f"with_hex = {toml(step.data.hex().upper())}")
        else:
            pairs = ", ".join(f"{key} = {toml(value)}" for key, value in step.values.items())
            lines.append(f"with = {{ {pairs} }}")
    if step.exchange.refused:
        lines.append(f"refused = {toml(step.exchange.outcome)}")
    return lines


def toml(value: Value) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (int, float)):
        return repr(value)
    text = value.hex() if isinstance(value, bytes) else value
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def parse_value(field: Field, value: object) -> Value:
    """Convert the text that a page has given for a field to the type of the field.

    Raises
    ------
    ValueError
        The text cannot be converted; the message names the field.
    """
    if field.kind == "flag":
        return bool(value) if isinstance(value, (bool, int)) else str(value) == "true"
    text = str(value).strip()
    try:
        if field.kind == "bytes":
            return bytes.fromhex(text)
        if field.kind == "text":
            return text
        if field.kind == "enum" and field.enum is not None and text in field.enum.values:
            return text
        try:
            return int(text, 0)
        except ValueError:
            return float(text)
    except ValueError:
        kind = "bytes in hexadecimal" if field.kind == "bytes" else "a number"
        raise ValueError(f"{field.name}: {text!r} is not {kind}") from None


def decode(row: Row, exchange: Exchange) -> dict[str, Any]:
    """Return the values of a telemetry reply by field, for JSON; empty without a valid reply."""
    if exchange.outcome != "ok" or len(exchange.data) != row.size:
        return {}
    return {key: json_value(value) for key, value in row.decode(exchange.data).items()}


def json_value(value: Value) -> Any:
    """Return a value for JSON: bytes in hexadecimal, and None for a number that is not finite."""
    if isinstance(value, bytes):
        return value.hex(" ").upper()
    if isinstance(value, float) and not abs(value) < float("inf"):
        return None
    return json_integer(value) if isinstance(value, int) else value


def json_integer(value: int | bool) -> int | str:
    """Return an integer for JSON, as text if a page would round it."""
    return value if abs(value) <= LARGEST_INTEGER else str(value)


def exchange_content(exchange: Exchange) -> dict[str, Any]:
    """Return the outcome of a request as JSON data."""
    latency = None if exchange.latency_s is None else round(exchange.latency_s * 1e3, 3)
    return {
        "outcome": exchange.outcome,
        "detail": exchange.detail,
        "refused": exchange.refused,
        "latency_ms": latency,
    }
