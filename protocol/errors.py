"""The error that every user-visible failure of this package derives from."""


class ProtocolError(Exception):
    """Bytes, frames, values or definitions that the protocol refuses; one line says what and where."""
