"""The exception with which an action or quantity refuses a request."""

from __future__ import annotations

from starhil.protocol.messages import ErrorCode


class Refused(Exception):  # noqa: N818 (an answer on the bus, not an error of the program)
    """A request that the device answers with an error code."""

    def __init__(self, code: ErrorCode, argument: str | None = None, data: bytes = b"") -> None:
        super().__init__(code.name.lower())
        self.code = code
        self.argument = argument
        """Name of the invalid argument or parameter, if any."""
        self.data = data
        """Data of the refusal, if the unit's refusals have any."""
        self.index = 0
        """Index of the invalid telecommand field, for the telemetry row `acknowledge`."""
