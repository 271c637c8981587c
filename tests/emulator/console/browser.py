"""Chromium of the system, driven by playwright, and emulators with a console: what the browser tests of the console share."""

import os
import shutil
import socket
import threading
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from starhil.hil_tests.rig.emulator_process import EmulatorProcess, emulator_command
from starhil.hil_tests.rig.private_can_bus import private_can_bus

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
WITHIN_MS = 120_000
"""What a page and an emulator may take on a machine that runs all tests at once."""

AXE = (
    Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    / "starhil-tests/axe-core-4.14.1/package/axe.min.js"
)
"""axe-core, which tools/install_test_packages fetches."""

MARKS = [
    pytest.mark.browser,
    pytest.mark.process,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium: as root, apt-get install chromium"),
]


@contextmanager
def chromium():
    """Yield a browser."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


@contextmanager
def emulator_with_console(*extra, **options):
    """Yield a running emulator with the profile `ideal` on a CAN bus of its own."""
    with private_can_bus() as bus:
        chosen = {"profile": "ideal", "serial": "off", "can": bus, "seed": 1, **options}
        command = emulator_command(**chosen, extra=["--view", "auto", *extra])
        with EmulatorProcess(command) as process:
            yield process


@contextmanager
def opened(browser, address, width=1280, height=800):
    """Yield a page of the console; whatever the browser's console says is a failure."""
    page = browser.new_page(viewport={"width": width, "height": height})
    page.set_default_timeout(WITHIN_MS)
    said = []
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.goto(address)
    page.wait_for_selector("#link[data-state=connected]")
    page.wait_for_function("() => window.starhil && starhil.store.status")
    yield page
    page.close()
    assert said == []


def wait_for_text(page, selector, text):
    """Wait until an element has a text."""
    page.wait_for_function(
        "([selector, text]) => document.querySelector(selector).textContent === text", arg=[selector, text]
    )


def ask(page, **request):
    """Make a request of the page, and return the answer."""
    return page.evaluate("request => starhil.link.request(request)", request)


def command(page, row, **values):
    """Send a telecommand as the console."""
    answer = ask(page, do="send", row=row, values=values)
    assert answer["outcome"] == "ok", answer


def fault(page, **levels):
    """Inject faults."""
    assert ask(page, do="control", request={"do": "fault", **levels})["ok"]


def track(page):
    """Have the device track."""
    if page.locator("#mode").text_content() != "tracking":
        command(page, "set_mode", mode="lost_in_space")
    wait_for_text(page, "#mode", "tracking")
    wait_for_text(page, "#validity", "valid")


@contextmanager
def slow_link(port, bytes_s, buffered=8192):
    """Yield the port of a proxy that passes bytes from a server at a rate, and buffers some, as `ssh -L` does."""

    def pump(source, sink, pause_s):
        with suppress(OSError):
            while data := source.recv(2048):
                sink.sendall(data)
                time.sleep(len(data) * pause_s)
        for each in (source, sink):
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)

    def serve():
        with suppress(OSError):
            while True:
                client, _ = listener.accept()
                server = socket.socket()
                server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffered)
                server.connect(("127.0.0.1", port))
                for arguments in ((client, server, 0.0), (server, client, 1.0 / bytes_s)):
                    threading.Thread(target=pump, args=arguments, daemon=True).start()

    with socket.create_server(("127.0.0.1", 0)) as listener:
        threading.Thread(target=serve, daemon=True).start()
        yield listener.getsockname()[1]
        listener.shutdown(socket.SHUT_RDWR)
