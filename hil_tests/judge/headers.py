"""Headers: fields by role before the data of a message, and the check behind the data.

    | field | field | bit bit bit … | field … |  data  | check |
     address  class   id ack final     ticks

Source: docs/units.md, which defines the roles; the headers of Sagitta (c2a-aobc sagitta.c), NSP (cosmos-core
sinclair_lib.cpp) and NOS3 are such lists. Bits are listed from the lowest. A `length` counts the parts that its
`includes` names, plus its `offset`. A `sequence` repeats that of the request, or numbers the messages that its
`counts` names, from 0 on and modulo its range. A constant, an address and a length in an answer must be exactly what the definition says.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from starhil.hil_tests.judge.rows import SIZES


class InexpressibleError(OverflowError):
    """A message that no header of the unit can express."""


@dataclass(frozen=True)
class Opened:
    """A header that was read: values by role, name of the class, and size."""

    values: Mapping[str, int]
    message_class: str
    size: int


class Header:
    """The header of requests or of replies.

    `models` are the fields as in the definition; `codes` the code of each class in this direction, several of which may name
    one class; `sizes` the bytes of `start`, `check` and `end`, which a length may include.
    """

    def __init__(
        self,
        models: Sequence[Any],
        order: Literal["little", "big"],
        codes: Sequence[tuple[str, int]],
        sizes: Mapping[str, int],
    ) -> None:
        self._models, self._order = models, order
        self._codes, self._sizes = codes, sizes

    def _in(self, message_class: str) -> Iterator[Any]:
        return (model for model in self._models if model.classes is None or message_class in model.classes)

    def roles(self, message_class: str | None = None) -> set[str]:
        """Return the roles in messages of a class, or of any."""
        models = self._models if message_class is None else self._in(message_class)
        return {part.role for model in models for part in (model, *model.bits) if part.role is not None}

    def counted(self) -> set[str]:
        """Return the kinds of messages that the sender numbers itself: `reply`, `unsolicited`."""
        return {kind for model in self._models for part in (model, *model.bits) for kind in part.counts}

    def width(self, role: str) -> int:
        """Return the bits that hold a role; 0 if the header does not have it."""
        fields = [8 * _size(model) for model in self._models if model.role == role]
        bits = [bit.width for model in self._models for bit in model.bits if bit.role == role]
        return max(fields + bits, default=0)

    def data_sizes(self, message_class: str) -> range:
        """Return the numbers of bytes of data that the length field of a class can state; any if there is none."""
        model = next((item for item in self._in(message_class) if item.role == "length"), None)
        if model is None or "data" not in model.includes:
            return range(1 << 16)
        bits = 8 * _size(model) - model.type.startswith("i")
        others = self._counted(model, self.size(message_class), 0)
        return range(max(0, -others), (1 << bits) - others)

    def place(self, model: Any, message_class: str) -> tuple[int, int]:
        """Return offset and size of a field in messages of a class."""
        before = [_size(item) for item in self._in(message_class)]
        number = list(self._in(message_class)).index(model)
        return sum(before[:number]), _size(model)

    def size(self, message_class: str) -> int:
        return sum(_size(model) for model in self._in(message_class))

    def write(self, values: Mapping[str, int], message_class: str, data_size: int) -> bytes:
        """Return the header of a message; a role without a value has its default.

        Raises InexpressibleError for a value that does not fit its field.
        """
        line = b""
        for model in self._in(message_class):
            number = 0
            if model.bits:
                shift = 0
                for bit in model.bits:
                    value = _sent(bit, values)
                    if value >> bit.width:
                        raise InexpressibleError(f"{bit.role} {value} does not fit {bit.width} bits")
                    number |= value << shift
                    shift += bit.width
            elif model.role == "length":
                number = self._counted(model, self.size(message_class), data_size)
            else:
                number = _sent(model, values)
            try:
                line += number.to_bytes(
                    _size(model), model.order or self._order, signed=model.type.startswith("i")
                )
            except OverflowError:
                raise InexpressibleError(f"{model.role} {number} does not fit {model.type}") from None
        return line

    def read(self, body: bytes, message_class: str = "") -> Opened | None:
        """Read a header, of a message whose class may be known; return None if more bytes are needed.

        Raises ValueError for a constant or class that the definition does not have.
        """
        values: dict[str, int] = {}
        position = 0
        for model in self._models:
            if model.classes is not None and message_class not in model.classes:
                continue
            piece = body[position : position + _size(model)]
            if len(piece) < _size(model):
                return None
            position += len(piece)
            number = int.from_bytes(piece, model.order or self._order, signed=model.type.startswith("i"))
            _note(model, number, values)
            for bit in model.bits:
                _note(bit, number & (1 << bit.width) - 1, values)
                number >>= bit.width
            if "class" in values and not message_class:
                message_class = next((name for name, code in self._codes if code == values["class"]), "")
                if not message_class:
                    raise ValueError(f"class {values['class']}")
        return Opened(values, message_class, position)

    def data_size(self, opened: Opened) -> int | None:
        """Return the bytes of data that the length in a header gives; None if it has no length."""
        model = next((item for item in self._in(opened.message_class) if item.role == "length"), None)
        return None if model is None else opened.values["length"] - self._counted(model, opened.size, 0)

    def _counted(self, model: Any, header: int, data: int) -> int:
        sizes = {**self._sizes, "header": header, "data": data}
        return sum(sizes[part] for part in model.includes) + int(model.offset)

    def seconds(self, role: str, count: int) -> float:
        """Return a number of counts of `ticks` or `time` in seconds."""
        return count * next(float(model.scale) for model in self._models if model.role == role)


def _size(model: Any) -> int:
    return SIZES[model.type.replace("bits", "u")]


def _sent(part: Any, values: Mapping[str, int]) -> int:
    """Return what a field or bit sends: its constant, the value for its role, or its default."""
    if part.const is not None:
        return int(part.const)
    return values.get(part.role, part.default or 0)


def _note(part: Any, number: int, values: dict[str, int]) -> None:
    """Record the value of a role; a constant or an address must be that of the definition."""
    required = part.const
    if required is None and part.role == "address":
        required = part.default or 0
    if required is not None and number != required:
        raise ValueError(f"{part.role or 'constant'} {number}, must be {required}")
    if part.role is not None:
        values[part.role] = number
