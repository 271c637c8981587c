"""The device: modes, parameters, time and frames; requests from links are handled in `requests`."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from functools import reduce
from types import MappingProxyType
from typing import Any, Final, TypeAlias

from starhil.emulator.device.clock_errors import ClockErrors, ClockFault
from starhil.emulator.device.counters import Acknowledge, Counters
from starhil.emulator.device.cycle import FrameCycle
from starhil.emulator.device.file_download import FileDownload
from starhil.emulator.device.images import ImageStore
from starhil.emulator.device.measurement import Measurement
from starhil.emulator.device.modes import Mode, Modes, Transition
from starhil.emulator.device.parameters import Parameters, ParameterValue
from starhil.emulator.device.pending import PendingAnswer
from starhil.emulator.device.power import PowerModel, ThermalModel
from starhil.emulator.device.reported import reported
from starhil.emulator.device.signals import Signals
from starhil.emulator.device.snapshot import Constants, Snapshot
from starhil.emulator.device.state_store import StateStore
from starhil.emulator.device.subscriptions import Subscriptions
from starhil.emulator.device.surroundings import Surroundings
from starhil.emulator.errors import EmulatorError, one_line
from starhil.emulator.profile import Profile
from starhil.emulator.sensor.pipeline.client import PipelineClient
from starhil.emulator.sensor.pipeline.messages import IDENTITY, Quaternion
from starhil.emulator.simulation.clock import Clock, DeviceTime
from starhil.emulator.simulation.guard import log_internal_error
from starhil.emulator.simulation.output_file import Output
from starhil.emulator.simulation.scheduler import Event, Scheduler
from starhil.emulator.truth.source import TruthSource
from starhil.protocol.errors import ProtocolError
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.codec import Field
from starhil.protocol.icd.conventions import NANOSECONDS
from starhil.protocol.icd.values import Value
from starhil.protocol.units_of_measure import factor

log = logging.getLogger("starhil.device")

Background: TypeAlias = Callable[[Callable[[], None], Callable[[EmulatorError | None], None]], None]
"""Runs slow work (the first argument), then calls the second argument with the error or None."""

PREDICTION_LIMIT_S: Final = 30.0
"""Maximum age of an attitude from which tracking can start, seconds (docs/rules.md, R14)."""

STALE_PERIODS: Final = 3
STALE_S: Final = 2.0
"""An attitude is valid for at most `STALE_PERIODS` update periods and `STALE_S` after its result (docs/rules.md, R15)."""

NOTHING_ACCEPTED: Final[Mapping[str, Mapping[str, Value]]] = MappingProxyType({})

PIPELINE_ENDED: Final = "pipeline_ended"
"""Name in `device_error` for a pipeline that has ended and is not restarted."""


def outcome(work: Callable[[], None]) -> EmulatorError | None:
    """Run some work and return the error that it raised, or None."""
    try:
        work()
    except EmulatorError as error:
        return error
    except Exception as error:  # noqa: BLE001 (the caller must learn of any error)
        log_internal_error("background", error)
        return EmulatorError(f"internal error: {one_line(error)}")
    return None


def run_at_once(work: Callable[[], None], done: Callable[[EmulatorError | None], None]) -> None:
    """Run the work in the foreground: on the stepped clock, nothing may depend on the speed of a disk."""
    done(outcome(work))


class Device:
    """A star sensor without its links."""

    def __init__(
        self,
        profile: Profile,
        icd: InterfaceDefinition,
        clock: Clock,
        imager: PipelineClient,
        store: StateStore,
        truth: TruthSource,
        background: Background = run_at_once,
    ) -> None:
        self.profile = profile
        self.icd = icd
        self.clock = clock
        self.store = store
        self.signals = signals = Signals()
        signals.frame_published.connect(self._frame_published, first=True)
        signals.mode_changed.connect(self._mode_changed, first=True)
        signals.parameters_changed.connect(self._parameters_changed, first=True)
        self.scheduler = Scheduler()
        try:
            defaults = profile_defaults(profile, icd)
            self.parameters = Parameters(icd, defaults, signals.parameters_changed.emit)
        except EmulatorError as error:
            raise EmulatorError(f"{profile.source_of(error)}: {error}") from None
        self.counters = Counters()
        self.acknowledge = Acknowledge()
        self.modes = Modes(signals.mode_changed.emit)
        self.power = PowerModel(profile.power)
        self.thermal = ThermalModel(profile.thermal)
        self.clock_errors = ClockErrors(profile.clock, self.thermal, profile.run.seed)
        self.time = DeviceTime(clock, gained_ns=self.clock_errors.gained_ns)
        self.surroundings = Surroundings(profile, truth, self.thermal, clock.now_ns)
        self.cycle = FrameCycle(
            profile,
            self.scheduler,
            imager,
            self.time,
            self.clock_errors,
            self.parameters,
            self.modes,
            self.surroundings,
            signals,
        )
        self.images = ImageStore(self.scheduler, imager, self.cycle, self.time, signals)
        self.files = FileDownload(self.images, clock.now_ns)
        self.subscriptions = Subscriptions(icd, self.scheduler, self.parameters, clock.now_ns, signals)
        self.stored = Output("state")
        """The writes to the store."""
        self.latest: Measurement | None = None
        self.last_quaternion: Quaternion = IDENTITY
        """Quaternion of the last valid frame, for the sign of the next one."""
        self.selected_parameter = next(iter(icd.parameters_by_id), 0)
        self.accepted: Mapping[str, Mapping[str, Value]] = NOTHING_ACCEPTED
        """Last accepted values of the telecommands that telemetry reports."""
        self.boot_count = 0
        self.reset_cause = "power_on"
        self.mode_changes = 0
        self.frames_valid = 0
        self.valid_in_a_row = 0
        """Number of frames with a valid attitude since the last invalid one."""
        self.started_ns = clock.now_ns()
        self.warm = False
        """Whether the pipeline is ready."""
        self.unresponsive = False
        """Whether the device is unresponsive: requests are neither counted nor answered."""
        self._constants = Constants(
            conventions=icd.conventions,
            identity=profile.device,
            health=MappingProxyType(dict(profile.health)),
            image_size=(profile.camera.width, profile.camera.height),
            power=self.power,
            rate_fields=rate_fields(icd),
        )
        self._background = background
        self._writing = False
        """Whether the state is being written."""
        self._unwritten: list[PendingAnswer[EmulatorError | None]] = []
        """Answers to requests since the begin of that write."""
        self._boot_end: Event | None = None
        self._stored_parameters: dict[str, object] = {}

    # --- power, boot and reset ---

    def power_on(self) -> None:
        """Load the stored state, count the start and boot."""
        self._start_up("power_on", self.store.load())

    def withdraw_start(self) -> None:
        """Do not count the last start: it failed because a port or file is not available."""
        self.boot_count = (self.boot_count - 1) & 0xFFFF
        self._persist()

    def reset(self, cause: str) -> None:
        """Restart with a cause named in the enumeration `reset_cause`."""
        self._start_up(cause, self._persistent_state())
        self.signals.restarted.emit(cause)

    def _start_up(self, cause: str, state: Mapping[str, object]) -> None:
        count, stored = state.get("boot_count"), state.get("parameters")
        self.boot_count = ((count if isinstance(count, int) else 0) + 1) & 0xFFFF
        self.reset_cause = cause
        self._stored_parameters = dict(stored) if isinstance(stored, dict) else {}
        self.cycle.reset()
        self.images.clear()
        self.files.clear()
        self.counters = Counters()
        self.acknowledge = Acknowledge()
        self.latest = None
        self.selected_parameter = next(iter(self.icd.parameters_by_id), 0)
        self.started_ns = self.clock.now_ns()
        self.time.start(round(self.profile.run.start_unix_s * NANOSECONDS))
        self.accepted = NOTHING_ACCEPTED
        self.modes.reset()
        self.mode_changes = self.frames_valid = self.valid_in_a_row = 0
        self.thermal.start(self.started_ns, self.power.mean_power_w(self.cycle.timing))
        for name in self.parameters.restore(self._stored_parameters):
            log.warning("stored parameter %s: unknown or out of its limits; using the default", name)
        self.signals.started.emit(cause)
        self._persist()
        if self.store.corrupt:
            log.warning("the stored state is corrupt and was renamed; using the defaults")
        if self._boot_end is not None:
            self._boot_end.cancel()
        boot_ns = round(self.profile.device.boot_s * NANOSECONDS)
        self._boot_end = self.scheduler.at(self.started_ns + boot_ns, self._boot_time_over)

    def pipeline_ready(self, camera_constants: dict[str, Value]) -> None:
        """Handle a ready pipeline; its camera constants become defaults."""
        self.warm = True
        self.cycle.pipeline_starts += 1
        adopt_camera(self.parameters, self.profile, camera_constants)
        if self._boot_end is None and self.modes.mode is Mode.BOOT:
            self._end_boot()

    def pipeline_lost(self) -> None:
        """Enter the error mode because the pipeline has ended; it can be left once the pipeline is ready."""
        self.warm = False
        self.modes.fail("processing")

    def pipeline_given_up(self) -> None:
        """Enter the error mode until a reset, because the pipeline is not restarted again."""
        self.modes.fail(PIPELINE_ENDED)

    def _boot_time_over(self, _due_ns: int) -> None:
        self._boot_end = None
        if self.warm:
            self._end_boot()

    def _end_boot(self) -> None:
        """Leave the boot mode for the start mode, unless a fault has already done so."""
        if self.modes.mode is not Mode.BOOT:
            return
        self.modes.booted()
        if self.parameters["start_mode"] == "lost_in_space":
            self.modes.command(Mode.LOST_IN_SPACE, has_attitude=False)

    def fail_clock(self, fault: ClockFault) -> None:
        """Let clock and latency have other errors from now on; those of the profile if the fault gives none."""
        self.time.rebase()
        self.clock_errors.fault = fault
        if not fault.stuck_second:
            self.time.stuck_s = None
        elif self.time.stuck_s is None:
            self.time.stuck_s = self.time.unix_ns() // NANOSECONDS
        self.time.offset_ns += round(fault.jump_s * NANOSECONDS)

    # --- persistent state ---

    def save_parameters(self) -> PendingAnswer[EmulatorError | None]:
        """Store all parameters; the result is None once they are on disk, or the error."""
        return self._store_parameters(dict(self.parameters))

    def forget_parameters(self) -> PendingAnswer[EmulatorError | None]:
        """Delete the stored parameters; current values apply until the next restart, then the defaults."""
        return self._store_parameters({})

    def _store_parameters(self, content: dict[str, ParameterValue]) -> PendingAnswer[EmulatorError | None]:
        before, stored = self._stored_parameters, dict[str, object](content)
        self._stored_parameters = stored

        def finish(error: EmulatorError | None) -> None:
            if error is None:
                self.parameters.mark_stored(content)
            elif self._stored_parameters is stored:  # no other save or restart has followed
                self._stored_parameters = before

        written = self._persist()
        written.when_done(finish)
        return written

    def write(self, work: Callable[[], None], done: Callable[[EmulatorError | None], None]) -> None:
        """Perform a write that may be slow, after those before it, and call `done` with its error or None in the event loop."""
        self._background(work, done)

    def restore_parameters(self) -> None:
        """Set all parameters to their stored values, or to their defaults if none are stored."""
        self.parameters.restore(self._stored_parameters)

    def upset_parameter(self, name: str, bit: int, *, stored: bool = False) -> None:
        """Flip a bit of a parameter in memory; enter the error mode if the result is invalid.

        A `stored` one is flipped where it is saved: it changes at the next restart, unless it is invalid and ignored then.
        """
        log.warning("bit %d of the %sparameter %s flipped", bit, "stored " if stored else "", name)
        if stored:
            flipped = self.parameters.flip_stored(name, bit)
            self._stored_parameters = {**self._stored_parameters, name: flipped}
            self._persist()
        elif not self.parameters.flip_bit(name, bit):
            self.modes.fail("parameter_store")

    def _persist(self) -> PendingAnswer[EmulatorError | None]:
        """Write the state to the store.

        Whoever asks during a write waits for the next one, which is the only one that waits: the bus can ask faster than
        a disk writes, and the end of the run waits for all writes.
        """
        written = PendingAnswer[EmulatorError | None]()
        written.when_done(lambda error: None if error is None else self.stored.fail(str(error)))
        self._unwritten.append(written)
        if not self._writing:
            self._write_state()
        return written

    def _write_state(self) -> None:
        content, waiting = self._persistent_state(), self._unwritten
        self._writing, self._unwritten = True, []

        def done(error: EmulatorError | None) -> None:
            self._writing = False
            for written in waiting:
                written.end(error)
            if self._unwritten and not self._writing:
                self._write_state()

        self.write(lambda: self.store.save(content), done)

    def _persistent_state(self) -> dict[str, object]:
        """Return the state that survives a restart, including writes in progress."""
        return {"boot_count": self.boot_count, "parameters": self._stored_parameters}

    # --- what is reported ---

    def snapshot(self) -> Snapshot:
        """Return the device at this moment: whatever a message contains comes from one snapshot."""
        now_ns = self.clock.now_ns()
        return Snapshot(
            constants=self._constants,
            now_ns=now_ns,
            uptime_ns=now_ns - self.started_ns,
            unix_ns=self.time.unix_ns(now_ns),
            clock_set=self.time.was_set,
            reset_cause=self.reset_cause,
            boot_count=self.boot_count,
            mode=self.modes.mode,
            error=self.modes.error,
            mode_changes=self.mode_changes,
            frame=self._fresh(now_ns),
            frames=self.cycle.published,
            frames_valid=self.frames_valid,
            valid_in_a_row=self.valid_in_a_row,
            last_quaternion=self.last_quaternion,
            timing=self.cycle.timing,
            thermal=self.thermal.state,
            parameters=self.parameters.state,
            selected=self.icd.parameters_by_id.get(self.selected_parameter),
            selected_id=self.selected_parameter,
            store_fault=self.store.corrupt,
            accepted=self.accepted,
            counters=self.counters,
            acknowledge=self.acknowledge,
            images=self.images.state,
            files=self.files.state,
        )

    # --- frames ---

    def _fresh(self, now_ns: int) -> Measurement | None:
        """Return the last measurement, or None if it is outdated or no images are taken in this mode."""
        last = self.latest
        if last is None or not self.modes.mode.makes_frames:
            return None
        limit_s = STALE_PERIODS * last.period_s + STALE_S
        age_ns = now_ns - last.published_ns
        return last if age_ns <= limit_s * NANOSECONDS else None

    def _frame_published(self, measurement: Measurement) -> None:
        self.latest = measurement
        self.frames_valid += measurement.valid
        self.valid_in_a_row = self.valid_in_a_row + 1 if measurement.valid else 0
        conventions = self.icd.conventions
        if measurement.valid and conventions.scalar_sign == "any":
            report = reported(
                measurement, self.modes.mode, self.parameters, conventions, self.last_quaternion
            )
            self.last_quaternion = report.quaternion_xyzw
        self.modes.solved(
            valid=measurement.valid,
            tracked=measurement.mode is Mode.TRACKING,
            tracking_enabled=bool(self.parameters["tracking_enable"]),
        )

    def _mode_changed(self, transition: Transition) -> None:
        log.info("mode %s -> %s (%s)", transition.before, transition.after, transition.cause)
        self.mode_changes = (self.mode_changes + (transition.before is not transition.after)) & 0xFF
        if transition.after.makes_frames:
            self.cycle.start()
        else:
            self.cycle.stop()
            self.images.cycle_stopped()
            self.latest = None
        self._power_changed()

    def command_mode(self, mode: Mode) -> bool:
        """Change the mode by telecommand; return False if this is refused."""
        if self.modes.mode is Mode.ERROR and not self.warm:
            return False
        return self.modes.command(mode, has_attitude=self.cycle.has_fix(PREDICTION_LIMIT_S))

    # --- parameters ---

    def _parameters_changed(self, names: frozenset[str]) -> None:
        if names & {"update_rate", "exposure", "delay_time"}:
            self.cycle.retime()
            self._power_changed()

    def _power_changed(self) -> None:
        self.time.rebase()
        self.thermal.set_power(self.clock.now_ns(), self.power.mean_power_w(self.cycle.timing))


def rate_fields(icd: InterfaceDefinition) -> tuple[tuple[Field, int, float], ...]:
    """Return the integer fields that report a body rate, whose range it may exceed: field, axis, factor."""
    axes = {"rate.x": 0, "rate.y": 1, "rate.z": 2}
    return tuple(
        (field, axes[str(field.value)], factor("rad/s", field.unit) or 1.0)
        for row in icd.telemetry.values()
        for field in row.named_fields.values()
        if field.value in axes and field.kind == "integer"
    )


def constants_to_adopt(
    parameters: Parameters, profile: Profile, constants: Mapping[str, Value]
) -> dict[str, Value]:
    """Return the camera constants that `adopt_camera` will make values of parameters."""
    defaults = parameters.state.defaults
    return {
        name: value
        for name, value in constants.items()
        if name not in profile.parameters and parameters[name] == defaults[name]
    }


def adopt_camera(parameters: Parameters, profile: Profile, constants: Mapping[str, Value]) -> None:
    """Make camera constants the defaults, except those that the profile sets: a device may be miscalibrated on purpose."""
    parameters.adopt_defaults({k: v for k, v in constants.items() if k not in profile.parameters})


def profile_defaults(profile: Profile, icd: InterfaceDefinition) -> dict[str, Value]:
    """Return the parameter defaults of a profile: its `[parameters]`, and settings in its `[links]`."""
    of_links: dict[str, Any] = {
        name: reduce(getattr, item.profile_key.split("."), profile)
        for name, item in icd.device_parameters.items()
        if item.profile_key
    }
    unit_serial = icd.link.serial
    if unit_serial is not None and "baud" not in profile.links.serial.model_fields_set:
        of_links["serial_baud"] = unit_serial.baud
    if not profile.links.canopen.node:
        del of_links["canopen_node"]
    try:
        for name in profile.parameters:
            icd.device_parameters[name]
    except ProtocolError as error:
        raise EmulatorError(f"parameters: {error}") from None
    return {**profile.parameters, **of_links}
