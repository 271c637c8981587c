"""The exception by which an action or quantity refuses a request."""

from __future__ import annotations

from starhil.protocol.messages import ErrorCode


class Refused(Exception):  # noqa: N818 (an answer on the bus, not an error of the program)
    """A request that the device answers with an error code.

    Attributes
    ----------
    code
        The error.
    argument
        Name of the argument or parameter at fault, if it is one.
    index
        Index of the telecommand field at fault, for the acknowledge telemetry.
    """

    def __init__(self, code: ErrorCode, argument: str | None = None) -> None:
        super().__init__(code.name.lower())
        self.code = code
        self.argument = argument
        self.index = 0
