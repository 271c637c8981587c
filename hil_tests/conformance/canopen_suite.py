"""CANopen conformance: the cases of all areas."""

from __future__ import annotations

from typing import Final

from starhil.hil_tests.conformance import (
    canopen_eds,
    canopen_emcy,
    canopen_nmt,
    canopen_od,
    canopen_pdo,
    canopen_sdo,
    canopen_store_lss,
)
from starhil.hil_tests.conformance.canopen_probe import CanopenProbe
from starhil.hil_tests.conformance.canopen_unit import canopen_unit_cases
from starhil.hil_tests.conformance.case import Case, cases_of
from starhil.hil_tests.judge.definition import Unit

CANOPEN_CASES: Final[tuple[Case[CanopenProbe], ...]] = tuple(
    cases_of(
        canopen_eds, canopen_nmt, canopen_sdo, canopen_od, canopen_emcy, canopen_pdo, canopen_store_lss
    )
)  # fmt: skip
"""Cases of CiA 301, for any unit."""


def canopen_suite(unit: Unit) -> tuple[Case[CanopenProbe], ...]:
    """Return the cases for a unit on CANopen.

    Raises IcdError: the unit has no CANopen node.
    """
    return (*CANOPEN_CASES, *canopen_unit_cases(unit))
