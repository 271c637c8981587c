"""A TCP hub in a thread for tests of the bench."""

from __future__ import annotations

import pytest

from starhil.hil_tests.rig.private_can_bus import hub_thread


@pytest.fixture
def hub():
    """Channel of a CAN hub at a free port."""
    with hub_thread() as channel:
        yield channel
