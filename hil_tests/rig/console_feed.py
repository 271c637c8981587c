"""Reports the results of a run to the console of a running emulator, as they arrive."""

from __future__ import annotations

import http.client
import json
import logging
import queue
import sys
import threading
import uuid
from typing import Any, Final, Self
from urllib.parse import urlsplit

from starhil.hil_tests.errors import BenchError
from starhil.hil_tests.rig.emulator_process import EmulatorProcess

log = logging.getLogger("starhil.bench")

TIMEOUT_S: Final = 5.0
MAX_WAITING: Final = 5000
"""Number of results that may wait for a slow console; further ones are not shown."""

SHOWN_LINES: Final = 200
LONGEST_LINE: Final = 300
"""Longest line of traffic, characters; a console rejects a report of more than a megabyte."""

ENDED_WITHIN_S: Final = 10.0
"""Maximum time for which the end of a run waits for the console, seconds."""


class RunFeed:
    """Sends results in a separate thread; a console that fails or ends does not delay the run.

    `address` is on the ready line of `starhil run --view`; `kind` is `session` or `conformance`; `planned` is the expected
    number of results, 0 if unknown.

    Raises BenchError: no console answers at the address.
    """

    def __init__(self, address: str, *, kind: str, title: str, unit: str, planned: int) -> None:
        parts = urlsplit(address)
        if parts.scheme != "http" or not parts.hostname:
            raise BenchError(
                f"--view {address}: must be the address of a console, from the ready line of `starhil run --view`"
            )
        self._address = f"{parts.scheme}://{parts.netloc}"
        self._connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=TIMEOUT_S)
        self._path = f"/runs?{parts.query}"
        self._run = uuid.uuid4().hex
        self._waiting: queue.Queue[dict[str, Any] | None] = queue.Queue(MAX_WAITING)
        begin = {"event": "begin", "kind": kind, "title": title, "unit": unit, "planned": planned}
        try:
            self._post(begin)
        except (OSError, http.client.HTTPException, BenchError) as error:
            raise BenchError(f"--view {self._address}: the console does not take reports ({error})") from None
        self._thread = threading.Thread(target=self._send, name="run-feed", daemon=True)
        self._thread.start()

    def result(self, **content: Any) -> None:
        """Report a result.

        Its `status` is `passed`, `failed`, `skipped` or `not run`; the console also shows `id`, `name`, `link`, `seconds`,
        `detail` and the last lines of traffic `log`, of which any may be missing.
        """
        if "log" in content:
            content["log"] = [line[:LONGEST_LINE] for line in content["log"][-SHOWN_LINES:]]
        try:
            self._waiting.put_nowait({"event": "result", "result": content})
        except queue.Full:
            log.debug("console: a result was dropped")

    def close(self) -> None:
        """Report the end of the run, after all results have been sent."""
        try:
            self._waiting.put({"event": "end"}, timeout=ENDED_WITHIN_S)
            self._waiting.put(None, timeout=ENDED_WITHIN_S)
        except queue.Full:
            log.debug("console: the end of the run was dropped")
        self._thread.join(ENDED_WITHIN_S)
        self._connection.close()

    def _send(self) -> None:
        while (event := self._waiting.get()) is not None:
            try:
                self._post(event)
            except (OSError, http.client.HTTPException, BenchError) as error:
                log.warning(
                    "%s: the console accepts no more reports (%s); the run continues", self._address, error
                )
                while self._waiting.get() is not None:
                    pass
                return

    def _post(self, event: dict[str, Any]) -> None:
        """Send an event; once more on a new connection if the console has closed this one, which was idle."""
        body = json.dumps({"run": self._run, **event})
        for last in (False, True):
            try:
                self._connection.request("POST", self._path, body, {"Content-Type": "application/json"})
                response = self._connection.getresponse()
                break
            except (ConnectionError, http.client.RemoteDisconnected, http.client.CannotSendRequest):
                self._connection.close()
                if last:
                    raise
        text = response.read().decode(errors="replace").strip()
        if response.status != http.client.OK:
            raise BenchError(text or f"status {response.status}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()


def console_address(view: str, emulator: EmulatorProcess | None) -> str:
    """Return the address of the console; for `auto`, print and return the started emulator's.

    Raises BenchError: `auto` was given, but no emulator was started.
    """
    if view != "auto":
        return view
    if emulator is None or "view" not in emulator.ready:
        raise BenchError(
            "--view auto needs --start; otherwise give the address from the ready line of `starhil run --view`"
        )
    print(f"console: {emulator.ready['view'].replace('/?', '/runs?')}", file=sys.stderr, flush=True)
    return emulator.ready["view"]
