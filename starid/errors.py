"""The base class of all errors that this package reports to the user."""


class StaridError(Exception):
    """Invalid input; a one-line message states the fault, its location and the remedy."""
