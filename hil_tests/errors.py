"""The error that every user-visible failure of this package derives from."""


class BenchError(Exception):
    """A script, port or device that the bench refuses; one line says what, where and the remedy."""
