"""The error that every user-visible failure of this package derives from."""


class EmulatorError(Exception):
    """A profile, file or port that the emulator refuses; one line says what, where and the remedy."""
