"""The control channel, which controls a running emulator independently of the links to the OBC.

Requests and answers are JSON objects, one per line, answered in order. A request has `do` and its arguments; an
optional `id` is returned in the answer. An answer has `ok`; if it is false, `error` gives the reason in one line,
and nothing was changed.

`--control auto` and `unix:/PATH` listen on a Unix socket that only the user of the emulator can open. HOST:PORT
listens on TCP, which is open to every local user and, unless on loopback, to the network: every peer can send all
requests. With a token (`--control-token`, or STARHIL_CONTROL_TOKEN), each request must contain it as
`token`. With several heads, `head` in a request selects one; the default is 1, the first.

docs/control.md lists the requests.
"""

from __future__ import annotations

import asyncio
import json
import logging
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, TypeVar, get_args

import numpy as np
from pydantic import BaseModel, ValidationError

from starhil.emulator.control.scenario import load_scenario
from starhil.emulator.control.socket import ControlSocket, automatic_path
from starhil.emulator.control.token import is_token
from starhil.emulator.device.cycle import Phase
from starhil.emulator.device.measurement import Measurement
from starhil.emulator.errors import EmulatorError, explained
from starhil.emulator.run import Run
from starhil.emulator.run.faults import FaultRequest
from starhil.emulator.run.head import Head
from starhil.emulator.run.tape import AwaitedPhase, ClearedFaults, NewFaults
from starhil.emulator.run.truth_log import compare
from starhil.emulator.sensor.pipeline.messages import as_quaternion
from starhil.emulator.simulation.guard import until_cancelled
from starhil.emulator.simulation.scheduler import Action as SchedulerAction
from starhil.emulator.simulation.threads import in_thread
from starhil.emulator.truth.config import TruthConfig
from starhil.emulator.truth.json_lines import JsonError, parse_object, read_lines
from starhil.emulator.truth.live import LiveTruth
from starhil.protocol.errors import ProtocolError, did_you_mean, remedy
from starhil.protocol.files.validation import problems
from starhil.protocol.icd.conventions import NANOSECONDS
from starhil.protocol.transports.connections import (
    Budget,
    ConnectionLimit,
    Listener,
    detect_lost_peer,
    limit_buffers,
    listen,
    stream_protocol,
)
from starid.errors import StaridError

log = logging.getLogger("starhil.control")

MAX_LINE: Final = 1 << 16
"""Longest request, bytes."""

EXAMINED_ERRORS: Final = 200
"""Number of errors of a request that are examined; of further ones the answer gives the number."""

KEPT_FRAMES: Final = 200
PHASE_WITHIN_S: Final = 30.0
"""Longest wait for a phase of an exposure, unless a request gives another one, simulation time, seconds."""
SHORTEST_WAIT_S: Final = 1e-4
BUSY_ANSWER: Final = (
    b'{"ok": false, "error": "too many connections to the control channel; close others first"}\n'
)

REQUEST_S: Final = 10.0
"""Time within which a peer of the control channel or of the console must complete a request: a line, after its first
byte; for HTTP, after it has connected or received the last response, and the body after the headers; seconds."""

LATE_ANSWER: Final = (
    json.dumps({"ok": False, "error": f"no complete line within {REQUEST_S:g} s"}).encode() + b"\n"
)

Answer = dict[str, Any]
Action = Callable[[Head, dict[str, Any]], Awaitable[Answer]]
Model = TypeVar("Model", bound=BaseModel)
Result = TypeVar("Result")


class ControlServer:
    """Serves the control channel of a run; each request must carry the token, unless it is empty."""

    def __init__(self, run: Run, quit_run: Callable[[], None], token: str = "") -> None:
        self._run = run
        self._frames = {head.number: deque[Measurement](maxlen=KEPT_FRAMES) for head in run.heads}
        """Latest measurements by number of the head."""
        self._token = token
        self._socket: ControlSocket | None = None
        self._opening: asyncio.Task[Any] | None = None
        """The last request for which files are read."""
        self._quit = quit_run
        self._server: asyncio.Server | Listener | None = None
        self._budget = Budget()
        self._peers: dict[asyncio.StreamWriter, bool] = {}
        """Connections, the oldest first, and whether one of their requests was accepted."""
        self._limit = ConnectionLimit("control channel", BUSY_ANSWER)
        self._actions: dict[str, tuple[Action, tuple[str, ...] | None]] = {
            "status": (self._status, ()),
            "truth": (self._truth, ("run_time_s", "unix_s")),
            "frames": (self._last_frames, ("count",)),
            "set_truth": (self._set_truth, ("truth",)),
            "step": (self._step, ("seconds",)),
            "wait": (self._wait, ("seconds", "phase", "within_s")),
            "fault": (self._fault, None),
            "clear_faults": (self._clear_faults, ()),
            "scenario": (self._run_scenario, ("name",)),
            "quit": (self._quit_run, ()),
        }
        """What a request may `do`: function, and keys unless a model checks them."""
        for head in run.heads:
            head.device.signals.frame_published.connect(self._frames[head.number].append)

    async def start(self, where: str) -> str:
        """Listen on `auto`, unix:/PATH or HOST:PORT; return unix:/PATH or HOST:PORT."""
        if where == "auto" or where.startswith("unix:"):
            path = automatic_path() if where == "auto" else Path(where.removeprefix("unix:"))
            self._socket = ControlSocket(path)
            self._server = await asyncio.start_unix_server(
                until_cancelled(self._serve_connection),
                sock=self._socket.socket,
                backlog=self._limit.size,
            )
            return f"unix:{path}"
        host, _, port = where.rpartition(":")
        if not host or not port.isdecimal() or int(port) > 65535:
            raise EmulatorError(f"--control {where}: must be off, auto, unix:/PATH or HOST:PORT")
        what = f"control channel {where}: cannot listen"
        with explained(what, "choose another port, or auto", errors=(OSError, ValueError)):
            serve = until_cancelled(self._serve_connection)
            self._server = await listen(stream_protocol(serve), host, int(port), self._limit.size)
        address = self._server.address
        return f"{address[0]}:{address[1]}"

    def close(self) -> None:
        """Stop listening and close all connections."""
        if self._server is not None:
            self._server.close()
        if self._socket is not None:
            self._socket.close()
        for writer in list(self._peers):
            writer.transport.abort()

    async def _serve_connection(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._make_room()
        if not self._limit.admits(writer.transport, len(self._peers)):
            return
        self._peers[writer] = False
        limit_buffers(writer.transport)
        if self._socket is None:
            detect_lost_peer(writer.transport, must_read=True)
        lines = read_lines(reader, MAX_LINE, within_s=REQUEST_S)
        try:
            if self._token:
                await self._budget.run(self._answer_lines(lines, writer, until_accepted=True))
            await self._answer_lines(lines, writer)
        except ConnectionError as error:
            log.info("control channel: connection lost (%s)", error)
        except TimeoutError:
            writer.write(LATE_ANSWER)
        finally:
            self._peers.pop(writer, None)
            writer.close()

    async def _answer_lines(
        self,
        lines: AsyncIterator[bytes | None],
        writer: asyncio.StreamWriter,
        *,
        until_accepted: bool = False,
    ) -> None:
        """Answer each request, or each up to the first that is accepted."""
        async for line in lines:
            answer = await self.answer(line)
            if writer in self._peers:
                self._peers[writer] |= answer["ok"]
            writer.write(json.dumps(answer).encode() + b"\n")
            await writer.drain()
            if until_accepted and answer["ok"]:
                return

    def _make_room(self) -> None:
        """Close the oldest connection that has not shown the token, if all places are taken and there is one."""
        stranger = next((peer for peer, accepted in self._peers.items() if not accepted), None)
        if self._token and stranger is not None and len(self._peers) >= self._limit.size:
            del self._peers[stranger]
            stranger.transport.abort()

    async def answer(self, line: bytes | str | None) -> Answer:
        """Execute one request and return its answer; None stands for a line that was too long."""
        if line is None:
            return {"ok": False, "error": f"line too long: at most {MAX_LINE} bytes"}
        try:
            request = parse_object(line)
        except JsonError as error:
            return {"ok": False, "error": str(error)}
        identity = {"id": request.pop("id")} if "id" in request else {}
        token = request.pop("token", None)
        if self._token and not is_token(token, self._token):
            return {
                **identity,
                "ok": False,
                "error": "token: missing or wrong; give the token set with --control-token",
            }
        return {**identity, **await self.execute(request)}

    async def execute(self, request: dict[str, Any]) -> Answer:
        """Execute a decoded request, without `id` and `token`, and return its answer."""
        action_name = str(request.pop("do", ""))
        if action_name not in self._actions:
            near = did_you_mean(action_name, self._actions)
            return {"ok": False, "error": f"do: must be one of {', '.join(self._actions)}{near}"}
        action, keys = self._actions[action_name]
        try:
            head = self._head(request)
            if keys is not None:
                _check_keys(request, keys)
            self._run.wiring.latch()
            return {"ok": True, **await action(head, request)}
        except (EmulatorError, ProtocolError, StaridError) as error:
            return {"ok": False, "error": str(error)}
        except Exception as error:  # an internal error ends neither the run nor the connection
            log.exception("control channel: %s", action_name)
            name = type(error).__name__
            return {"ok": False, "error": f"internal error: {name}; see the emulator's log"}

    def _head(self, request: dict[str, Any]) -> Head:
        number, heads = request.pop("head", 1), self._run.heads
        if isinstance(number, bool) or not isinstance(number, int) or not 1 <= number <= len(heads):
            raise EmulatorError(f"head: must be 1 to {len(heads)}, not {number!r}")
        return heads[number - 1]

    async def _status(self, head: Head, _request: dict[str, Any]) -> Answer:
        profile, device = head.profile, head.device
        truth = device.surroundings.truth.state(device.clock.now_ns() / NANOSECONDS)
        source = self._run.truth.source
        answer: Answer = {
            "mode": device.modes.mode.value,
            "error_cause": device.modes.error,
            "run_time_s": device.clock.now_ns() / NANOSECONDS,
            "unix_s": device.time.unix_ns() / NANOSECONDS,
            "seed": profile.run.seed,
            "clock": device.clock.name,
            "profile": profile.name,
            "algorithm": profile.run.algorithm,
            "frames": device.cycle.published,
            "frames_valid": device.frames_valid,
            "frames_left_out": device.cycle.skipped,
            "telecommands": device.counters.telecommands,
            "telemetry": device.counters.telemetry,
            "link_faults": {kind.value: count for kind, count in device.counters.faults.items()},
            "truth_kind": source.kind,
            "truth_status": truth.status.value,
            "faults": head.faults.describe(),
        }
        if len(self._run.heads) > 1:
            answer["heads"] = len(self._run.heads)
        if isinstance(source, LiveTruth):
            answer["feed"] = {
                "accepted": source.accepted,
                "refused": source.refused,
                "last_fault": source.last_fault,
                "speed": source.speed.ratio,
                "address": self._run.truth.address,
            }
        return answer

    async def _truth(self, head: Head, request: dict[str, Any]) -> Answer:
        device = head.device
        run_ns = device.clock.now_ns()
        if "run_time_s" in request:
            run_ns = round(_number(request, "run_time_s") * NANOSECONDS)
        elif "unix_s" in request:
            run_ns = device.time.run_ns(round(_number(request, "unix_s") * NANOSECONDS))
        state = device.surroundings.truth.state(run_ns / NANOSECONDS)
        return {
            "run_time_s": run_ns / NANOSECONDS,
            "unix_s": device.time.unix_ns(run_ns) / NANOSECONDS,
            "quaternion_xyzw": list(as_quaternion(state.attitude)),
            "ra_deg": state.attitude.ra_deg,
            "dec_deg": state.attitude.dec_deg,
            "roll_deg": state.attitude.roll_deg,
            "rate_deg_s": np.degrees(state.rate_rad_s).tolist(),
            "status": state.status.value,
        }

    async def _last_frames(self, head: Head, request: dict[str, Any]) -> Answer:
        count = int(_number(request, "count", 1.0))
        if not 1 <= count <= KEPT_FRAMES:
            raise EmulatorError(f"count: {count} is outside 1 … {KEPT_FRAMES}")
        return {"frames": [compare(measurement) for measurement in list(self._frames[head.number])[-count:]]}

    async def _set_truth(self, _head: Head, request: dict[str, Any]) -> Answer:
        config = self._run.truth.configured
        if "truth" in request:
            if not isinstance(request["truth"], dict):
                raise EmulatorError("truth: must be an object with the keys of [truth] in a profile")
            config = (await _parse(_Truth, request)).truth
        await self._read_files(lambda: self._run.truth.set(config))
        return {"kind": config.kind, "address": self._run.truth.address}

    async def _step(self, _head: Head, request: dict[str, Any]) -> Answer:
        clock, stepper = self._run.clock, self._run.stepper
        if stepper is None:
            raise EmulatorError(f"step: the clock is {clock.name}; run with --clock stepped")
        await stepper.step(_number(request, "seconds"))
        return {"run_time_s": clock.now_ns() / NANOSECONDS}

    async def _wait(self, head: Head, request: dict[str, Any]) -> Answer:
        clock = self._run.clock
        if ("seconds" in request) == ("phase" in request):
            raise EmulatorError("wait: give seconds or phase")
        if "phase" in request:
            await self._wait_for_phase(head, request)
        elif self._run.stepper is not None:
            raise EmulatorError("wait: time passes only by step on this clock; use step")
        else:
            until_ns = clock.running.now_ns() + round(_number(request, "seconds") * NANOSECONDS)
            while (left_ns := until_ns - clock.running.now_ns()) > 0:
                await asyncio.sleep(max(left_ns / NANOSECONDS / clock.speed, SHORTEST_WAIT_S))
            self._run.wiring.latch()
        return {"run_time_s": clock.now_ns() / NANOSECONDS}

    async def _wait_for_phase(self, head: Head, request: dict[str, Any]) -> None:
        """Wait for a phase of the next exposure; the stepped clock is advanced to it."""
        phase, within_s = request["phase"], _number(request, "within_s", PHASE_WITHIN_S)
        if phase not in (phases := get_args(Phase)):
            raise EmulatorError(
                f"phase: must be one of {', '.join(phases)}{did_you_mean(str(phase), phases)}"
            )
        reached = asyncio.Event()
        head.device.cycle.at_phase(phase, lambda _due_ns: reached.set())
        self._run.wiring.enter(AwaitedPhase, phase=phase)
        if self._run.stepper is not None:
            await self._run.stepper.step(within_s, reached.is_set)
        else:
            with suppress(TimeoutError):
                await asyncio.wait_for(reached.wait(), within_s / self._run.clock.speed)
        if not reached.is_set():
            mode = head.device.modes.mode.value
            raise EmulatorError(f"wait: no exposure has begun within {within_s:g} s (mode {mode})")

    async def _fault(self, head: Head, request: dict[str, Any]) -> Answer:
        fault = await _parse(FaultRequest, request)
        head.faults.check(fault)
        self._run.wiring.enter(NewFaults, request=fault)
        head.faults.inject(fault)
        return {"faults": head.faults.describe()}

    async def _clear_faults(self, head: Head, _request: dict[str, Any]) -> Answer:
        self._run.wiring.enter(ClearedFaults)
        head.faults.clear()
        return {"faults": head.faults.describe()}

    async def _run_scenario(self, head: Head, request: dict[str, Any]) -> Answer:
        if self._run.wiring.records:
            raise EmulatorError("scenario: a recorded run can only start with a scenario; use --scenario")
        name, start_s = str(request.get("name", "")), self._run.clock.now_ns() / NANOSECONDS

        async def read() -> list[tuple[int, SchedulerAction]]:
            scenario = await in_thread(load_scenario, name)
            return await in_thread(scenario.prepare, head, self._run.truth, start_s)

        events = await self._read_files(read)
        head.device.scheduler.add(events)
        return {"events": len(events)}

    async def _read_files(self, read: Callable[[], Awaitable[Result]]) -> Result:
        """Return what a request reads, for which an earlier one is given up: its file may be long, or never be read."""
        earlier = self._opening
        if earlier is not None:
            earlier.cancel()

        async def after_earlier() -> Result:
            if earlier is not None:
                await asyncio.wait([earlier])
            return await read()

        self._opening = task = asyncio.create_task(after_earlier())
        try:
            await asyncio.wait([task])
        finally:
            task.cancel()
            if self._opening is task:
                self._opening = None
        if task.cancelled():
            raise EmulatorError("a later set_truth or scenario has taken its place; the file was not read")
        return task.result()

    async def _quit_run(self, _head: Head, _request: dict[str, Any]) -> Answer:
        asyncio.get_running_loop().call_soon(self._quit)
        return {}


class _Truth(BaseModel):
    truth: TruthConfig


async def _parse(model: type[Model], value: object) -> Model:
    """Validate the arguments of a request in a thread, while the links are served; the error message is one line."""

    def parse() -> Model:
        try:
            return model.model_validate_json(json.dumps(value))
        except ValidationError as error:
            raise EmulatorError(*map(str, problems(error, model, value, most=EXAMINED_ERRORS))) from None

    return await in_thread(parse)


def _check_keys(request: dict[str, Any], known: tuple[str, ...]) -> None:
    for key in request:
        if key not in known:
            raise EmulatorError(f"unknown key {key!r}{remedy(key, known)}")


def _number(request: dict[str, Any], key: str, default: float | None = None) -> float:
    value = request.get(key, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < 1e12:
        raise EmulatorError(f"{key}: must be a number")
    return float(value)
