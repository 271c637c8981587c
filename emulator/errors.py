"""The error that every user-visible failure of this package derives from."""


class EmulatorError(Exception):
    """A profile, file or port that the emulator rejects; the message is one line with cause, location and remedy."""
