"""Violations, and values as an oracle knows them."""

from __future__ import annotations

from starhil.hil_tests.judge.messages import Value

Known = tuple[Value, float]
"""A value and its tolerance."""


class Violation(Exception):  # noqa: N818 (what it is called)
    """Something that a unit must never do."""
