"""Chromium of the system, driven by playwright, and emulators with a console: what the browser tests of the console share."""

import os
import shutil
import socket
import threading
import time
from array import array
from contextlib import contextmanager, suppress
from fcntl import ioctl
from pathlib import Path
from termios import FIONREAD

import pytest

from starhil.hil_tests.rig.emulator_process import EmulatorProcess, emulator_command
from starhil.hil_tests.rig.private_can_bus import private_can_bus
from tests.waiting import PATIENCE_S

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
AXE = (
    Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    / "starhil-tests/axe-core-4.14.1/package/axe.min.js"
)
"""axe-core, which tools/install_test_packages fetches."""

LIVE_HZ = 3
STILL_HZ = 0.1
"""Update rates: of the tests that look at images, and of the others."""

still = pytest.mark.usefixtures("still_page")
"""Marks a test that looks at no image: the next one comes after ten seconds."""

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
        arguments = ["--no-sandbox", "--disable-gpu"]  # which would be emulated on the processor
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=arguments)
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
    page.set_default_timeout(1000 * PATIENCE_S)
    lines = []
    page.on("console", lambda message: lines.append(message.text))
    page.on("pageerror", lambda error: lines.append(str(error)))
    page.goto(address)
    page.wait_for_selector("#link[data-state=connected]")
    page.wait_for_function("() => window.starhil && starhil.store.status")
    yield page
    page.close()
    assert lines == []


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


def reset(page):
    """Bring back a page that several tests share: live, at a desk, in its first state, on a device that tracks, without faults."""
    page.set_viewport_size({"width": 1280, "height": 800})
    page.evaluate(
        "starhil.store.scrub(null); starhil.sky.reset(); document.activeElement.blur(); document.querySelectorAll('dialog[open]').forEach((each) => each.close())"
    )
    assert ask(page, do="control", request={"do": "clear_faults"})["ok"]
    command(page, "set_update_rate", rate=LIVE_HZ)
    track(page)


@contextmanager
def requests_of(page):
    """Yield a function that returns what the page has requested since, but what to show and how bytes are encoded."""
    page.evaluate(
        "() => { window.requested = []; const { link } = starhil; link.request = (content) => { requested.push(content.do); return link.constructor.prototype.request.call(link, content); }; }"
    )
    yield lambda: [do for do in page.evaluate("requested") if do not in ("subscribe", "encode", "parameters")]
    page.evaluate("() => { delete starhil.link.request; }")


def let_pass(page, seconds):
    """Wait until simulation time has passed, whatever the page shows."""
    run_time = "async () => (await starhil.link.control({ do: 'status' })).run_time_s"
    end = page.evaluate(run_time) + seconds
    page.wait_for_function(f"async (end) => await ({run_time})() >= end", arg=end, polling=100)


def track(page):
    """Have the device track."""
    if page.locator("#mode").text_content() != "tracking":
        command(page, "set_mode", mode="lost_in_space")
    wait_for_text(page, "#mode", "tracking")
    wait_for_text(page, "#validity", "valid")


class SlowLink:
    """A proxy of a server that holds what waits, as `ssh -L` does, and passes it on at a rate.

    Attributes
    ----------
    bytes_s
        The rate; without limit at first.
    most
        The most bytes from the server that have waited.
    """

    BUFFER = 2_000_000
    """Bytes that the way holds."""

    def __init__(self, port):
        self.bytes_s = float("inf")
        self.most = 0
        self._server = port
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]

    def __enter__(self):
        threading.Thread(target=self._serve, daemon=True).start()
        return self

    def __exit__(self, *_exc):
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()

    def _serve(self):
        with suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                server = socket.socket()
                server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, self.BUFFER)
                server.connect(("127.0.0.1", self._server))
                for ends in ((client, server), (server, client)):
                    threading.Thread(target=self._pump, args=ends, daemon=True).start()

    def _pump(self, source, sink):
        from_server = source.getpeername()[1] == self._server
        waiting = array("i", [0])
        with suppress(OSError):
            while data := source.recv(2048):
                if from_server:
                    ioctl(source, FIONREAD, waiting)
                    self.most = max(self.most, len(data) + waiting[0])
                    time.sleep(len(data) / self.bytes_s)
                sink.sendall(data)
        for each in (source, sink):
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
