"""How a handler refuses a request."""

from __future__ import annotations

from starhil.protocol.messages import ErrorCode


class Refused(Exception):  # noqa: N818 (an answer on the bus, not an error of the program)
    """A request that the device answers with an error code.

    Attributes
    ----------
    code
        The published code.
    index
        The field of the telecommand that it is about, for the acknowledge telemetry.
    """

    def __init__(self, code: ErrorCode, index: int = 0) -> None:
        super().__init__(code.name.lower())
        self.code = code
        self.index = index
