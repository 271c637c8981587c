"""The oracle: what a unit may and must do, judged from its definition and its bus alone.

It keeps its own model of the unit - parameters in use and stored, mode, clock, counters, faults - and updates it by
what was sent and answered. What it cannot know (an answer lost on a faulty link, a parameter that a plugin may have
changed) is None, and is learned from the next reading. A `Violation` is raised for the first thing that a unit
must never do.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, Final

from starhil.hil_tests.endurance.attitude_judge import AttitudeJudge, Motion, Readings
from starhil.hil_tests.endurance.violation import Known, Violation
from starhil.hil_tests.judge.definition import Unit
from starhil.hil_tests.judge.links import LINKS
from starhil.hil_tests.judge.messages import Request, Value
from starhil.hil_tests.judge.rows import PARAMETER, Field, Row
from starhil.protocol.units_of_measure import factor

BOOT_S: Final = 0.6
"""Longest boot of the profile of a run."""
PIPELINE_RESTARTS_S: Final = (0.5, 1.0, 2.0, 4.0, 8.0)
"""Pauses before restarts of an image pipeline that ends again within `STEADY_S` (docs/sensor.md)."""
STEADY_S: Final = 60.0
RESTART_LATE_S: Final = 0.2
"""Longest delay of a restart that is due."""
RECOVERY_S: Final = 15.0
"""Longest time from the end of the last fault to a valid attitude, with default parameters."""
IMAGING: Final = frozenset({"lost_in_space", "tracking"})
START_PARAMETERS: Final = frozenset({"canopen_node"})
"""Parameters of which a new value takes effect at the next start of the unit; all others do at once."""
SECOND_NS: Final = 1_000_000_000
FLOAT_GRAIN: Final = {"f32": 1.2e-7, "f64": 4.5e-16}
"""Relative resolution of a float, twice, by type."""


class Oracle:
    """A model of a unit that is updated by what happens on its bus.

    `parameters` are the defaults of the profile, `start_unix_s` the device clock at each start, and `sigma_arcsec` the largest
    standard deviations across and about the boresight that the unit may leave unstated.
    """

    def __init__(
        self,
        definition: Unit,
        parameters: Mapping[str, Value],
        start_unix_s: float,
        sigma_arcsec: tuple[float, float],
    ) -> None:
        self._definition = definition
        self._start_unix_ns = round(start_unix_s * SECOND_NS)
        calibrated = {"focal_length", "centroid_x", "centroid_y", "k1", "k2", "p1", "p2"}
        self._defaults: dict[str, Known | None] = {
            name: None if name in calibrated else (parameter.default, 1e-9)
            for name, parameter in definition.device_parameters.items()
        }
        self._defaults.update({name: (value, 1e-9) for name, value in parameters.items()})
        self._stored: dict[str, Known | None] = {}
        self.values: dict[str, Known | None] = dict(self._defaults)
        self.modes: set[str] = {"boot"}
        self.counts: dict[str, int | None] = {}
        self._boot_count: int | None = None
        self.attitudes: Final = AttitudeJudge(definition.conventions, self.values, sigma_arcsec)
        self.disk_full = False
        self.stuck = False
        self.disturbed: set[str] = set()
        """Links on which answers may be lost, late or damaged."""
        self.bursts = False
        """Whether packets of a file may arrive."""
        self.now_s = 0.0
        self._pipeline_ready_s = 0.0
        """Time at which the image pipeline is restarted after its last end."""
        self._pipeline_ends = 0
        self._drift_ppm = 0.0
        self._content: dict[str, Mapping[str, Any]] = {}
        """Fault of the content of a telemetry row, by its name."""
        self._frozen: dict[str, bytes] = {}
        """What a row that is frozen must report."""
        self._frames: int | None = None
        self._selected: int | None = None
        self._last: tuple[int, str] | None = None
        self._checks: dict[str, Callable[[str, Field, Value], None]] = {
            "mode": self._check_mode,
            "error.active": self._check_in_error,
            "frame.counter": self._check_frames,
            "frame.period": lambda where, field, value: self.attitudes.check_period(
                where, field, value, self.now_s
            ),
            "request.error": self._check_error,
            **{name: partial(self._check_fraction, name) for name in _FRACTIONS},
        }
        self.restarted(0.0)

    # --- what happens to the unit ---

    def powered(self, *, factory: bool, motion: Motion) -> None:
        """Power was switched off and on; simulation time begins again with a motion of the sensor."""
        if factory:
            self._stored, self._boot_count = {}, 0
        self.now_s = 0.0
        self._pipeline_ready_s, self._pipeline_ends = 0.0, 0
        self.stuck = False
        self._drift_ppm = 0.0
        self.content_failed(())
        self.disturbed.clear()
        self.attitudes.dark_since_s = None
        self.attitudes.motions = [motion]
        self.restarted(0.0)

    def restarted(self, at_s: float) -> None:
        """The unit has started at a time: at power-on, or by a restart of its own."""
        self._started_s: float | None = at_s
        self.values.update({**self._defaults, **self._stored})
        self._at_start = {name: self.values[name] for name in START_PARAMETERS}
        self.modes = {"boot"}
        self.counts = {"telecommands": 0, "telemetry": 0}
        self._is_counted = not self.disk_full
        if self._boot_count is not None:
            self._boot_count = (self._boot_count + 1) & 0xFFFF if self._is_counted else None
        self._clock: tuple[float, int] | None = (at_s, self._start_unix_ns)
        self._has_imaged = False
        self._frames = None
        self._selected = next(iter(self._definition.parameters_by_id), None)
        self._last = None
        self.bursts = False
        self._subscribed: frozenset[tuple[str | None, int]] | None = frozenset()
        """Class, if it is given, and ID of the rows of the last subscription; None if it is not known."""
        self.attitudes.started(at_s)

    def time_passed(self, now_s: float) -> None:
        self.now_s = now_s
        if "boot" in self.modes:
            start = self.values.get("start_mode")
            if start is None or start[0] != "lost_in_space":
                self.modes.add("standby")
            if start is None or start[0] == "lost_in_space":
                self.modes |= IMAGING
            booted = self._started_s is not None and now_s - self._started_s > BOOT_S
            if booted and (not self._pipeline_ends or now_s > self._pipeline_ready_s + RESTART_LATE_S):
                self.modes.discard("boot")
        self._has_imaged = self._has_imaged or bool(self.modes & IMAGING)

    def moved(self, motion: Motion) -> None:
        """The truth has been replaced."""
        self.attitudes.motions.append(motion)

    def failed(self) -> None:
        """The unit must now be in the error mode, because of a fault or because its image pipeline has ended."""
        self.modes = {"error"}

    def pipeline_ended(self) -> None:
        """The image pipeline has ended unexpectedly; a boot lasts until it has been restarted."""
        self.failed()
        if self._pipeline_ends and self.now_s < self._pipeline_ready_s:
            return  # it is being restarted
        if self.now_s - self._pipeline_ready_s > STEADY_S:
            self._pipeline_ends = 0
        pause_s = PIPELINE_RESTARTS_S[min(self._pipeline_ends, len(PIPELINE_RESTARTS_S) - 1)]
        self._pipeline_ready_s = self.now_s + pause_s
        self._pipeline_ends += 1

    def fault_injected(self, fault: Mapping[str, Any], links: Iterable[str], now_s: float) -> None:
        """A fault, as on the control channel, has been injected into the unit, which has these links."""
        if "optical" in fault:
            self.covered(fully=fault["optical"].get("blocked_share") == 1.0)
        self.disturbed |= {link for link in links if LINKS[link].bus in fault}
        self.time_passed(now_s)
        if "telemetry" in fault:
            self.content_failed(fault["telemetry"])
        if "clock" in fault:
            self.clock_failed(fault["clock"].get("drift_ppm", 0.0), fault["clock"].get("jump_s", 0.0))
        device = fault.get("device", {})
        self.stuck = bool(device.get("stuck", False)) if device else self.stuck
        if "reset" in device:
            self.restarted(now_s)
        if "error" in device:
            self.failed()

    def faults_ended(self, now_s: float) -> None:
        """All faults have been ended; what they have disturbed may still arrive."""
        self.time_passed(now_s)
        self.content_failed(())
        self.clock_failed(0.0)
        self.covered(fully=False)
        self.stuck = False

    def content_failed(self, faults: Sequence[Mapping[str, Any]]) -> None:
        """The content of telemetry is wrong in these ways from now on, and in no other."""
        self._content = {fault["row"]: fault for fault in faults if "row" in fault}
        self._frozen = {}
        turns = [fault["turn_deg"] for fault in faults if "turn_deg" in fault]
        x, y, z = (math.radians(angle) for angle in (turns[0] if turns else (0.0, 0.0, 0.0)))
        self.attitudes.turned_rad = (x, y, z)

    def clock_failed(self, drift_ppm: float, jump_s: float = 0.0) -> None:
        """The clock drifts by this much from now on, and has jumped."""
        if self._clock is not None:
            unix_ns = self._clock[1] + self._elapsed_ns(self._clock[0]) + round(jump_s * SECOND_NS)
            self._clock = (self.now_s, unix_ns)
        self._drift_ppm = drift_ppm

    def covered(self, *, fully: bool) -> None:
        """The lens has been covered, or is no longer fully covered."""
        if not fully:
            self.attitudes.dark_since_s = None
        elif self.attitudes.dark_since_s is None:
            self.attitudes.dark_since_s = self.now_s

    def forget(self) -> None:
        """Parameters and counters are unknown from now on, because a request had an unknown outcome."""
        self.values.update(dict.fromkeys(self.values))
        self._at_start = dict.fromkeys(START_PARAMETERS)
        self._stored = dict.fromkeys(self.values)
        self.counts = dict.fromkeys(self.counts)
        self._clock = self._boot_count = self._selected = self._last = self._started_s = None
        self.modes = set(self._definition.modes)
        self.bursts = True
        self._subscribed = None
        self.attitudes.retimed(self.now_s)

    def in_use(self, name: str) -> Value | None:
        """Return the value of a parameter that the unit works with, None if it is not known."""
        known = (self._at_start if name in START_PARAMETERS else self.values)[name]
        return None if known is None else known[0]

    # --- requests ---

    def verdict(self, row: Row | None, request: Request) -> str | None:
        """Return "ok" if a request must be accepted, the error with which it must be refused, or None: either."""
        data = request.data
        if row is None or row.only_sent:
            return "invalid_id"
        if request.telemetry:
            return "invalid_length" if data else None if row.carries_files else "ok"
        if not row.has_length(data):
            return "invalid_length"
        if self.is_outside(row, data):
            return "invalid_parameter"
        arguments = self._arguments(row, data)
        match row.action:
            case "set_mode":
                return self._mode_verdict(str(arguments.get("mode")))
            case "set_parameter":
                return self._parameter_verdict(arguments)
            case "select_parameter":
                known = int(float(arguments["parameter"])) in self._definition.parameters_by_id
                return "ok" if known else "invalid_parameter"
            case "save_parameters":
                return "internal" if self.disk_full else "ok"
            case "set_parameters" if any(field.parameter in _BOUND for field in row.named.values()):
                return None
            case None | "nothing" | "reset" | "set_clock" | "clear_counters":
                return "ok"
            case "restore_parameters" | "default_parameters" | "set_parameters":
                return "ok"
            case _:
                return None

    def is_outside(self, row: Row, data: bytes) -> bool:
        """Return whether a value of a telecommand is outside its limits."""
        return any(field.fault(field.read(data)) for field in row.carried(data))

    def _mode_verdict(self, commanded: str) -> str | None:
        running = set(self._definition.modes) - {"boot", "error"}
        votes = {commanded in _COMMANDABLE_MODES.get(mode, running) for mode in self.modes}
        if votes == {False} or (commanded == "tracking" and not self._has_imaged):
            return "sequence"
        certain = votes == {True} and commanded != "tracking" and "error" not in self.modes
        return "ok" if certain else None

    def _parameter_verdict(self, arguments: Mapping[str, Any]) -> str | None:
        parameter = self._definition.parameters_by_id.get(int(arguments["parameter"]))
        if parameter is None or parameter.value_of(arguments["value"]) is None:
            return "invalid_parameter"
        return None if parameter.name in _BOUND else "ok"

    def counted(self, request: Request) -> None:
        name = "telemetry" if request.telemetry else "telecommands"
        count = self.counts[name]
        self.counts[name] = None if count is None else (count + 1) & 0xFFFF

    def executed(self, row: Row | None, request: Request, code: str, *, sure: bool) -> None:
        """A telecommand was answered with a code, which is the one expected or not for sure."""
        self._last = (request.id, code) if sure else None
        if row is not None and code == "ok":
            self._take_effect(row, self._arguments(row, request.data))

    def _take_effect(self, row: Row, arguments: Mapping[str, Any]) -> None:
        match row.action:
            case "set_parameters":
                self._set({
                    field.parameter: (arguments[field.name], field.resolution)
                    for field in row.named.values() if field.parameter is not None
                })  # fmt: skip
            case "set_parameter":
                parameter = self._definition.parameters_by_id[int(arguments["parameter"])]
                value = parameter.value_of(arguments["value"])
                self._set({parameter.name: None if value is None else (value, 1e-9)})
                self._selected = parameter.id
            case "select_parameter":
                self._selected = int(arguments["parameter"])
            case "select_unsolicited":
                selection = (int(arguments["telemetry"]), 0.0)
                self._set({"unsolicited_selection": selection, "unsolicited_rate": None})
            case "save_parameters":
                self._stored = dict(self.values)
            case "restore_parameters":
                self._set({**self._defaults, **self._stored})
            case "default_parameters":
                self._set(self._defaults)
            case "clear_counters":
                self.counts = {"telecommands": 0, "telemetry": 0}
            case "set_clock":
                self._set_clock(arguments)
            case "set_mode":
                wanted = str(arguments["mode"])
                self.modes = set(IMAGING) if wanted in IMAGING else {wanted}
                self._has_imaged = self._has_imaged or wanted in IMAGING
            case "start_burst":
                self.bursts = True
            case "subscribe":
                self._subscribed = frozenset(
                    (arguments.get("class"), int(value))
                    for name, value in arguments.items() if name.startswith("telemetry[")
                )  # fmt: skip
            case action if action not in _INERT_ACTIONS:
                self.forget()

    def _arguments(self, row: Row, data: bytes) -> dict[str, Any]:
        """Return the values of a telecommand by argument, in the argument's unit, and by name for other fields."""
        arguments: dict[str, Any] = dict(row.arguments)
        values = row.decode(data)
        for name, field in row.named.items():
            if name not in values:  # the data end early
                continue
            value = values[name]
            if field.argument in _CLOCK and not isinstance(value, (str, bytes)):
                value = float(value) * (factor(field.unit, _CLOCK[field.argument]) or 1.0)
            arguments[field.argument or name] = value
        return arguments

    def _set(self, changes: Mapping[str, Known | None]) -> None:
        self.values.update(changes)
        if changes.keys() & _TIMING:
            self.attitudes.retimed(self.now_s)

    def _set_clock(self, arguments: Mapping[str, Any]) -> None:
        if self._definition.conventions.epoch_ns is None:  # the day is that of the clock
            self._clock = None
        else:
            total = sum(
                round(float(arguments.get(name) or 0) * (factor(unit, "ns") or 1.0))
                for name, unit in _CLOCK.items()
            )
            self._clock = (self.now_s, total + self._definition.conventions.epoch_ns)

    # --- telemetry without a request ---

    def is_subscribed(self, row: Row) -> bool:
        """Return whether a telecommand, or the parameters, may have selected a row to be sent without a request."""
        if self._subscribed is None or not self._subscribed.isdisjoint(
            ((None, row.id), (row.message_class, row.id))
        ):
            return True
        rate, selection = self.values["unsolicited_rate"], self.values["unsolicited_selection"]
        is_selected = selection is None or int(selection[0]) == row.id
        return is_selected and (rate is None or float(rate[0]) > 0.0)

    def may_send(self, row: Row) -> bool:
        """Return whether the definition may send a row now: at a rate, or after an event that is possible in this mode."""
        if row.unsolicited is None or isinstance(row.unsolicited, float):
            return row.unsolicited is not None
        return any(self.modes & _EVENT_MODES.get(event, self.modes) for event in row.unsolicited)

    def read_unasked(self, row: Row, data: bytes) -> None:
        """Judge the telemetry of a row that no request has caused; a boot that ends passes through standby."""
        after_boot = self.modes - {"boot"} if "boot" in self.modes else None
        if (
            after_boot is not None
            and not isinstance(row.unsolicited, float)
            and "mode" in (row.unsolicited or ())
        ):
            self.modes = self.modes | {"standby"}
        self.read(row, data)
        if after_boot is not None and self.modes == {"standby"}:
            self.modes = self.modes | after_boot

    # --- readings ---

    def read(self, row: Row, data: bytes) -> None:
        """Judge the telemetry of a row, received now."""
        if len(data) != row.size:
            raise Violation(f"{row.name}: {len(data)} bytes, not {row.size}")
        fault = self._content.get(row.name, {})
        if fault.get("freeze") == "all":
            if data != self._frozen.setdefault(row.name, data):
                raise Violation(f"{row.name}: changes, although it is frozen")
            return
        overrides = fault.get("set", {})
        by_quantity: Readings = {}
        for name, value in row.decode(data).items():
            if isinstance(value, float) and not math.isfinite(value):
                raise Violation(f"{row.name}.{name}: {value}")
            if name not in overrides:
                by_quantity[row.named[name].quantity] = (row.named[name], value)
            elif value != overrides[name]:
                raise Violation(
                    f"{row.name}.{name}: {value!r}, although a fault sets it to {overrides[name]!r}"
                )
        self.judge(row.name, by_quantity)
        if not any(row.named[name].quantity.startswith("attitude.") for name in overrides):
            self.judge_attitude(row.name, by_quantity)

    def judge(self, name: str, read: Readings) -> None:
        """Judge the quantities of a row or PDO, received now, apart from its attitude."""
        for quantity, (field, value) in read.items():
            where = f"{name}.{field.name}"
            if quantity.startswith(PARAMETER):
                self._check_parameter(where, field, value, quantity.removeprefix(PARAMETER))
            elif quantity in self._checks:
                self._checks[quantity](where, field, value)
            elif (known := self._expected(quantity, field)) is not None:
                self._expect(where, field, value, *known, span=_SPANS.get(quantity))
            elif isinstance(value, int) and field.raw_limits[1] >= 0xFFFF:
                self._learn(quantity, value)

    def judge_attitude(self, name: str, read: Readings) -> None:
        """Judge the attitude in a row, or in the PDOs of an instant."""
        if "attitude.valid" in read:
            imaging = bool(self.modes & IMAGING)
            self.attitudes.judge(name, read, self.now_s, imaging=imaging)

    def _check_parameter(self, where: str, field: Field, value: Value, name: str) -> None:
        bounds = self.values[name]
        if bounds is None:
            if not field.shared and not (field.kind == "enum" and not isinstance(value, str)):
                self._set({name: (value, field.resolution)})
            return
        expected, tolerance = bounds
        wrong = False
        if isinstance(expected, bool) or isinstance(value, bool):
            wrong = field.kind in ("flag", "integer", "bits", "enum") and bool(value) != bool(expected)
        elif isinstance(expected, str) or isinstance(value, str):
            wrong = type(value) is type(expected) and not field.shared and value != expected
        else:
            unit = self._definition.device_parameters[name].unit
            self._expect(where, field, value, float(expected) * (factor(unit, field.unit) or 1.0), tolerance)
        if wrong:
            raise Violation(f"{where}: {value!r}, but the parameter {name} is {expected!r}")

    def _expect(
        self,
        where: str,
        field: Field,
        value: Value,
        expected: float,
        tolerance: float = 0.0,
        *,
        span: int | None = None,
    ) -> None:
        """Check a number, which telemetry clips or wraps to the range of its field; `span` is that at which it wraps by itself."""
        if not isinstance(value, (int, float)):
            return
        low, high = field.limits
        step = abs(field.scale) if field.kind != "float" else 0.0
        circle = high - low + step if field.wrap else span
        if circle:
            off = abs((float(value) - expected + 0.5 * circle) % circle - 0.5 * circle)
        else:
            off = abs(float(value) - min(max(expected, low), high))
        if off > tolerance + field.resolution + FLOAT_GRAIN.get(field.type, 0.0) * abs(expected):
            raise Violation(f"{where}: {value!r}, not {expected!r}")

    def _check_mode(self, where: str, field: Field, value: Value) -> None:
        if field.shared or not isinstance(value, str):
            return
        if value not in self.modes:
            raise Violation(f"{where}: {value}, but only {', '.join(sorted(self.modes))} is possible")
        self.modes = set(IMAGING) if value in IMAGING else {value}

    def _check_in_error(self, where: str, _field: Field, value: Value) -> None:
        possible = self.modes & {"error"} if value else self.modes - {"error"}
        if not possible:
            raise Violation(f"{where}: {value!r}, but only {', '.join(sorted(self.modes))} is possible")
        self.modes = possible

    def _expected(self, quantity: str, field: Field) -> tuple[float, float] | None:
        """Return the number that a field must report, and its tolerance; None if it is not known or has no rule."""
        number, tolerance = None, 0.0
        match quantity:
            case "counters.telecommands" | "counters.telemetry":
                number = self.counts[quantity.removeprefix("counters.")]
            case "counters.requests" if None not in self.counts.values():
                number = sum(count or 0 for count in self.counts.values())
            case "boot.count":
                number = self._boot_count
            case "selected.id":
                number = self._selected
            case "selected.value" if self._selected is not None:
                parameter = self._definition.parameters_by_id[self._selected]
                known = self.values[parameter.name]
                names = parameter.enum or {}
                return None if known is None else (float(names.get(str(known[0]), known[0])), known[1])
            case "request.last" if self._last is not None:
                number = self._last[0]
            case "clock.unix" | "clock.seconds" if (clock_s := self._clock_s()) is not None:
                return clock_s % _SPANS.get(quantity, 2**64), 1.0 if field.kind != "float" else 1e-6
            case "uptime" | "uptime.seconds" if (uptime_s := self._uptime_s()) is not None:
                return uptime_s * (factor("s", field.unit) or 1.0), 1.01
        return None if number is None else (number, tolerance)

    def _learn(self, quantity: str, value: int) -> None:
        """Take over a count that is not known."""
        if quantity in ("counters.telecommands", "counters.telemetry"):
            self.counts[quantity.removeprefix("counters.")] = value
        elif quantity == "boot.count" and self._is_counted:
            self._boot_count = value

    def _clock_s(self) -> float | None:
        if self._clock is None:
            return None
        since_s, unix_ns = self._clock
        elapsed_ns = self._elapsed_ns(since_s)
        return float(self._definition.conventions.reported_ns(unix_ns + elapsed_ns) / SECOND_NS)

    def _elapsed_ns(self, since_s: float) -> int:
        """Return what has passed on the clock of the unit, which may drift, since a simulation time, ns."""
        elapsed_ns = round((self.now_s - since_s) * SECOND_NS)
        return elapsed_ns + round(elapsed_ns * self._drift_ppm * 1e-6)

    def _uptime_s(self) -> float | None:
        return None if self._started_s is None else self.now_s - self._started_s

    def _check_fraction(self, quantity: str, where: str, _field: Field, value: Value) -> None:
        expected_s = self._uptime_s() if quantity.startswith("uptime") else self._clock_s()
        if expected_s is None or isinstance(value, (str, bytes)):
            return
        scale = _FRACTIONS[quantity]
        if abs((value / scale - expected_s + 0.5) % 1.0 - 0.5) > 1.01 / scale + 1e-6:
            raise Violation(f"{where}: {value!r}, not {expected_s % 1.0 * scale!r}")

    def _check_frames(self, where: str, _field: Field, value: Value) -> None:
        if isinstance(value, int) and value:  # 0: there is no frame now
            if self._frames is not None and value < self._frames and self._frames - value < 128:
                raise Violation(f"{where}: {value} after {self._frames}")
            self._frames = value

    def _check_error(self, where: str, _field: Field, value: Value) -> None:
        if self._last is not None and isinstance(value, str) and value != self._last[1]:
            raise Violation(f"{where}: {value}, not {self._last[1]}")


_COMMANDABLE_MODES: Final[dict[str, frozenset[str]]] = {"boot": frozenset(), "error": frozenset({"standby"})}
"""Modes that can be commanded from a mode; from all others, any but boot and error (docs/rules.md, R13)."""
_EVENT_MODES: Final[dict[str, frozenset[str]]] = {"error": frozenset({"error"}), "frame": IMAGING}
"""Modes in which an event is possible; all others are in any."""
_TIMING: Final = frozenset({"update_rate", "exposure", "delay_time"})
_ORBIT: Final = frozenset({"orbit_semi_major_axis", "orbit_eccentricity"})
_BOUND: Final = _TIMING | _ORBIT | {"min_star_pixels", "max_star_pixels"}
"""Parameters that bound each other, so that a value within its limits may be refused."""
_INERT_ACTIONS: Final = frozenset(
    [
        None,
        "nothing",
        "reset",
        "save_image",
        "convert_image",
        "open_image",
        "load_image_chunk",
        "load_file_block",
        "set_hole_map",
    ]
)
"""Actions that leave what the oracle knows as it is."""
_FRACTIONS: Final = {
    "clock.milliseconds": 1e3,
    "clock.microseconds": 1e6,
    "clock.nanoseconds": 1e9,
    "uptime.milliseconds": 1e3,
}
"""Units of the parts of a second in one second."""
_SPANS: Final = {"clock.seconds": 2**32}
"""Spans, in the unit of the quantity, at which it wraps whatever the field."""
_CLOCK: Final = {"unix": "s", "seconds": "s", "milliseconds": "ms", "microseconds": "us", "nanoseconds": "ns"}
"""Units in which the arguments of `set_clock` are understood."""
