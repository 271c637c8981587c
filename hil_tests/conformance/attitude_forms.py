"""Forms in which a row reports the attitude, read as directions of the sensor's axes in ICRS.

    quaternion · vector part · rotation vector · Gibbs vector · modified Rodrigues parameters
            Euler angles · a row of the matrix · RA, Dec, roll · RA, Dec
                                        ▼
                     sensor axis (0, 1, 2) → unit vector in ICRS

A form that leaves a part of the attitude open, such as RA and Dec without roll, gives fewer axes. Source: docs/quantities.md,
"Forms of the attitude".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Any, Final

from starhil.hil_tests.attitude import (
    Quaternion,
    Vector,
    conjugate,
    from_gibbs_vector,
    from_modified_rodrigues,
    from_radec_roll,
    from_reported,
    from_rotation_vector,
    from_vector_part,
    product,
    to_matrix,
    unit,
)
from starhil.hil_tests.conformance.case import check
from starhil.hil_tests.judge.messages import Value
from starhil.hil_tests.judge.rows import Field

Axes = Mapping[int, Vector]
"""Directions of some of the sensor's axes x, y, z (0, 1, 2) in ICRS."""

Conventions = Any
"""`[conventions]` of the unit, which give direction and sign of the quaternion, and the reported axes."""
RAD_PER: Final = {
    "rad": 1.0, "deg": math.pi / 180.0, "arcmin": math.pi / 10_800.0, "arcsec": math.pi / 648_000.0,
}  # fmt: skip


@dataclass(frozen=True)
class Form:
    """Quantities that together state an attitude.

    `read` converts their values, angles in rad, to sensor axes. `lengths`, if given, are the shortest and longest vector that the
    values may make. `turn_rad` is the largest turn of the attitude by an error of 1 in all values.
    """

    name: str
    quantities: tuple[str, ...]
    read: Callable[[Sequence[float], Conventions], Axes]
    lengths: tuple[float, float] | None = None
    turn_rad: float = 4.0

    @property
    def has_inverse(self) -> bool:
        """Whether the values could state the inverse rotation: all but RA and Dec."""
        return self.read is not _radec


def axes_of(attitude: Quaternion) -> Axes:
    """Return the axes of a sensor with an attitude from ICRS."""
    return dict(enumerate(to_matrix(attitude)))


def _quaternion(parts: Sequence[float], conventions: Conventions) -> Axes:
    attitude = unit(parts) if len(parts) == 4 else from_vector_part(*parts)
    return axes_of(from_reported(attitude, conventions))


def _vector(
    rotation: Callable[[Sequence[float]], Quaternion],
) -> Callable[[Sequence[float], Conventions], Axes]:
    return lambda vector, conventions: _quaternion(rotation(vector), conventions)


def _euler(sequence: str) -> Callable[[Sequence[float], Conventions], Axes]:
    def read(angles: Sequence[float], conventions: Conventions) -> Axes:
        turned = Quaternion(0.0, 0.0, 0.0, 1.0)
        for letter, angle in zip(sequence, angles, strict=True):
            turned = product(
                turned, from_rotation_vector([angle if axis == letter else 0.0 for axis in "xyz"])
            )
        reported = turned if conventions.quaternion == "attitude" else conjugate(turned)
        return _quaternion(reported, conventions)

    return read


def _matrix_row(number: int) -> Callable[[Sequence[float], Conventions], Axes]:
    def read(row: Sequence[float], conventions: Conventions) -> Axes:
        axis, sign = next((axis, sign) for axis, sign in enumerate(conventions.rows[number]) if sign)
        x, y, z = (sign * part for part in row)
        return {axis: (x, y, z)}

    return read


def _radec(angles: Sequence[float], _conventions: Conventions) -> Axes:
    axes = axes_of(from_radec_roll(*map(math.degrees, (*angles, 0.0)[:3])))
    return axes if len(angles) == 3 else {2: axes[2]}


def _of(prefix: str, names: Iterable[str]) -> tuple[str, ...]:
    return tuple(f"attitude.{prefix}{name}" for name in names)


AXES_FROM_1: Final = ("[1]", "[2]", "[3]")
QUATERNION: Final = Form("quaternion", _of("", "xyzw"), _quaternion, (1.0, 1.0))
VECTOR_PART: Final = Form("vector part", _of("", "xyz"), _quaternion, (0.0, 1.0))
FORMS: Final = (
    QUATERNION,
    VECTOR_PART,
    Form("rotation vector", _of("rotation_", "xyz"), _vector(from_rotation_vector), (0.0, math.pi)),
    Form("Gibbs vector", _of("gibbs_", "xyz"), _vector(from_gibbs_vector)),
    Form("modified Rodrigues parameters", _of("mrp_", "xyz"), _vector(from_modified_rodrigues), (0.0, 1.0), 7.0),
    *(Form("matrix row", _of(f"dcm_{axis}", AXES_FROM_1), _matrix_row(number), (1.0, 1.0)) for number, axis in enumerate("xyz")),
    *(
        Form("Euler angles", _of(f"euler_{one}{two}{last}", AXES_FROM_1), _euler(one + two + last))
        for one, two, three in permutations("xyz") for last in (one, three)
    ),
    Form("RA, Dec and roll", _of("", ("ra", "dec", "roll")), _radec),
    Form("RA and Dec", _of("", ("ra", "dec")), _radec),
)  # fmt: skip
"""A form comes before those that state a part of it."""


@dataclass(frozen=True)
class Reading:
    """Fields of a row that state an attitude in one of the forms."""

    form: Form
    fields: tuple[Field, ...]

    def __str__(self) -> str:
        return ", ".join(item.name for item in self.fields)

    @property
    def _rounding(self) -> float:
        """Largest error of a value by its rounding to an integer, angles in rad."""
        steps = (
            abs(item.scale) * RAD_PER.get(item.unit, 1.0) for item in self.fields if item.kind != "float"
        )
        return 0.5 * max(steps, default=0.0)

    @property
    def rounding_deg(self) -> float:
        """Largest error of the attitude by the rounding of the values; largest where the scalar part is left out, and 0."""
        angle = self.form.turn_rad * self._rounding
        return math.degrees(2.0 * math.sqrt(angle) if self.form is VECTOR_PART else angle)

    def axes(self, seen: Mapping[str, Value], conventions: Conventions) -> Axes:
        """Return the sensor axes; fail the case if the values make no vector of the right length, or have the wrong sign."""
        numbers = [float(seen[item.name]) * RAD_PER.get(item.unit, 1.0) for item in self.fields]
        if self.form.lengths is not None:
            least, most = self.form.lengths
            tolerance = 1e-5 + 4.0 * self._rounding
            length = math.hypot(*numbers)
            wanted = f"{self.form.name} of length {'' if least else 'up to '}{most:.4g}"
            check(least - tolerance < length < most + tolerance, f"a {wanted} in {self}", f"{length:.7f}")
            if self.form is QUATERNION and conventions.scalar_sign == "positive":
                scalar = self.fields[3].name
                check(
                    numbers[3] > -tolerance,
                    f"{scalar} not negative (R15, docs/rules.md)",
                    f"{numbers[3]:.7g}",
                )
            nearest = min(max(length, least), most)
            numbers = [number * nearest / length for number in numbers] if length else numbers
        return self.form.read(numbers, conventions)


def readings(fields: Iterable[Field], conventions: Conventions) -> Iterator[Reading]:
    """Yield the attitudes that fields state; the nth one has the nth field of each of its quantities.

    A vector part states none if the scalar part may be negative.
    """
    left: dict[str, list[Field]] = {}
    for item in fields:
        left.setdefault(item.value or "", []).append(item)
    for form in FORMS:
        while all(left.get(name) for name in form.quantities):
            found = Reading(form, tuple(left[name].pop(0) for name in form.quantities))
            if form is not VECTOR_PART or conventions.scalar_sign == "positive":
                yield found


def angle_deg(one: Axes, other: Axes) -> float:
    """Return the largest angle by which axes of two attitudes are apart; where both state different axes, from a right angle."""
    return max(
        abs(math.degrees(_between(along, across)) - (0.0 if axis == another else 90.0))
        for axis, along in one.items()
        for another, across in other.items()
    )


def _between(one: Vector, other: Vector) -> float:
    cosine = math.fsum(a * b for a, b in zip(one, other, strict=True))
    return math.acos(min(1.0, max(-1.0, cosine)))
