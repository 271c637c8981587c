"""Rules of the product: each rule that a case cites is documented, and each documented rule is checked."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from starhil.hil_tests.conformance.canopen_suite import CANOPEN_CASES
from tests.conformance.test_healthy import SUITES

pytestmark = pytest.mark.long

RULES = Path(__file__).parents[2] / "docs" / "rules.md"
CASES = (*SUITES["serial"], *SUITES["can"], *CANOPEN_CASES)


def test_every_cited_rule_is_written_down_and_every_rule_is_cited():
    written = re.findall(r"^## (R\d+)\b", RULES.read_text(encoding="utf-8"), re.MULTILINE)
    cited = {rule for case in CASES for rule in re.findall(r"\bR\d+\b", case.clause)}
    assert written == [f"R{number}" for number in range(1, len(written) + 1)]
    assert cited == set(written)


def test_no_case_cites_a_rule_without_its_number():
    assert [case.id for case in CASES if "rule" in case.clause and not re.search(r"R\d+", case.clause)] == []
