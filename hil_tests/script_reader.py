"""Reader of the tables of a session script; errors name file, table, key and near matches."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any, NoReturn

from starhil.hil_tests.errors import ScriptError
from starhil.protocol.names import did_you_mean


@dataclass
class TableReader:
    """One table of a script; reading a key makes it known.

    Attributes
    ----------
    table : mapping
        The parsed TOML table.
    location : str
        Beginning of error messages, such as `first_light.toml: step 3 (read attitude)`.
    """

    table: Mapping[str, Any]
    location: str
    _known: set[str] = field(default_factory=set)

    def fail(self, text: str) -> NoReturn:
        """Raise ScriptError with the location."""
        raise ScriptError(f"{self.location}: {text}")

    def has(self, key: str) -> bool:
        """Return whether the key is present, and make it known."""
        self._known.add(key)
        return key in self.table

    def value(self, key: str, default: Any = None) -> Any:
        """Return the value of the key."""
        return self.table[key] if self.has(key) else default

    def text(self, key: str, default: str | None = None) -> str:
        """Return a text; without a default the key is required."""
        value = self.value(key, default)
        if not isinstance(value, str):
            self.fail(f"'{key}' must be a text" + ("" if self.has(key) else ", but is missing"))
        return value

    def flag(self, key: str, *, default: bool) -> bool:
        """Return true or false."""
        value = self.value(key, default)
        if not isinstance(value, bool):
            self.fail(f"'{key}' must be true or false, not {value!r}")
        return value

    def number(self, key: str, default: float | None = None, *, minimum: float = -math.inf) -> float:
        """Return a finite number not below `minimum`; without a default the key is required."""
        value = self.value(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            self.fail(f"'{key}' must be a number" + ("" if self.has(key) else ", but is missing"))
        if value < minimum:
            self.fail(f"'{key}' must be at least {minimum:g}, not {value:g}")
        return float(value)

    def optional_number(self, key: str, *, minimum: float = -math.inf) -> float | None:
        """Return a number, or None if the key is missing."""
        return self.number(key, minimum=minimum) if self.has(key) else None

    def count(self, key: str, default: int, *, minimum: int = 1) -> int:
        """Return a whole number not below `minimum`."""
        value = self.value(key, default)
        if isinstance(value, bool) or not isinstance(value, int) or value < minimum:
            self.fail(f"'{key}' must be a whole number of at least {minimum}, not {value!r}")
        return value

    def numbers(self, key: str, length: int) -> tuple[float, ...]:
        """Return a list of exactly `length` finite numbers."""
        values = self.value(key)
        if (
            not isinstance(values, list)
            or len(values) != length
            or not all(
                isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v) for v in values
            )
        ):
            self.fail(f"'{key}' must be a list of {length} numbers")
        return tuple(float(v) for v in values)

    def texts(self, key: str) -> tuple[str, ...]:
        """Return a list of texts; a single text is a list of one, a missing key an empty list."""
        values = self.value(key, [])
        values = [values] if isinstance(values, str) else values
        if not isinstance(values, list) or not all(isinstance(v, str) for v in values):
            self.fail(f"'{key}' must be a text or a list of texts")
        return tuple(values)

    def choice(self, key: str, allowed: Collection[str], default: str | None = None) -> str:
        """Return a text that must be one of the allowed ones."""
        value = self.text(key, default)
        if value not in allowed:
            self.fail(
                f"'{key}' is '{value}', must be one of {', '.join(sorted(allowed))}{did_you_mean(value, allowed)}"
            )
        return value

    def hex_bytes(self, key: str) -> bytes:
        """Return bytes from hexadecimal text, with or without blanks."""
        text = self.text(key)
        try:
            return bytes.fromhex(text)
        except ValueError:
            self.fail(f"'{key}' must be bytes in hexadecimal, such as \"1F 7F 80 1F FF\", not {text!r}")

    def sub(self, key: str) -> TableReader:
        """Return a reader of the table under the key; an empty one if the key is missing."""
        value = self.value(key, {})
        if not isinstance(value, dict):
            self.fail(f"'{key}' must be a table, such as {{ name = value }}")
        return TableReader(value, f"{self.location}: {key}")

    def sub_tables(self, key: str) -> list[dict[str, Any]]:
        """Return the tables of an array of tables."""
        value = self.value(key, [])
        if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
            self.fail(f"'{key}' must be an array of tables: write [[{key}]] before each")
        return value

    def reject_unknown_keys(self) -> None:
        """Reject unknown keys."""
        for key in self.table:
            if key not in self._known:
                known = ", ".join(sorted(self._known))
                self.fail(f"unknown key '{key}'{did_you_mean(key, self._known) or f' (known here: {known})'}")
