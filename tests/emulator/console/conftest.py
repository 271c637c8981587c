"""Chromium on the page of one emulator, which the browser tests share."""

import pytest

from tests.emulator.console.browser import (
    LIVE_HZ,
    STILL_HZ,
    chromium,
    command,
    emulator_with_console,
    opened,
    reset,
    track,
)


@pytest.fixture(scope="session")
def emulator():
    settings = [f"parameters.update_rate={LIVE_HZ}"]
    with emulator_with_console("--view-token", "look", serial="auto", settings=settings) as process:
        yield process


@pytest.fixture(scope="module")
def browser():
    with chromium() as started:
        yield started


@pytest.fixture(scope="module")
def shared(browser, emulator):
    """A page that tracks; the device takes no images for the modules that follow."""
    with opened(browser, emulator.ready["view"]) as page:
        track(page)
        yield page
        command(page, "set_mode", mode="standby")


@pytest.fixture
def page(shared):
    """The page of the module: live, at a desk, tracking, without faults."""
    reset(shared)
    return shared


@pytest.fixture
def still_page(page):
    """The page while images are rare."""
    command(page, "set_update_rate", rate=STILL_HZ)
