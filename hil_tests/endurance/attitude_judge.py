"""Whether an attitude may be reported as valid, and how far from the truth it may be."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from starhil.hil_tests.attitude import (
    ARCSEC_PER_RAD,
    Quaternion,
    Vector,
    conjugate,
    cross,
    from_directions,
    from_matrix,
    from_radec_roll,
    from_reported,
    from_rotation_vector,
    product,
    rotation_vector,
)
from starhil.hil_tests.endurance.violation import Known, Violation
from starhil.hil_tests.judge.messages import Value
from starhil.hil_tests.judge.rows import Field
from starhil.protocol.icd.conventions import Conventions
from starhil.protocol.units_of_measure import factor

SIGMAS: Final = 6.0
"""A valid attitude is within this many of its stated standard deviations of the truth."""
PROCESSING_S: Final = 1.0
"""Longest time from the end of an exposure to its result."""
STALE_PERIODS: Final = 3
STALE_S: Final = 2.0
"""An attitude is valid for at most `STALE_PERIODS` update periods and `STALE_S` after its result (docs/rules.md, R15)."""
LONGEST_PERIOD_S: Final = 100.0
"""Longest update period that a unit can have."""
KEPT_PERIODS: Final = 20
MOUNTING: Final = ("alpha", "beta", "gamma")
"""Names of the angles by which the frame is turned about x, y and z, in this order."""
SMALLEST_SCALAR: Final = 0.1
"""Smallest scalar that is computed from the other three numbers of a quaternion."""
ARCSEC: Final = 1.0 / ARCSEC_PER_RAD

Readings = dict[str, tuple[Field, Value]]
"""Field and value of each quantity of a row."""
Stated = tuple[Quaternion, float]
"""Attitude that a row states, from ICRS to the sensor as mounted, and the tolerance of its numbers, rad."""


@dataclass(frozen=True)
class Motion:
    """A rotation at a constant body rate, in the sensor frame, since a simulation time; `attitude` is that of the start."""

    start_s: float
    attitude: Quaternion
    rate_rad_s: Vector

    @classmethod
    def of(cls, truth: Mapping[str, Any], start_s: float) -> Motion:
        """Return the motion of a truth table of kind `fixed` or `rate`."""
        angles = truth["attitude"]
        attitude = from_radec_roll(angles["ra_deg"], angles["dec_deg"], angles.get("roll_deg", 0.0))
        x, y, z = (math.radians(value) for value in truth.get("rate_deg_s", (0.0, 0.0, 0.0)))
        return cls(start_s, attitude, (x, y, z))

    def at(self, t_s: float) -> Quaternion:
        turned = from_rotation_vector([-rate * (t_s - self.start_s) for rate in self.rate_rad_s])
        return product(turned, self.attitude)

    def error(self, measured: Quaternion, t_s: float, slack_s: float) -> Vector:
        """Return the rotation vector from the true attitude at a time, uncertain by `slack_s` both ways, to a measured one."""
        error = rotation_vector(product(measured, conjugate(self.at(t_s))))
        speed2 = sum(rate * rate for rate in self.rate_rad_s)
        if speed2 == 0.0:
            return error
        # the frame turns by -rate * t, so a later exposure is an error along -rate
        late_s = -sum(part * rate for part, rate in zip(error, self.rate_rad_s, strict=True)) / speed2
        shift_s = min(max(late_s, -slack_s), slack_s)
        x, y, z = (part + rate * shift_s for part, rate in zip(error, self.rate_rad_s, strict=True))
        return x, y, z


class AttitudeJudge:
    """Judges attitudes, reported in `conventions`, by the motion of the sensor and the parameters in use.

    `values` are these parameters, which the oracle keeps up to date; `sigma_arcsec` are the largest standard deviations
    across and about the boresight that the unit may leave unstated; `count` valid attitudes were compared with the
    truth, which follows the `motions` in the order of their start; no light has reached the detector since
    `dark_since_s`, None: it does.
    """

    def __init__(
        self,
        conventions: Conventions,
        values: Mapping[str, Known | None],
        sigma_arcsec: tuple[float, float],
    ) -> None:
        self._conventions = conventions
        self._values = values
        self._sigma_arcsec = sigma_arcsec
        self.count = 0
        self.motions: list[Motion] = []
        self.dark_since_s: float | None = None
        self.turned_rad: Vector = (0.0, 0.0, 0.0)
        """Rotation vector in the sensor frame by which a fault turns every reported attitude."""
        self._periods: list[tuple[float, float]] = []

    def started(self, now_s: float) -> None:
        self._periods = [(now_s, self._period_s())]

    def retimed(self, now_s: float) -> None:
        """Parameters that set the period of the exposures may have changed."""
        self._periods = [*self._periods[-KEPT_PERIODS:], (now_s, self._period_s())]

    def judge(self, row: str, read: Readings, now_s: float, *, imaging: bool) -> None:
        """Judge the attitude in a row, read at a simulation time; `imaging`: the unit may be in a mode with frames."""
        reported = [read[name] for name in (f"attitude.{letter}" for letter in "xyzw") if name in read]
        numbers = [float(value) for _, value in reported if not isinstance(value, (str, bytes))]
        stars = _stars(read)
        if not read["attitude.valid"][1]:
            if any(
                abs(number) > field.resolution for number, (field, _) in zip(numbers, reported, strict=True)
            ):
                raise Violation(f"{row}: quaternion {numbers} though the attitude is invalid")
            if stars:
                raise Violation(f"{row}: {len(stars)} identified stars though the attitude is invalid")
            return
        if not imaging:
            raise Violation(f"{row}: a valid attitude in a mode without images")
        window_s = _window_of(max(self._recent_periods(now_s)))
        dark_s = math.inf if self.dark_since_s is None else self.dark_since_s
        if now_s > dark_s + window_s - STALE_S:
            raise Violation(f"{row}: a valid attitude {now_s - dark_s:.3f} s after the lens was covered")
        if math.isfinite(window_s):
            finest = max((field.resolution for field, _ in reported), default=0.0) + 1e-7
            self._compare(row, self._of_quaternion(row, numbers, 4.0 * finest), read, now_s, window_s)
            self._compare(row, self._of_stars(row, stars), {}, now_s, window_s)

    def _of_quaternion(self, row: str, numbers: list[float], tolerance: float) -> Stated | None:
        """Return the attitude of a quaternion, whose scalar may be left out if its sign is fixed."""
        if len(numbers) == 3:
            scalar = math.sqrt(max(0.0, 1.0 - sum(number * number for number in numbers)))
            if self._conventions.scalar_sign != "positive" or scalar < SMALLEST_SCALAR:
                return None
            tolerance /= scalar
            numbers = [*numbers, scalar]
        if len(numbers) != 4:
            return None
        length = math.sqrt(sum(number * number for number in numbers))
        if abs(length - 1.0) > tolerance:
            raise Violation(f"{row}: the quaternion has length {length!r}")
        return from_reported(
            Quaternion(*(number / length for number in numbers)), self._conventions
        ), tolerance

    def _of_stars(self, row: str, stars: list[tuple[Vector, Vector, float]]) -> Stated | None:
        """Return the attitude in which the measured directions of stars have their catalogue directions."""
        if len(stars) < 2:
            return None
        (one, one_icrs, step), (other, other_icrs, _) = stars[:2]
        apart = math.hypot(*cross(one, other))
        error = math.dist(one, other) - math.dist(one_icrs, other_icrs)
        star_rad = SIGMAS * self._sigma_arcsec[0] * ARCSEC + 2.0 * step
        if abs(error) > 2.0 * star_rad:
            raise Violation(
                f"{row}: two stars are {abs(error) / ARCSEC:.1f} arcsec too near or too far apart"
            )
        if apart < 10.0 * star_rad:
            return None
        turned = from_directions((one, other), (one_icrs, other_icrs))
        axes = from_matrix(self._conventions.rows)
        return product(conjugate(axes), turned), star_rad * (1.0 + 1.0 / apart)

    def _compare(
        self, row: str, stated: Stated | None, read: Readings, now_s: float, window_s: float
    ) -> None:
        """Compare an attitude with the truth at the times at which the exposure may have been."""
        measured = None if stated is None else self._without_mounting(stated[0])
        if stated is not None and measured is not None:
            measured = product(from_rotation_vector(self.turned_rad), measured)
            self.count += 1
            self._check_error(row, self._errors(measured, now_s, window_s), read, stated[1])

    def _check_error(self, row: str, errors: Sequence[Vector], read: Readings, tolerance_rad: float) -> None:
        """Check the errors to the truth against what is stated, or else the largest that may be left unstated."""
        stated = [read.get("attitude.sigma_cross"), read.get("attitude.sigma_roll")]
        cross, roll = (
            (largest if item is None else float(item[1]) * (factor(item[0].unit, "arcsec") or 1.0))
            * ARCSEC
            * SIGMAS
            for item, largest in zip(stated, self._sigma_arcsec, strict=True)
        )
        found = [(math.hypot(x, y), abs(z)) for x, y, z in errors]
        if any(one <= cross + tolerance_rad and other <= roll + tolerance_rad for one, other in found):
            return
        across, about = min(found, key=sum)
        raise Violation(
            f"{row}: a valid attitude {across / ARCSEC:.2f} arcsec across and {about / ARCSEC:.2f} about "
            f"the boresight from the truth; {SIGMAS:g} sigma are {cross / ARCSEC:.2f} and {roll / ARCSEC:.2f}"
        )

    def _errors(self, measured: Quaternion, now_s: float, window_s: float) -> list[Vector]:
        """Return the errors to the truth at the times at which the exposure may have been."""
        errors: list[Vector] = []
        begin_s = now_s - window_s
        for number, motion in enumerate(self.motions):
            later = self.motions[number + 1].start_s if number + 1 < len(self.motions) else now_s
            if later < begin_s:
                continue
            start_s, end_s = max(begin_s, motion.start_s), max(min(later, now_s), motion.start_s)
            turn_rad = math.hypot(*motion.rate_rad_s) * (end_s - start_s)
            count = 1 + min(5000, math.ceil(turn_rad / 0.02))
            slack_s = 0.5 * (end_s - start_s) / count + 1e-3
            for step in range(count):
                mid_s = start_s + (step + 0.5) * (end_s - start_s) / count
                errors.append(motion.error(measured, mid_s, slack_s))
        return errors

    def _without_mounting(self, attitude: Quaternion) -> Quaternion | None:
        """Return an attitude of the mounted sensor in its own frame; None if the mounting is not known."""
        for axis in reversed(range(3)):
            angle = self._values[f"mounting_{MOUNTING[axis]}"]
            if angle is None:
                return None
            turn = [math.radians(float(angle[0])) if index == axis else 0.0 for index in range(3)]
            attitude = product(from_rotation_vector(turn), attitude)
        return attitude

    def check_period(self, where: str, field: Field, value: Value, now_s: float) -> None:
        """Check the time between exposures, which changes with the next image after a telecommand."""
        low, high = field.limits
        scale = factor("s", field.unit) or 1.0
        recent = self._recent_periods(now_s)
        if isinstance(value, (str, bytes)) or not all(map(math.isfinite, recent)):
            return
        possible = [min(max(period * scale, low), high) for period in recent]
        if all(abs(value - period) > field.resolution + 1e-6 * period for period in possible):
            raise Violation(f"{where}: {value!r}, not {possible[0]!r}")

    def _recent_periods(self, now_s: float) -> list[float]:
        """Return the periods in use when the last image may have been taken; infinite if not known."""
        recent = [self._period_s()]
        for number, (_, period) in enumerate(self._periods):
            until_s = self._periods[number + 1][0] if number + 1 < len(self._periods) else now_s
            if now_s - until_s <= _window_of(min(period, LONGEST_PERIOD_S)):
                recent.append(period)
        return recent

    def _period_s(self) -> float:
        """Return the time between exposures; infinite if it is not known."""
        rate, exposure, delay = (self._values[name] for name in ("update_rate", "exposure", "delay_time"))
        if rate is None or exposure is None or delay is None:
            return math.inf
        return max(1.0 / float(rate[0]), (float(exposure[0]) + float(delay[0])) / 1000.0)


def _window_of(period: float) -> float:
    """Return the largest age that a valid attitude may have."""
    return (STALE_PERIODS + 1) * period + STALE_S + PROCESSING_S


def _stars(read: Readings) -> list[tuple[Vector, Vector, float]]:
    """Return the stars of a row: measured direction, catalogue direction, and the resolution of both."""
    stars: list[tuple[Vector, Vector, float]] = []
    while True:
        names = [f"stars[{len(stars) + 1}].{kind}_{axis}" for kind in ("vector", "icrs") for axis in "xyz"]
        items = [read[name] for name in names if name in read]
        numbers = [float(value) for _, value in items if not isinstance(value, (str, bytes))]
        if len(numbers) < 6 or not any(numbers):
            return stars
        stars.append(
            (
                (numbers[0], numbers[1], numbers[2]),
                (numbers[3], numbers[4], numbers[5]),
                items[0][0].resolution,
            )
        )
