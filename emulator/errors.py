"""The error of everything that reads a file, opens a port or takes a value from outside, and cannot.

A docstring mentions it only where the reader needs to know more than that.
"""


class EmulatorError(Exception):
    """Invalid input or an unusable file or port; the message is one line with what, where and the remedy."""
