"""The base class of every error that this package reports to its user."""


class StaridError(Exception):
    """Invalid input; the message names the fault, where it is and the remedy, in one line."""
