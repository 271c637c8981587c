"""The error that every user-visible failure of this package derives from."""


class StaridError(Exception):
    """Input that starid refuses; the text names what, where and the remedy in one line."""
