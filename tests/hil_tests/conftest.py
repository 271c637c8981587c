"""A TCP hub in a thread for tests of the bench."""

from __future__ import annotations

import pytest

from starhil.hil_tests.own_hub import OwnHub


@pytest.fixture
def hub():
    """Channel of a CAN hub at a free port."""
    with OwnHub() as own:
        yield own.channel
