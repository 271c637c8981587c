"""Base class of the emulator's errors."""


class EmulatorError(Exception):
    """Invalid input or an unusable file or port; the message is one line with what, where and the remedy."""
