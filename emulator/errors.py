"""The error of everything that reads a file, opens a port or takes a value from outside, and cannot.

A docstring mentions it only where the reader needs to know more than that.
"""

from __future__ import annotations

from starhil.protocol.errors import OneLineError


class EmulatorError(OneLineError):
    """Invalid input or an unusable file or port; the message is one line with what, where and the remedy."""
