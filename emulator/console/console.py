"""The console of a head: listens to frames and links, talks to the device as an OBC, and serves the page."""

from __future__ import annotations

import asyncio
import json
import logging
import secrets
import time
from collections.abc import Awaitable, Callable, Sequence
from functools import partial
from typing import Any, Final

from starhil.emulator.console.describe import describe, load_bright_stars
from starhil.emulator.console.events import EventLog
from starhil.emulator.console.history import History, Image, image_of
from starhil.emulator.console.obc import POLL_S, ConsoleObc, ObcConnection, exchange_content
from starhil.emulator.console.obc_link import obc_bus
from starhil.emulator.console.pointing import is_number, pointing_request
from starhil.emulator.console.reported_runs import ReportedRuns
from starhil.emulator.console.stepping import StepRunner
from starhil.emulator.console.trace import RequestEncoder, WireTrace
from starhil.emulator.console.viewer import Viewer
from starhil.emulator.device.measurement import Measurement
from starhil.emulator.device.modes import Mode, Transition
from starhil.emulator.errors import EmulatorError, one_line
from starhil.emulator.links.table import LINKS
from starhil.emulator.links.traffic import CONSOLE_ADDRESS
from starhil.emulator.run import Run
from starhil.emulator.run.head import Head
from starhil.emulator.run.tape import LONGEST_NOTE, Note
from starhil.emulator.simulation.guard import log_internal_error
from starhil.emulator.simulation.threads import in_thread
from starhil.protocol.canopen.device_dictionary import DeviceDictionary
from starhil.protocol.errors import ProtocolError
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.conventions import NANOSECONDS
from starid.errors import StaridError

log = logging.getLogger("starhil.console")

DECODE_S: Final = 0.1
"""Interval at which new traffic is decoded while a page shows it, seconds."""

STATUS_S: Final = 0.5
"""Interval at which the status of the run is reported, seconds."""

CONTROL: Final = frozenset({"status", "truth", "set_truth", "step", "fault", "clear_faults", "scenario"})
"""Requests on the control channel that a page may make."""

RUN_ID: Final = secrets.token_hex(8)
"""Tells a page that connects again whether it is still the same run."""

READ_ONLY_REQUESTS: Final = frozenset({"subscribe", "encode", "parameters", "message"})
"""Requests that a page for viewing only may make."""


class Console:
    """Server side of the pages of a head."""

    def __init__(
        self,
        run: Run,
        head: Head,
        client: ObcConnection,
        logs: Sequence[EventLog],
        stepping: StepRunner,
        runs: ReportedRuns,
    ) -> None:
        self._run = run
        self._head = head
        device = head.device
        self.obc = ConsoleObc(client, device.icd)
        self.history = History()
        self._logs = logs
        self.events = logs[head.number - 1]
        self.runs = runs
        runs.changed.connect(self._broadcast)
        objects = DeviceDictionary(device.icd) if "canopen" in {*head.links, obc_bus(device.icd)} else None
        self.trace = WireTrace(
            device.icd,
            head.traffic,
            head.serial_dialect,
            lambda: next(
                (link.transport.description for link in head.links.values() if link.bus == "can"), ""
            ),
            objects,
        )
        self.stepping = stepping
        self._requests = RequestEncoder(device.icd, objects)
        self._address = LINKS[obc_bus(device.icd)].address
        self._last_image: Image | None = None
        """The latest image; None before the first."""
        self._unresponsive_since_s: float | None = None
        """Simulation time since which the device is unresponsive, seconds; None if it is not."""
        self._hello: dict[str, Any] = {}
        """The description of the run for pages; empty before the first page."""
        self.viewers: set[Viewer] = set()
        self._tasks: list[asyncio.Task[None]] = []
        self._rows_wanted = asyncio.Event()
        self._status_due = asyncio.Event()
        self._stars: asyncio.Task[dict[str, Any]] | None = None
        self._actions: dict[str, Callable[[Viewer, dict[str, Any]], Awaitable[dict[str, Any]]]] = {
            "subscribe": self._subscribe,
            "control": self._control,
            "point": self._point,
            "clock": self._set_clock,
            "encode": self._encode,
            "parameters": self._parameters,
            "send": self._send,
            "read": self._read,
            "clear_session": self._clear_session,
            "note": self._note,
            "message": self._message,
        }

    @property
    def icd(self) -> InterfaceDefinition:
        """Interface definition of the unit."""
        return self._head.icd

    def start(self) -> None:
        device = self._head.device
        device.signals.frame_published.connect(self._frame_published)
        device.signals.mode_changed.connect(self._mode_changed)
        device.signals.faults_changed.connect(self._faults_changed)
        self.events.added.connect(self._event_added)
        self._faults_changed({})
        self._record_mode(device.modes.mode)
        profile = self._head.profile
        path = str(profile.folder / profile.catalog.path) if profile.catalog.path else None
        self._stars = asyncio.create_task(in_thread(load_bright_stars, path, profile.epoch))
        loops = (self._deliver_trace, self._report_status, self._poll_telemetry)
        self._tasks = [asyncio.create_task(self._guarded(loop)) for loop in loops]

    async def close(self) -> None:
        self.trace.close()
        tasks = [*self._tasks, *([self._stars] if self._stars is not None else [])]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    @staticmethod
    async def _guarded(loop: Callable[[], Awaitable[None]]) -> None:
        """Repeat one turn of a loop until cancelled; a turn that fails is logged."""
        while True:
            try:
                await loop()
            except Exception as error:  # noqa: BLE001 (the run continues without this turn)
                log_internal_error("console", error)
                await asyncio.sleep(STATUS_S)

    async def _execute(self, request: dict[str, Any]) -> dict[str, Any]:
        """Execute a request on the control channel for this head."""
        return await self.stepping.execute({**request, "head": self._head.number})

    # --- pages ---

    def join(self, viewer: Viewer) -> None:
        self.viewers.add(viewer)
        self.events.add("page", f"a page was opened; {len(self.viewers)} open")
        self._viewers_changed()

    def leave(self, viewer: Viewer) -> None:
        if viewer in self.viewers:
            self.viewers.discard(viewer)
            self.events.add("page", f"a page was closed or lost; {len(self.viewers)} open")
        self._viewers_changed()

    def _viewers_changed(self) -> None:
        """Make previews only while a page shows them."""
        watchers = self._head.imager.watchers
        if any(viewer.frames for viewer in self.viewers):
            watchers.add(self)
        else:
            watchers.discard(self)
        if any(viewer.rows for viewer in self.viewers):
            self._rows_wanted.set()
        else:
            self._rows_wanted.clear()
        if self.viewers:
            self._status_due.set()
        else:
            self._status_due.clear()

    async def welcome(self, viewer: Viewer) -> None:
        """Send the description of the run to a page."""
        if not self._hello:
            stars = await self._stars if self._stars is not None else {}
            self._hello = describe(self._run, self._head) | stars
        viewer.send(
            json.dumps({"type": "hello", "view_only": not viewer.commands, "run_id": RUN_ID, **self._hello})
        )
        viewer.send(json.dumps({"type": "reasons", "reasons": self.history.reasons}))
        viewer.send(json.dumps({"type": "sent", "items": self.obc.sent(), "all": True}))
        for message in self.runs.messages():
            viewer.send(message)

    def _broadcast(
        self,
        message: dict[str, Any],
        wants: Callable[[Viewer], bool] = lambda _viewer: True,
        *,
        state: str = "",
    ) -> None:
        """Send a message to pages; a page needs only the last one of a state."""
        receivers = [viewer for viewer in self.viewers if wants(viewer)]
        if receivers:
            text = json.dumps(message)
            for viewer in receivers:
                viewer.send(text, state=state)

    # --- listeners ---

    def _frame_published(self, measurement: Measurement) -> None:
        number = self.history.end
        row = self._with_reasons(lambda: self.history.add(measurement))
        image = image_of(measurement, number, row)
        self._last_image = image or self._last_image
        for viewer in self.viewers:
            if viewer.frames:
                viewer.wake()
                if image is not None:
                    viewer.send_image(image)

    def _event_added(self, _event: object) -> None:
        for viewer in self.viewers:
            viewer.wake()

    def _with_reasons(self, add: Callable[[], list[float]]) -> list[float]:
        """Add a row to the history and return it; its reason, if new, is sent to the pages."""
        known = len(self.history.reasons)
        row = add()
        if len(self.history.reasons) != known:
            self._broadcast({"type": "reasons", "reasons": self.history.reasons}, state="reasons")
        return row

    def _mode_changed(self, transition: Transition) -> None:
        self._record_mode(transition.after)

    def _record_mode(self, mode: Mode) -> None:
        """Add a mode without frames to the history; other modes come with their frames."""
        if mode.makes_frames:
            return
        unix_s = self._head.device.time.unix_ns() / NANOSECONDS
        self._with_reasons(lambda: self.history.add_mode(mode, self._now_s(), unix_s))
        for viewer in self.viewers:
            viewer.wake()

    def _faults_changed(self, _request: dict[str, Any]) -> None:
        if not self._head.device.unresponsive:
            self._unresponsive_since_s = None
        elif self._unresponsive_since_s is None:
            self._unresponsive_since_s = self._now_s()

    def _now_s(self) -> float:
        """Return the simulation time, seconds."""
        return self._run.clock.now_ns() / NANOSECONDS

    async def _deliver_trace(self) -> None:
        """Decode new traffic while a page shows it, some items at a time; the next turn of the page has them."""
        await asyncio.sleep(DECODE_S)
        if not any(viewer.wire for viewer in self.viewers):
            return
        while self.trace.decode():
            await asyncio.sleep(0)

    async def _report_status(self) -> None:
        await self._status_due.wait()
        status = await self._execute({"do": "status"})
        truth = await self._execute({"do": "truth"})
        self._broadcast(
            {
                "type": "status",
                "status": status,
                "truth": truth,
                "unresponsive_since_s": self._unresponsive_since_s,
                "stepping": self.stepping.speed,
                "session_steps": self.obc.steps,
                "heard": self._heard(),
                "heads": [
                    _head_state(head, log) for head, log in zip(self._run.heads, self._logs, strict=True)
                ],
                "wall_s": time.time(),
            },
            state="status",
        )
        await asyncio.sleep(STATUS_S)

    def _heard(self) -> list[dict[str, Any]]:
        """Return for each link its name, how many requests the OBC has sent on it, and the age of the last, seconds."""
        now_s = asyncio.get_running_loop().time()
        return [
            {
                "link": LINKS[name].title,
                "requests": link.obc_requests.requests,
                "age_s": None
                if link.obc_requests.last_s is None
                else round(now_s - link.obc_requests.last_s, 1),
            }
            for name, link in self._head.links.items()
        ]

    async def _poll_telemetry(self) -> None:
        """Read every row that is shown on a page once."""
        await self._rows_wanted.wait()
        rows = sorted(frozenset[str]().union(*(viewer.rows for viewer in self.viewers)))
        begin = time.monotonic()
        for number, name in enumerate(rows):
            exchange, values = await self.obc.poll(name)
            self._broadcast(
                {"type": "telemetry", "row": name, "values": values, **exchange_content(exchange)},
                partial(_shows, name),
                state=f"telemetry {name}",
            )
            due = begin + (number + 1) * POLL_S / len(rows)
            await asyncio.sleep(max(0.005, due - time.monotonic()))

    # --- requests of a page ---

    async def answer(self, viewer: Viewer, request: dict[str, Any]) -> dict[str, Any]:
        identity = {"type": "answer", "id": request.get("id")}
        action = self._actions.get(str(request.get("do")))
        if action is None:
            return {**identity, "ok": False, "error": f"do: must be one of {', '.join(self._actions)}"}
        if not viewer.commands and request["do"] not in READ_ONLY_REQUESTS:
            return {**identity, "ok": False, "error": "view only: the token of this page may not command"}
        try:
            return {**identity, "ok": True, **await action(viewer, request)}
        except (EmulatorError, ProtocolError, StaridError) as error:
            return {**identity, "ok": False, "error": str(error)}
        except Exception as error:  # noqa: BLE001 (an internal error ends neither the run nor the page)
            log_internal_error("console", error)
            return {**identity, "ok": False, "error": f"internal error: {one_line(error)}"}

    async def _subscribe(self, viewer: Viewer, request: dict[str, Any]) -> dict[str, Any]:
        rows = request.get("rows") or []
        if not isinstance(rows, list) or not all(isinstance(name, str) for name in rows):
            raise EmulatorError("rows: must be a list of names of telemetry rows")
        frames, wire = bool(request.get("frames")), bool(request.get("wire"))
        if wire and not viewer.wire:
            while self.trace.decode():
                await asyncio.sleep(0)
        if frames and not viewer.frames and self._last_image is not None:
            viewer.send_image(self._last_image)
        viewer.subscribe(
            frames=frames, wire=wire, history=_count(request, "history"), events=_count(request, "events")
        )
        known = frozenset(row.name for row in self._head.device.icd.readable)
        viewer.rows = known.intersection(rows)
        self._viewers_changed()
        return {}

    async def _control(self, _viewer: Viewer, request: dict[str, Any]) -> dict[str, Any]:
        wanted = dict(_table(request, "request"))
        if str(wanted.get("do")) not in CONTROL:
            raise EmulatorError(f"request: do must be one of {', '.join(sorted(CONTROL))}")
        return await self._execute(wanted)

    async def _point(self, _viewer: Viewer, request: dict[str, Any]) -> dict[str, Any]:
        profile = self._head.profile
        path = str(profile.folder / profile.catalog.path) if profile.catalog.path else None
        mount = None if profile.truth.mount is None else profile.truth.mount.build()
        _table(request, "to")
        truth = await self._execute({"do": "truth"})
        wanted = await in_thread(pointing_request, request, truth, mount, path, profile.epoch)
        return await self._execute(wanted)

    async def _set_clock(self, _viewer: Viewer, request: dict[str, Any]) -> dict[str, Any]:
        if self._run.stepper is None:
            raise EmulatorError(f"the clock is {self._run.clock.name} and cannot be stopped")
        speed = request.get("speed")
        self.stepping.run(float(speed) if isinstance(speed, (int, float)) else 0.0)
        return {"speed": self.stepping.speed}

    async def _encode(self, _viewer: Viewer, request: dict[str, Any]) -> dict[str, Any]:
        row, data, _, problem = self.obc.encode(str(request.get("row")), _table(request, "values"))
        parameters = self._head.device.parameters
        address = int(parameters[self._address]) if self._address else 0
        encoded = self._requests.encode(row, data, CONSOLE_ADDRESS, address)
        obc_address, as_obc = int(parameters["host_address"]), []
        if self._head.icd.link.can is not None:
            as_obc = self._requests.encode(row, data, obc_address, address)["cansend"]
        return {"problem": problem, "obc_address": obc_address, "as_obc": as_obc, **encoded}

    async def _parameters(self, _viewer: Viewer, _request: dict[str, Any]) -> dict[str, Any]:
        """Return the present values of the parameters by name, as numbers."""
        present, known = self._head.device.parameters, self._head.icd.device_parameters
        return {"values": {name: known[name].to_number(present[name]) for name in known}}

    async def _send(self, _viewer: Viewer, request: dict[str, Any]) -> dict[str, Any]:
        exchange = await self.obc.send(str(request.get("row")), _table(request, "values"))
        self._report_sent()
        return exchange_content(exchange)

    async def _read(self, _viewer: Viewer, request: dict[str, Any]) -> dict[str, Any]:
        exchange, values = await self.obc.read(str(request.get("row")))
        self._report_sent()
        return {"values": values, **exchange_content(exchange)}

    async def _clear_session(self, _viewer: Viewer, _request: dict[str, Any]) -> dict[str, Any]:
        self.obc.clear()
        self._broadcast({"type": "sent", "items": [], "all": True})
        return {}

    def _report_sent(self) -> None:
        """Send the last transaction to all pages."""
        self._broadcast({"type": "sent", "items": self.obc.sent(1), "all": False})

    async def _note(self, _viewer: Viewer, request: dict[str, Any]) -> dict[str, Any]:
        text, at_s = str(request.get("text", "")).strip()[:LONGEST_NOTE], request.get("at_s")
        if not text:
            raise EmulatorError("text: a note must not be empty")
        if at_s is not None and not (is_number(at_s) and 0.0 <= at_s <= self._now_s()):
            raise EmulatorError("at_s: must be a simulation time that has been")
        self._run.wiring.latch()
        self._run.wiring.enter(Note, text=text)
        return {"n": self.events.note(text, at_s).n}

    async def recording(self) -> bytes:
        """Return numbers, events and traffic of the last hour as an MCAP file.

        Raises
        ------
        EmulatorError
            The package `mcap` is not installed.
        """
        try:
            from starhil.emulator.console.mcap import recorded
        except ImportError:
            raise EmulatorError("record: needs `mcap`; pip install 'starhil[mcap]'") from None
        rows = self.history.rows(range(self.history.start, self.history.end))
        events, items, reasons = self.events.events(), self.trace.items(), list(self.history.reasons)
        return await in_thread(recorded, self._head, rows, reasons, events, items)

    async def _message(self, _viewer: Viewer, request: dict[str, Any]) -> dict[str, Any]:
        """Return a message of the trace, with its fields and what sends it again."""
        return self.trace.message(_count(request, "n"))


def _head_state(head: Head, log: EventLog) -> dict[str, Any]:
    """Return mode, validity and faults of a head."""
    levels = head.faults.describe()
    return {
        "head": head.number,
        "mode": head.device.modes.mode.value,
        "valid": log.valid,
        "faults": [
            f"{level}: {', '.join(content) if isinstance(content, dict) else len(content)}"
            for level, content in levels.items()
        ],
    }


def _shows(row: str, viewer: Viewer) -> bool:
    return row in viewer.rows


def _count(request: dict[str, Any], key: str) -> int:
    """Return a number of items that a page has; 0 if it is missing or wrong."""
    value = request.get(key)
    return value if isinstance(value, int) else 0


def _table(request: dict[str, Any], key: str) -> dict[str, Any]:
    value = request.get(key, {})
    if not isinstance(value, dict):
        raise EmulatorError(f"{key}: must be an object")
    return value
