"""The healthy device passes every case, in simulated time, in each dialect."""

from __future__ import annotations

import pytest

from starhil.hil_tests.conformance.suites import can_suite, serial_suite
from starhil.hil_tests.judge.definition import read_unit
from tests.conformance.simulated import healthy_outcomes

pytestmark = pytest.mark.long

UNIT = read_unit("cubestar")
SUITES = {"serial": serial_suite(UNIT), "can": can_suite(UNIT)}


@pytest.mark.parametrize(
    ("link", "dialect"), [("serial", "b"), ("serial", "a"), ("serial", "c"), ("can", "b")]
)
def test_the_healthy_device_passes_every_case(link, dialect):
    outcomes = healthy_outcomes(link, "cubestar", dialect)
    failed = [(o.id, o.expected, o.seen, o.log[-6:]) for o in outcomes if o.status == "failed"]
    assert failed == []
    assert {o.id.split(".")[1] for o in outcomes if o.status == "skipped"} == {"unjudged"}
    assert len(outcomes) > 150
