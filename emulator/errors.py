"""The base class of the emulator's errors for users."""


class EmulatorError(Exception):
    """Invalid input or an unusable file or port; the message is one line with what, where and the remedy."""
