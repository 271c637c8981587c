"""The exception by which a handler refuses a request."""

from __future__ import annotations

from starhil.protocol.messages import ErrorCode


class Refused(Exception):  # noqa: N818 (an answer on the bus, not an error of the program)
    """A request that the device answers with an error code.

    Attributes
    ----------
    code
        The published error code.
    index
        Index of the telecommand field at fault, for the acknowledge telemetry.
    """

    def __init__(self, code: ErrorCode, index: int = 0) -> None:
        super().__init__(code.name.lower())
        self.code = code
        self.index = index
