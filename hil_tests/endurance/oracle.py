"""The oracle: what a unit may and must do, judged from its definition and its bus alone.

It keeps its own model of the unit - parameters in use and stored, mode, clock, counters, faults - and updates it by
what was sent and answered. What it cannot know (an answer lost on a faulty link, a parameter that a plugin may have
changed) is None, and is learned from the next reading. A `Violation` is raised for the first thing that a unit
must never do.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, Final

from starhil.hil_tests.endurance.truth import (
    IDENTITY,
    Error,
    Motion,
    Quaternion,
    conjugate,
    frame_turned,
    of_matrix,
    product,
)
from starhil.protocol.codec import Field, Row
from starhil.protocol.device_model import PARAMETER
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.messages import ErrorCode
from starhil.protocol.units_of_measure import factor
from starhil.protocol.values import MessageError, Value

SIGMAS: Final = 6.0
"""A valid attitude is within this many of its stated standard deviations of the truth."""
BOOT_S: Final = 0.6
"""Longest boot of the profile of a run."""
PROCESSING_S: Final = 1.0
"""Longest time from the end of an exposure to its result."""
STALE_PERIODS: Final = 3
STALE_S: Final = 2.0
"""An attitude is not reported longer than `STALE_PERIODS` update periods and `STALE_S` after its exposure."""
RECOVERY_S: Final = 15.0
"""Longest time from the end of the last fault to a valid attitude, with default parameters."""
IMAGING: Final = frozenset({"lost_in_space", "tracking"})
ARCSEC: Final = math.radians(1.0 / 3600.0)
SECOND_NS: Final = 1_000_000_000

Known = tuple[Value, float]
"""A value and its tolerance."""


class Violation(Exception):  # noqa: N818 (what it is called)
    """Something that a unit must never do."""


class Oracle:
    """A model of a unit that is updated by what happens on its bus.

    Parameters
    ----------
    icd
        Definition of the unit.
    parameters
        Defaults of parameters in the profile of the run.
    start_unix_s
        Device clock at each start.
    sigma_arcsec
        Largest standard deviation across and about the boresight that the unit may leave unstated.
    """

    def __init__(
        self,
        icd: InterfaceDefinition,
        parameters: Mapping[str, Value],
        start_unix_s: float,
        sigma_arcsec: tuple[float, float],
    ) -> None:
        self._icd = icd
        self._start_unix_ns = round(start_unix_s * SECOND_NS)
        self._sigma_arcsec = sigma_arcsec
        calibrated = {"focal_length", "centroid_x", "centroid_y", "k1", "k2", "p1", "p2"}
        self._defaults: dict[str, Known | None] = {
            name: None if name in calibrated else (parameter.default, 1e-9)
            for name, parameter in icd.device_parameters.items()
        }
        self._defaults.update({name: (value, 1e-9) for name, value in parameters.items()})
        self._stored: dict[str, Known | None] = {}
        self.values: dict[str, Known | None] = dict(self._defaults)
        self.modes: set[str] = {"boot"}
        self.counts: dict[str, int | None] = {}
        self._boot_count: int | None = None
        self.attitudes = 0
        """Number of valid attitudes compared with the truth."""
        self.disk_full = False
        self.stuck = False
        self.disturbed: set[str] = set()
        """Links on which answers may be lost, late or damaged."""
        self.bursts = False
        """Whether packets of a file may arrive."""
        self._dark_since: float | None = None
        self.now_s = 0.0
        self._motions: list[Motion] = []
        self._periods: list[tuple[float, float]] = []
        self._has_imaged = False
        self._frames: int | None = None
        self._selected: int | None = None
        self._last: tuple[int, ErrorCode] | None = None
        self._turn_cache: tuple[tuple[float, ...], Quaternion] = ((), IDENTITY)
        self._start(0.0)

    # --- what happens to the unit ---

    def powered(self, *, factory: bool, motion: Motion) -> None:
        """Power was switched off and on; simulation time begins again with a motion of the sensor."""
        if factory:
            self._stored, self._boot_count = {}, 0
        self.now_s = 0.0
        self.stuck = False
        self.disturbed.clear()
        self._dark_since = None
        self._motions = [motion]
        self._start(0.0)

    def restarted(self) -> None:
        """The unit has restarted by itself, now."""
        self._start(self.now_s)

    def _start(self, at_s: float) -> None:
        self._started_s: float | None = at_s
        self.values = {**self._defaults, **self._stored}
        self.modes = {"boot"}
        self.counts = {"telecommands": 0, "telemetry": 0}
        self._boot_count = (
            None if self._boot_count is None or self.disk_full else (self._boot_count + 1) & 0xFFFF
        )
        self._clock: tuple[float, int] | None = (at_s, self._start_unix_ns)
        self._clock_set_s = at_s
        self._has_imaged = False
        self._frames = None
        self._selected = next(iter(self._icd.parameters_by_id), None)
        self._last = None
        self.bursts = False
        self._periods = [(at_s, self._period_s())]

    def time_passed(self, now_s: float) -> None:
        """Simulation time has passed."""
        self.now_s = now_s
        if "boot" in self.modes:
            start = self.values.get("start_mode")
            if start is None or start[0] != "lost_in_space":
                self.modes.add("standby")
            if start is None or start[0] == "lost_in_space":
                self.modes |= IMAGING
            if self._started_s is not None and now_s - self._started_s > BOOT_S:
                self.modes.discard("boot")
        self._has_imaged = self._has_imaged or bool(self.modes & IMAGING)

    def moved(self, motion: Motion) -> None:
        """The truth was replaced, now."""
        self._motions.append(motion)

    def failed(self) -> None:
        """The unit must be in the error mode, now."""
        self.modes = {"error"}

    def pipeline_ended(self) -> None:
        """The image pipeline has ended: the error mode, until it is restarted and the mode is commanded."""
        self.modes = {"error"}

    def covered(self, *, fully: bool) -> None:
        """The lens was covered, now, or is not fully covered any more."""
        if not fully:
            self._dark_since = None
        elif self._dark_since is None:
            self._dark_since = self.now_s

    def forget(self) -> None:
        """Nothing is known of parameters and counters any more, because a request had an unknown outcome."""
        self.values = dict.fromkeys(self.values)
        self._stored = dict.fromkeys(self.values)
        self.counts = dict.fromkeys(self.counts)
        self._clock = self._boot_count = self._selected = self._last = self._started_s = None
        self.modes = {"boot", "standby", "error", *IMAGING}
        self.bursts = True
        self._periods = [(self.now_s, math.inf)]

    # --- requests ---

    def verdict(self, row: Row | None, kind: str, data: bytes) -> ErrorCode | None:
        """Return OK if a request must be accepted, the code with which it must be refused, or None: either."""
        if row is None:
            return ErrorCode.INVALID_ID
        if kind == "telemetry":
            images = any((field.value or "").startswith(("image.", "file.")) for field in row.fields)
            return ErrorCode.INVALID_LENGTH if data else None if images else ErrorCode.OK
        if len(data) != row.size:
            return ErrorCode.INVALID_LENGTH
        try:
            values = row.decode(data)
        except MessageError as error:
            return error.code
        arguments = _by_argument(row, values)
        match row.action:
            case "set_mode":
                return self._mode_verdict(str(arguments.get("mode")))
            case "set_parameter":
                return self._parameter_verdict(arguments)
            case "select_parameter":
                known = int(float(arguments["parameter"])) in self._icd.parameters_by_id
                return ErrorCode.OK if known else ErrorCode.INVALID_PARAMETER
            case "save_parameters":
                return ErrorCode.INTERNAL if self.disk_full else ErrorCode.OK
            case "set_parameters" if any(field.parameter in _BOUND for field in row.fields):
                return None
            case "nothing" | None | "reset" | "set_clock" | "clear_counters" | "restore_parameters":
                return ErrorCode.OK
            case "default_parameters" | "set_parameters":
                return ErrorCode.OK
            case _:
                return None

    def _mode_verdict(self, wanted: str) -> ErrorCode | None:
        allowed = {
            "boot": set(),
            "error": {"standby"},
            **dict.fromkeys(("standby", *IMAGING), {"standby", *IMAGING}),
        }
        votes = {wanted in allowed[mode] for mode in self.modes}
        if votes == {False} or (wanted == "tracking" and not self._has_imaged):
            return ErrorCode.SEQUENCE
        certain = votes == {True} and wanted != "tracking" and "error" not in self.modes
        return ErrorCode.OK if certain else None

    def _parameter_verdict(self, arguments: Mapping[str, Any]) -> ErrorCode | None:
        parameter = self._icd.parameters_by_id.get(int(arguments["parameter"]))
        try:
            if parameter is None:
                return ErrorCode.INVALID_PARAMETER
            parameter.check(arguments["value"])
        except MessageError:
            return ErrorCode.INVALID_PARAMETER
        return None if parameter.name in _BOUND else ErrorCode.OK

    def counted(self, kind: str) -> None:
        """A request was received."""
        count = self.counts[f"{_COUNTER[kind]}"]
        self.counts[_COUNTER[kind]] = None if count is None else (count + 1) & 0xFFFF

    def executed(self, row: Row | None, row_id: int, data: bytes, code: ErrorCode) -> None:
        """A telecommand was answered with a code."""
        self._last = (row_id, code)
        if row is None or code is not ErrorCode.OK:
            return
        arguments = _by_argument(row, row.decode(data))
        effect = _EFFECTS.get(row.action or "nothing")
        if effect is None:
            self.forget()
        else:
            effect(self, row, arguments)

    def _set(self, changes: Mapping[str, Known | None]) -> None:
        self.values.update(changes)
        if changes.keys() & _BOUND:
            self._periods.append((self.now_s, self._period_s()))

    def _parameters_set(self, row: Row, arguments: Mapping[str, Any]) -> None:
        self._set(
            {
                field.parameter: (arguments[field.name], _resolution(field))
                for field in row.named_fields.values()
                if field.parameter is not None
            }
        )

    def _parameter_set(self, _row: Row, arguments: Mapping[str, Any]) -> None:
        parameter = self._icd.parameters_by_id[int(arguments["parameter"])]
        self._set({parameter.name: (parameter.check(arguments["value"]), 1e-9)})
        self._selected = parameter.id

    def _parameter_selected(self, _row: Row, arguments: Mapping[str, Any]) -> None:
        self._selected = int(arguments["parameter"])

    def _unsolicited_selected(self, _row: Row, arguments: Mapping[str, Any]) -> None:
        self._set({"unsolicited_selection": (int(arguments["telemetry"]), 0.0), "unsolicited_rate": None})

    def _parameters_saved(self, _row: Row, _arguments: Mapping[str, Any]) -> None:
        self._stored = dict(self.values)

    def _parameters_restored(self, _row: Row, _arguments: Mapping[str, Any]) -> None:
        self._set({**self._defaults, **self._stored})

    def _defaults_set(self, _row: Row, _arguments: Mapping[str, Any]) -> None:
        self._set(self._defaults)

    def _counters_cleared(self, _row: Row, _arguments: Mapping[str, Any]) -> None:
        self.counts = {"telecommands": 0, "telemetry": 0}

    def _clock_changed(self, _row: Row, arguments: Mapping[str, Any]) -> None:
        if self._icd.conventions.epoch_ns is None:  # the day is that of the clock
            self._clock = None
        else:
            scales = {"unix": SECOND_NS, "seconds": SECOND_NS, "milliseconds": 10**6, "microseconds": 10**3}
            scales["nanoseconds"] = 1
            total = sum(round(float(arguments.get(name) or 0) * scale) for name, scale in scales.items())
            self._clock = (self.now_s, total + self._icd.conventions.epoch_ns)
        self._clock_set_s = self.now_s

    def _mode_commanded(self, _row: Row, arguments: Mapping[str, Any]) -> None:
        wanted = str(arguments["mode"])
        self.modes = set(IMAGING) if wanted in IMAGING else {wanted}
        self._has_imaged = self._has_imaged or wanted in IMAGING

    def _unchanged(self, _row: Row, _arguments: Mapping[str, Any]) -> None:
        """The state that the oracle knows stays as it is."""

    def _burst_started(self, _row: Row, _arguments: Mapping[str, Any]) -> None:
        self.bursts = True

    def forget_last(self) -> None:
        """The code with which the last telecommand was refused is not known."""
        self._last = None

    def started_at(self, at_s: float) -> None:
        """The last start was at this time."""
        self._started_s = at_s

    # --- readings ---

    def read(self, row: Row, data: bytes) -> None:
        """Judge the telemetry of a row, received now."""
        if len(data) != row.size:
            raise Violation(f"{row.name}: {len(data)} bytes, not {row.size}")
        values = row.decode(data)
        by_quantity: dict[str, tuple[Field, Value]] = {}
        for name, value in values.items():
            field = row.named_fields[name]
            quantity = PARAMETER + field.parameter if field.parameter else field.value
            if isinstance(value, float) and not math.isfinite(value):
                raise Violation(f"{row.name}.{name}: {value}")
            if quantity is not None:
                by_quantity[quantity] = (field, value)
        for quantity, (field, value) in by_quantity.items():
            where = f"{row.name}.{field.name}"
            if quantity.startswith(PARAMETER):
                self._check_parameter(where, field, value, quantity.removeprefix(PARAMETER))
            elif (check := _CHECKS.get(quantity)) is not None:
                check(self, where, field, value)
        if "attitude.valid" in by_quantity:
            self._check_attitude(row.name, by_quantity)

    def _check_parameter(self, where: str, field: Field, value: Value, name: str) -> None:
        known = self.values[name]
        if known is None:
            if not field.aliases and not (field.kind == "enum" and not isinstance(value, str)):
                self.values[name] = (value, _resolution(field))
            return
        expected, tolerance = known
        if isinstance(expected, bool) or isinstance(value, bool):
            if field.kind in ("flag", "integer", "bits", "enum") and flag(value) != flag(expected):
                raise Violation(f"{where}: {value!r}, but the parameter {name} is {expected!r}")
        elif isinstance(expected, str) or isinstance(value, str):
            if (
                isinstance(value, str)
                and isinstance(expected, str)
                and not field.aliases
                and value != expected
            ):
                raise Violation(f"{where}: {value!r}, but the parameter {name} is {expected!r}")
        else:
            unit = self._icd.device_parameters[name].unit
            self._expect(where, field, value, float(expected) * (factor(unit, field.unit) or 1.0), tolerance)

    def _expect(
        self, where: str, field: Field, value: Value, expected: float, tolerance: float = 0.0
    ) -> None:
        """Check a number, which telemetry clips or wraps to the range of its field."""
        if not isinstance(value, (int, float)):
            return
        low, high = field.physical_limits
        step = abs(field.scale) if field.kind != "float" else 0.0
        if field.wrap:
            span = high - low + step
            off = abs((float(value) - expected + 0.5 * span) % span - 0.5 * span)
        else:
            off = abs(float(value) - min(max(expected, low), high))
        if off > tolerance + _resolution(field) + 1.2e-7 * abs(expected) * (field.kind == "float"):
            raise Violation(f"{where}: {value!r}, not {expected!r}")

    def _check_mode(self, where: str, field: Field, value: Value) -> None:
        if field.aliases or not isinstance(value, str):
            return
        if value not in self.modes:
            raise Violation(f"{where}: {value}, but only {', '.join(sorted(self.modes))} is possible")
        self.modes = set(IMAGING) if value in IMAGING else {value}

    def _check_count(self, name: str) -> Callable[[str, Field, Value], None]:
        def check(where: str, field: Field, value: Value) -> None:
            known = self.counts[name]
            if known is not None:
                self._expect(where, field, value, known)
            elif isinstance(value, int) and field.raw_limits[1] >= 0xFFFF:
                self.counts[name] = value

        return check

    def _check_requests(self, where: str, field: Field, value: Value) -> None:
        telecommands, telemetry = self.counts["telecommands"], self.counts["telemetry"]
        if telecommands is not None and telemetry is not None:
            self._expect(where, field, value, telecommands + telemetry)

    def _check_clock(self, scale: float, *, modulo: float = math.inf) -> Callable[[str, Field, Value], None]:
        def check(where: str, field: Field, value: Value) -> None:
            if self._clock is None:
                return
            since_s, unix_ns = self._clock
            now_ns = self._icd.conventions.reported_ns(unix_ns + round((self.now_s - since_s) * SECOND_NS))
            expected = now_ns % (2**32 * SECOND_NS if modulo == math.inf else SECOND_NS) / SECOND_NS
            whole = math.floor(expected * scale + 1e-6) if field.kind != "float" else expected * scale
            self._expect(where, field, value, whole, 1.0 if field.kind != "float" else 1e-6 * scale)

        return check

    def _check_uptime(self, scale: float) -> Callable[[str, Field, Value], None]:
        def check(where: str, field: Field, value: Value) -> None:
            if self._started_s is not None:
                uptime_s = self.now_s - self._started_s
                self._expect(where, field, value, uptime_s * scale, 1.01 + 1e-6 * scale)

        return check

    def _check_boot_count(self, where: str, field: Field, value: Value) -> None:
        if self._boot_count is not None:
            self._expect(where, field, value, self._boot_count)
        elif isinstance(value, int) and field.raw_limits[1] >= 0xFFFF and not self.disk_full:
            self._boot_count = value

    def _check_frames(self, where: str, _field: Field, value: Value) -> None:
        if isinstance(value, int) and value:  # 0: there is no frame now
            if self._frames is not None and value < self._frames and self._frames - value < 128:
                raise Violation(f"{where}: {value} after {self._frames}")
            self._frames = value

    def _check_selected(self, where: str, field: Field, value: Value) -> None:
        if self._selected is not None:
            self._expect(where, field, value, self._selected)

    def _check_last(self, where: str, field: Field, value: Value) -> None:
        if self._last is not None:
            self._expect(where, field, value, self._last[0])

    # --- attitude ---

    def _check_attitude(self, row: str, read: Mapping[str, tuple[Field, Value]]) -> None:
        four = [read.get(f"attitude.{letter}") for letter in "xyzw"]
        valid = flag(read["attitude.valid"][1])
        numbers = [0.0 if item is None else float(item[1]) for item in four if not isinstance(item, str)]
        if not valid:
            if any(item is not None and abs(float(item[1])) > _resolution(item[0]) for item in four):
                raise Violation(f"{row}: quaternion {numbers} though the attitude is invalid")
            return
        self._check_may_be_valid(row)
        if any(item is None for item in four):
            return
        resolution = max(_resolution(item[0]) for item in four if item is not None) + 1e-7
        length = math.sqrt(sum(number * number for number in numbers))
        if abs(length - 1.0) > 4.0 * resolution:
            raise Violation(f"{row}: the quaternion has length {length!r}")
        x, y, z, w = (number / length for number in numbers)
        self._check_error(row, self._to_sensor((x, y, z, w)), read, 4.0 * resolution)

    def _check_may_be_valid(self, row: str) -> None:
        if not self.modes & IMAGING:
            raise Violation(f"{row}: a valid attitude in {', '.join(sorted(self.modes))}")
        window_s = self._window_s()
        if self._dark_since is not None and self.now_s > self._dark_since + window_s - STALE_S:
            raise Violation(
                f"{row}: a valid attitude {self.now_s - self._dark_since:.3f} s after the lens was covered"
            )

    def _check_error(
        self,
        row: str,
        measured: Quaternion | None,
        read: Mapping[str, tuple[Field, Value]],
        tolerance_rad: float,
    ) -> None:
        window_s = self._window_s()
        if measured is None or math.isinf(window_s):
            return
        stated = [read.get("attitude.sigma_cross"), read.get("attitude.sigma_roll")]
        cross, roll = (
            (largest if item is None else float(item[1]) * (factor(item[0].unit, "arcsec") or 1.0))
            * ARCSEC
            * SIGMAS
            for item, largest in zip(stated, self._sigma_arcsec, strict=True)
        )
        errors = self._errors(measured, window_s)
        self.attitudes += 1
        if any(
            item.cross_rad <= cross + tolerance_rad and abs(item.z) <= roll + tolerance_rad for item in errors
        ):
            return
        best = min(errors, key=lambda item: item.cross_rad + abs(item.z))
        raise Violation(
            f"{row}: a valid attitude {best.cross_rad / ARCSEC:.2f} arcsec across and {abs(best.z) / ARCSEC:.2f} about "
            f"the boresight from the truth; {SIGMAS:g} sigma are {cross / ARCSEC:.2f} and {roll / ARCSEC:.2f}"
        )

    def _errors(self, measured: Quaternion, window_s: float) -> list[Error]:
        """Return the errors to the truth at the times at which the exposure may have been."""
        errors: list[Error] = []
        begin_s = self.now_s - window_s
        for number, motion in enumerate(self._motions):
            later = self._motions[number + 1].start_s if number + 1 < len(self._motions) else self.now_s
            if later < begin_s:
                continue
            start_s, end_s = max(begin_s, motion.start_s), max(min(later, self.now_s), motion.start_s)
            turn_rad = motion.speed_rad_s * (end_s - start_s)
            count = 1 + min(5000, math.ceil(turn_rad / 0.02))
            slack_s = 0.5 * (end_s - start_s) / count + 1e-3
            for step in range(count):
                mid_s = start_s + (step + 0.5) * (end_s - start_s) / count
                errors.append(Error.between(measured, motion.at(mid_s)).along(motion.rate_rad_s, slack_s))
        return errors

    def _to_sensor(self, reported: Quaternion) -> Quaternion | None:
        """Return a reported attitude in the sensor frame; None if the mounting is not known."""
        conventions = self._icd.conventions
        if conventions.quaternion == "attitude":
            reported = conjugate(reported)
        angles = [self.values[f"mounting_{name}"] for name in ("alpha", "beta", "gamma")]
        if any(angle is None for angle in angles):
            return None
        numbers = tuple(float(angle[0]) for angle in angles if angle is not None)
        if self._turn_cache[0] != numbers:
            turn = IDENTITY
            for axis, angle in enumerate(numbers):
                unit = [float(index == axis) for index in range(3)]
                turn = product(frame_turned(unit, math.radians(angle)), turn)
            self._turn_cache = (numbers, product(of_matrix(conventions.rows), turn))
        return product(conjugate(self._turn_cache[1]), reported)

    # --- times ---

    def _number(self, name: str) -> float:
        known = self.values.get(name)
        return math.inf if known is None else float(known[0])

    def _period_s(self) -> float:
        """Return the time between exposures with the present parameters; infinite if they are not known."""
        rate = self._number("update_rate")
        exposure_s = (self._number("exposure") + self._number("delay_time")) / 1000.0
        return math.inf if math.isinf(rate) else max(1.0 / rate, exposure_s)

    def _window_s(self) -> float:
        """Return the largest age that a valid attitude may have now."""
        longest = self._period_s()
        for number, (_, period_s) in enumerate(self._periods):
            until = self._periods[number + 1][0] if number + 1 < len(self._periods) else self.now_s
            if self.now_s - until <= (STALE_PERIODS + 1) * period_s + STALE_S + PROCESSING_S:
                longest = max(longest, period_s)
        self._periods = self._periods[-20:]
        return (STALE_PERIODS + 1) * longest + STALE_S + PROCESSING_S


def flag(value: Value) -> bool:
    """Return a truth value that may have been sent as a member of an enumeration."""
    return value == "true" if isinstance(value, str) else bool(value)


def _by_argument(row: Row, values: Mapping[str, Value]) -> dict[str, Any]:
    """Return the values of a telecommand by argument, in the argument's unit, and by name for other fields."""
    found: dict[str, Any] = dict(row.arguments)
    for name, field in row.named_fields.items():
        value = values[name]
        if field.argument in _TIME_UNITS and not isinstance(value, (str, bytes)):
            value = float(value) * (factor(field.unit, _TIME_UNITS[field.argument]) or 1.0)
        found[field.argument or name] = value
    return found


def _resolution(field: Field) -> float:
    """Return the largest difference between a value and what its field carries of it."""
    if field.kind == "float":
        return 1e-9 * abs(field.scale)
    return 0.51 * abs(field.scale)


_BOUND: Final = frozenset({"update_rate", "exposure", "delay_time"})
"""Parameters that bound each other."""
_COUNTER: Final = {"telecommand": "telecommands", "telemetry": "telemetry"}
_TIME_UNITS: Final = {
    "unix": "s",
    "seconds": "s",
    "milliseconds": "ms",
    "microseconds": "us",
    "nanoseconds": "ns",
}

_EFFECTS: Final[dict[str, Callable[[Oracle, Row, Mapping[str, Any]], None]]] = {
    "set_parameters": Oracle._parameters_set,
    "set_parameter": Oracle._parameter_set,
    "select_parameter": Oracle._parameter_selected,
    "select_unsolicited": Oracle._unsolicited_selected,
    "save_parameters": Oracle._parameters_saved,
    "restore_parameters": Oracle._parameters_restored,
    "default_parameters": Oracle._defaults_set,
    "clear_counters": Oracle._counters_cleared,
    "set_clock": Oracle._clock_changed,
    "set_mode": Oracle._mode_commanded,
    "start_burst": Oracle._burst_started,
    **dict.fromkeys(
        (
            "nothing", "reset", "subscribe", "save_image", "open_image", "load_image_chunk", "load_file_block",
            "set_hole_map",
        ),
        Oracle._unchanged,
    ),
}  # fmt: skip

_CHECKS: Final[dict[str, Callable[[Oracle, str, Field, Value], None]]] = {
    "mode": Oracle._check_mode,
    "counters.telecommands": lambda oracle, *read: oracle._check_count("telecommands")(*read),
    "counters.telemetry": lambda oracle, *read: oracle._check_count("telemetry")(*read),
    "counters.requests": Oracle._check_requests,
    "clock.unix": lambda oracle, *read: oracle._check_clock(1.0)(*read),
    "clock.seconds": lambda oracle, *read: oracle._check_clock(1.0)(*read),
    "clock.milliseconds": lambda oracle, *read: oracle._check_clock(1e3, modulo=1.0)(*read),
    "uptime": lambda oracle, *read: oracle._check_uptime(1.0)(*read),
    "uptime.seconds": lambda oracle, *read: oracle._check_uptime(1.0)(*read),
    "boot.count": Oracle._check_boot_count,
    "frame.counter": Oracle._check_frames,
    "selected.id": Oracle._check_selected,
    "request.last": Oracle._check_last,
}
