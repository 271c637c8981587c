"""Tokens of control channel and console: what a user may choose, and whether a peer has given it."""

from __future__ import annotations

import hmac

from starhil.emulator.errors import EmulatorError


def check_token(option: str, token: str) -> None:
    """Reject a token, given with an option, that cannot stand in an address or in JSON."""
    if not token or not token.isprintable():
        raise EmulatorError(f"{option}: must be a text that can be printed; give another, or omit the option")


def is_token(given: object, token: str) -> bool:
    """Return whether a peer has given a token, in a time that does not depend on how much of it is right."""
    return isinstance(given, str) and hmac.compare_digest(_bytes(given), _bytes(token))


def _bytes(text: str) -> bytes:
    return text.encode(errors="surrogatepass")  # JSON has lone surrogates
