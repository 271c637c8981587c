"""The device: modes, parameters, time and frames, and the one door through which requests from any link come in."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import Final, TypeAlias

from starhil.emulator.clock import NANOSECONDS, Clock, DeviceTime
from starhil.emulator.device.counters import Acknowledge, Counters
from starhil.emulator.device.cycle import FrameCycle, Measurement
from starhil.emulator.device.file_download import FileDownload
from starhil.emulator.device.images import ImageStore
from starhil.emulator.device.modes import Mode, Modes, Transition
from starhil.emulator.device.parameters import Parameters, ParameterValue
from starhil.emulator.device.refusal import Refused
from starhil.emulator.device.scheduler import Event, Scheduler
from starhil.emulator.device.state_store import StateStore
from starhil.emulator.device.telecommands import ANSWERED_WHEN_DONE, TELECOMMANDS
from starhil.emulator.device.telemetry import TELEMETRY
from starhil.emulator.errors import EmulatorError
from starhil.emulator.guard import call_guarded, one_line
from starhil.emulator.pipeline.imager import Imager
from starhil.emulator.pipeline.messages import FrameRequest
from starhil.emulator.profile import LINK_PARAMETERS, Profile
from starhil.emulator.truth.source import TruthSource
from starhil.protocol.errors import ProtocolError
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.messages import ErrorCode, LinkFault, Reply, ReplyKind, Request, RequestKind
from starhil.protocol.values import MessageError, Value

log = logging.getLogger("starhil.device")

Background: TypeAlias = Callable[[Callable[[], None], Callable[[EmulatorError | None], None]], None]
"""Does slow work (the first argument) somewhere and then calls back with what it raised, or None."""

PREDICTION_LIMIT_S: Final = 30.0
"""Age of an attitude up to which tracking can be commanded from it, seconds."""

STALE_PERIODS: Final = 3
"""Update periods without a publication after which the last attitude no longer counts as valid."""

PROCESSING_ALLOWANCE_S: Final = 2.0

PIPELINE_ENDED: Final = "pipeline_ended"
"""Error of a device whose pipeline has ended and is not started again, a name of the enumeration `device_error`."""


def outcome(work: Callable[[], None]) -> EmulatorError | None:
    """Do some work and return what went wrong, whatever it was, or None."""
    try:
        work()
    except EmulatorError as error:
        return error
    except Exception as error:  # noqa: BLE001 (whoever waits for the work has to hear of its end)
        log.error("background: internal error: %s", one_line(error))  # noqa: TRY400 (one line)
        return EmulatorError(f"internal error: {one_line(error)}")
    return None


def do_at_once(work: Callable[[], None], done: Callable[[EmulatorError | None], None]) -> None:
    """Background that is none: for the stepped clock, where nothing may depend on how fast a disk is."""
    done(outcome(work))


class Device:
    """A star sensor without its links.

    Parameters
    ----------
    profile
        What it is.
    icd
        Rows that it serves; each has a handler by its name.
    clock
        Run time.
    imager
        Where frames are made and solved.
    store
        What survives a restart.
    truth
        Where it looks.
    background
        Where slow writes are done.

    Raises
    ------
    EmulatorError
        The profile's parameters are not allowed, or the definition has a row without a handler.
    """

    def __init__(
        self,
        profile: Profile,
        icd: InterfaceDefinition,
        clock: Clock,
        imager: Imager,
        store: StateStore,
        truth: TruthSource,
        background: Background = do_at_once,
    ) -> None:
        self.profile = profile
        self.icd = icd
        self.clock = clock
        self.scheduler = Scheduler()
        self.time = DeviceTime(clock)
        try:
            self.parameters = Parameters(icd, profile_defaults(profile, icd))
        except EmulatorError as error:
            raise EmulatorError(f"profile {profile.source}: {error}") from None
        self.counters = Counters()
        self.acknowledge = Acknowledge()
        self.modes = Modes(self._mode_changed)
        self.store = store
        self.cycle = FrameCycle(
            self.scheduler,
            imager,
            self.parameters,
            profile.timing,
            self.time,
            self._published,
            profile.device.rate_window,
        )
        self.cycle.truth = truth
        self.cycle.mode = lambda: self.modes.mode
        self.images = ImageStore(
            self.scheduler,
            imager,
            self.cycle,
            clock.now_ns,
            self._single_frame,
            lambda: float(self.parameters["exposure"]) / 1000.0,
        )
        self.files = FileDownload(self.images)
        self.latest: Measurement | None = None
        self.selected_parameter = next(iter(icd.parameters_by_id))
        self.boot_count = 0
        self.reset_cause = "power_on"
        self.mode_changes = 0
        self.frames_valid = 0
        self.started_ns = clock.now_ns()
        self.warm = False
        """The pipeline has told that it is ready."""
        self.outlets: list[Callable[[Reply], None]] = []
        """Links that take what the device sends by itself."""
        self.on_frame: list[Callable[[Measurement], None]] = []
        self.on_mode: list[Callable[[Transition], None]] = []
        self.on_reset: list[Callable[[], None]] = []
        self.deaf = False
        """A fault: requests are neither taken nor answered."""
        self._background = background
        self._boot_over: Event | None = None
        self._unsolicited: Event | None = None
        self._stored_parameters: dict[str, object] = {}
        self.parameters.observe(self._parameters_changed)
        missing = missing_handlers(icd)
        if missing:
            raise EmulatorError(
                f"interface definition {icd.name}: the device has no handler for {missing[0]}"
            )

    # --- power, boot and reset ---

    def power_on(self) -> None:
        """Start: load what is stored, count the start, boot."""
        self._start("power_on", self.store.load())

    def start_refused(self) -> None:
        """Take back the count of a start that came to nothing, as a port or a file could not be had."""
        self.boot_count = (self.boot_count - 1) & 0xFFFF
        self._persist(lambda error: log.error("%s", error) if error else None)

    def reset(self, cause: str) -> None:
        """Restart, for a cause by its name in the interface definition."""
        self._start(cause, self._content())
        for observer in self.on_reset:
            call_guarded("reset", observer)

    def _start(self, cause: str, state: Mapping[str, object]) -> None:
        count, stored = state.get("boot_count"), state.get("parameters")
        self.boot_count = ((count if isinstance(count, int) else 0) + 1) & 0xFFFF
        self.reset_cause = cause
        self._stored_parameters = dict(stored) if isinstance(stored, dict) else {}
        self.cycle.reset()
        self.images.clear()
        self.files.clear()
        self.counters.clear()
        self.acknowledge = Acknowledge()
        self.latest = None
        self.selected_parameter = next(iter(self.icd.parameters_by_id))
        self.started_ns = self.clock.now_ns()
        self.time.offset_ns = round(self.profile.run.start_unix_s * NANOSECONDS) - self.started_ns
        self.time.was_set = False
        self.modes.reset()
        self.mode_changes = self.frames_valid = 0
        for name in self.parameters.restore(self._stored_parameters):
            log.warning("stored parameter %s: unknown or out of its limits; its default is used", name)
        self._plan_unsolicited()
        self._persist(lambda error: log.error("%s", error) if error else None)
        if self.store.corrupt:
            log.warning("the stored state was not whole: it is set aside, defaults are used")
        if self._boot_over is not None:
            self._boot_over.cancel()
        boot_ns = round(self.profile.device.boot_s * NANOSECONDS)
        self._boot_over = self.scheduler.at(self.started_ns + boot_ns, self._boot_ends)

    def pipeline_ready(self, camera_constants: dict[str, Value]) -> None:
        """Take note that frames can be made; the camera's constants become defaults where the profile gives none."""
        self.warm = True
        own = self.profile.parameters  # a device may hold another idea of its camera than what the camera is
        self.parameters.adopt_defaults({k: v for k, v in camera_constants.items() if k not in own})
        if self._boot_over is None and self.modes.mode is Mode.BOOT:
            self._end_boot()

    def pipeline_lost(self) -> None:
        """Take note that the pipeline has ended: the error mode, until it is back and a mode is commanded."""
        self.warm = False
        self.modes.fail("processing")

    def pipeline_given_up(self) -> None:
        """Take note that the pipeline does not come back by itself: the error mode, until a reset."""
        self.modes.fail(PIPELINE_ENDED)

    def _boot_ends(self, _due_ns: int) -> None:
        self._boot_over = None
        if self.warm:
            self._end_boot()

    def _end_boot(self) -> None:
        self.modes.booted()
        if self.parameters["start_mode"] == "lost_in_space" and self.modes.mode is Mode.STANDBY:
            self.modes.command(Mode.LOST_IN_SPACE, has_attitude=False)

    # --- state that survives ---

    def save_parameters(self, done: Callable[[EmulatorError | None], None]) -> None:
        """Store all parameters; `done` is called when they are on the disk, or with what went wrong."""
        self._store_parameters(dict(self.parameters), done)

    def forget_parameters(self, done: Callable[[EmulatorError | None], None]) -> None:
        """Store none: present values stay, and the defaults hold from the next restart on."""
        self._store_parameters({}, done)

    def _store_parameters(
        self, content: dict[str, ParameterValue], done: Callable[[EmulatorError | None], None]
    ) -> None:
        before, stored = self._stored_parameters, dict[str, object](content)
        self._stored_parameters = stored

        def finish(error: EmulatorError | None) -> None:
            if error is None:
                self.parameters.mark_stored(content)
            else:
                log.error("%s", error)
                if self._stored_parameters is stored:  # neither another save nor a restart has followed
                    self._stored_parameters = before
            done(error)

        self._persist(finish)

    def restore_parameters(self) -> None:
        """Set all parameters to what is stored, or to their defaults where nothing is."""
        self.parameters.restore(self._stored_parameters)

    def _persist(self, done: Callable[[EmulatorError | None], None]) -> None:
        content = self._content()
        self._background(lambda: self.store.save(content), done)

    def _content(self) -> dict[str, object]:
        """What the store holds when all that is being saved has been: what a restart begins with."""
        return {"boot_count": self.boot_count, "parameters": self._stored_parameters}

    # --- frames ---

    @property
    def fresh(self) -> Measurement | None:
        """The last measurement if the device is at work and it is not out of date, else None."""
        last = self.latest
        if last is None or not self.modes.mode.makes_frames:
            return None
        limit_s = STALE_PERIODS * last.period_s + PROCESSING_ALLOWANCE_S
        age_ns = self.clock.now_ns() - last.published_ns
        return last if age_ns <= limit_s * NANOSECONDS else None

    def _single_frame(self, mid_ns: int) -> FrameRequest:
        truth = self.cycle.truth.state(mid_ns / NANOSECONDS)
        exposure_s = float(self.parameters["exposure"]) / 1000.0
        return self.cycle.request(truth, exposure_s, None, solve=False)

    def _published(self, measurement: Measurement) -> None:
        self.latest = measurement
        self.frames_valid += measurement.valid
        self.modes.solved(
            valid=measurement.valid,
            tracked=measurement.mode is Mode.TRACKING,
            tracking_enabled=bool(self.parameters["tracking_enable"]),
        )
        for observer in self.on_frame:
            call_guarded("frame", observer, measurement)

    def _mode_changed(self, transition: Transition) -> None:
        log.info("mode %s -> %s (%s)", transition.before, transition.after, transition.cause)
        self.mode_changes = (self.mode_changes + (transition.before is not transition.after)) & 0xFF
        if transition.after.makes_frames:
            self.cycle.start()
        else:
            self.cycle.stop()
            self.images.cycle_stopped()
            self.latest = None
        for observer in self.on_mode:
            call_guarded("mode", observer, transition)

    def command_mode(self, wanted: Mode) -> bool:
        """Command a mode; False if it is refused."""
        if self.modes.mode is Mode.ERROR and not self.warm:
            return False
        return self.modes.command(wanted, has_attitude=self.cycle.has_fix(PREDICTION_LIMIT_S))

    # --- parameters ---

    def _parameters_changed(self, names: frozenset[str]) -> None:
        if names & {"update_rate", "exposure", "delay_time"}:
            self.cycle.retime()
        if names & {"unsolicited_rate", "unsolicited_selection"}:
            self._plan_unsolicited()

    def _plan_unsolicited(self) -> None:
        if self._unsolicited is not None:
            self._unsolicited.cancel()
            self._unsolicited = None
        rate = float(self.parameters["unsolicited_rate"])
        if rate > 0.0:
            self._unsolicited = self.scheduler.at(self.clock.now_ns(), self._send_unsolicited)

    def _send_unsolicited(self, due_ns: int) -> None:
        period_ns = max(1, round(NANOSECONDS / float(self.parameters["unsolicited_rate"])))
        missed = max(0, (self.clock.now_ns() - due_ns) // period_ns)
        self._unsolicited = self.scheduler.at(due_ns + (missed + 1) * period_ns, self._send_unsolicited)
        row = self.icd.telemetry_by_id.get(int(self.parameters["unsolicited_selection"]))
        if row is None or self.deaf:
            return
        try:
            data = self.telemetry(row.name)
        except Refused:  # an image is being opened: nothing to tell this time
            return
        destination = int(self.parameters["host_address"])
        reply = Reply(ReplyKind.UNSOLICITED, row.id, data, destination=destination)
        for outlet in self.outlets:
            call_guarded("unsolicited telemetry", outlet, reply)

    # --- requests ---

    def handle(self, request: Request, later: Callable[[Reply], None] | None = None) -> list[Reply] | None:
        """Take a request from a link; return what goes back over the same link, in order.

        Parameters
        ----------
        request
            What arrived.
        later
            Takes the answer to a telecommand that is answered only when it is done; None is returned then.
        """
        if self.deaf:
            return []
        if request.kind is RequestKind.TELEMETRY:
            self.counters.telemetry = (self.counters.telemetry + 1) & 0xFFFF
            return [self._answer_telemetry(request)]
        self.counters.telecommands = (self.counters.telecommands + 1) & 0xFFFF
        code, replies = self._execute(request)
        if code is None:
            if later is not None:
                self.acknowledge.on_end = lambda code: later(_answer(request, code))
            return None
        return [_answer(request, code), *replies]

    def fault(self, fault: LinkFault) -> None:
        """Count input on a link that made no request."""
        if not self.deaf:
            log.debug("%s: %s", fault.kind.value, fault.detail)
            self.counters.fault(fault)

    def telemetry(self, name: str) -> bytes:
        """Return the data of a telemetry row."""
        return self.icd.telemetry[name].encode(TELEMETRY[name](self), saturate=True)

    def telemetry_values(self, name: str) -> dict[str, Value]:
        """Return a telemetry row in physical units, as it stands before encoding."""
        return TELEMETRY[name](self)

    def telecommand(self, name: str, values: dict[str, Value]) -> tuple[ErrorCode, int]:
        """Do a telecommand whose values are checked; return its error code so far and the field it is about."""
        code, index, _ = self._do(name, values, 0)
        return code or ErrorCode.OK, index

    def _answer_telemetry(self, request: Request) -> Reply:
        row = self.icd.telemetry_by_id.get(request.id)
        code = ErrorCode.OK
        if row is None:
            code = ErrorCode.INVALID_ID
        elif request.data:
            code = ErrorCode.INVALID_LENGTH
        if row is None or code is not ErrorCode.OK:
            return Reply(ReplyKind.NACK, request.id, code=code, destination=request.source)
        try:
            data = self.telemetry(row.name)
        except Refused as refused:
            return Reply(ReplyKind.NACK, request.id, code=refused.code, destination=request.source)
        return Reply(ReplyKind.TELEMETRY, request.id, data, destination=request.source)

    def _execute(self, request: Request) -> tuple[ErrorCode | None, list[Reply]]:
        row = self.icd.telecommands_by_id.get(request.id)
        if row is None:
            self._note(request.id, ErrorCode.INVALID_ID, 0)
            return ErrorCode.INVALID_ID, []
        try:
            values = row.decode(request.data)
        except MessageError as error:
            self._note(request.id, error.code, error.index)
            return error.code, []
        code, _, replies = self._do(row.name, values, request.source)
        return code, replies

    def _do(
        self, name: str, values: dict[str, Value], source: int
    ) -> tuple[ErrorCode | None, int, list[Reply]]:
        """Do a decoded telecommand, and note in the acknowledge what became of it; no code where that is still open."""
        if not self.acknowledge.processed:
            self.counters.overrun()
        acknowledge = Acknowledge(self.icd.telecommands[name].id, processed=False)
        self.acknowledge = acknowledge
        try:
            replies = TELECOMMANDS[name](self, values, acknowledge)
        except Refused as refused:
            acknowledge.end(refused.code, refused.index)
            return refused.code, refused.index, []
        except MessageError as error:
            acknowledge.end(error.code, error.index)
            return error.code, error.index, []
        if replies is None:  # the handler ends the acknowledge
            if name not in ANSWERED_WHEN_DONE:
                return ErrorCode.OK, 0, []
            return acknowledge.error if acknowledge.processed else None, 0, []
        acknowledge.end()
        return (
            ErrorCode.OK,
            0,
            [Reply(reply.kind, reply.id, reply.data, reply.code, destination=source) for reply in replies],
        )

    def _note(self, identifier: int, code: ErrorCode, index: int) -> None:
        if not self.acknowledge.processed:
            self.counters.overrun()
        self.acknowledge = Acknowledge(identifier, processed=True, error=code, parameter_index=index)


def _answer(request: Request, code: ErrorCode) -> Reply:
    kind = ReplyKind.ACK if code is ErrorCode.OK else ReplyKind.NACK
    return Reply(kind, request.id, code=code, destination=request.source)


def missing_handlers(icd: InterfaceDefinition) -> list[str]:
    """Names of the rows of a definition that the device has no handler for."""
    return sorted((set(icd.telemetry) - set(TELEMETRY)) | (set(icd.telecommands) - set(TELECOMMANDS)))


def profile_defaults(profile: Profile, icd: InterfaceDefinition) -> dict[str, Value]:
    """Defaults of the parameters in a profile: its own table, and what its links section says.

    Raises
    ------
    EmulatorError
        The table names a parameter that there is none of.
    """
    links = profile.links
    of_links: dict[str, Value] = {
        "serial_dialect": links.serial.dialect,
        "serial_baud": links.serial.baud,
        "can_address": links.can.address,
        "host_address": links.can.host_address,
    }
    if links.canopen.node:
        of_links["canopen_node"] = links.canopen.node
    known = {
        name: value for name, value in of_links.items() if name in icd.parameters and name in LINK_PARAMETERS
    }
    try:
        for name in profile.parameters:
            icd.parameters[name]
    except ProtocolError as error:
        raise EmulatorError(f"parameters: {error}") from None
    return {**profile.parameters, **known}
