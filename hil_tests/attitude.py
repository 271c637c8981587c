"""Quaternions (x, y, z, w) from ICRS to the sensor frame, and attitude errors, in plain Python.

The bench has its own quaternion algebra so that it shares no numerics with the unit under test. Conventions
(roll, sensor axes, scalar last) match the attitude rows of the interface definition.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

from starhil.hil_tests.errors import BenchError
from starhil.protocol.units_of_measure import factor

if TYPE_CHECKING:
    from starhil.protocol.icd.codec import Field, Row
    from starhil.protocol.icd.conventions import Conventions
    from starhil.protocol.icd.values import Value

ARCSEC_PER_RAD: Final = math.degrees(1.0) * 3600.0
_NORM_TOLERANCE: Final = 0.02
"""Largest deviation of an attitude quaternion from unit length; much more than four steps of 1e-4."""


Vector = tuple[float, float, float]


class Quaternion(NamedTuple):
    """A rotation ICRS → sensor, scalar last."""

    x: float
    y: float
    z: float
    w: float


@dataclass(frozen=True)
class AttitudeDifference:
    """How a measured attitude differs from the truth, in arcseconds, all non-negative.

    `cross_boresight_arcsec` is the angle between the two boresights, `roll_arcsec` the rotation about the
    boresight, and `total_arcsec` the total rotation angle.
    """

    cross_boresight_arcsec: float
    roll_arcsec: float
    total_arcsec: float


def unit(values: Sequence[float]) -> Quaternion:
    """Return `values` as a unit quaternion.

    Raises BenchError: the values are not four finite numbers of about unit length.
    """
    if len(values) != 4:
        raise BenchError(f"a quaternion must have four parts (x, y, z, w), not {len(values)}")
    length = math.sqrt(math.fsum(v * v for v in values))
    if not math.isfinite(length) or abs(length - 1.0) > _NORM_TOLERANCE:
        zero = "" if length else "; units report zeros if the attitude is not valid"
        raise BenchError(f"not an attitude quaternion: its length is {length:.6g}, not 1{zero}")
    x, y, z, w = (v / length for v in values)
    return Quaternion(x, y, z, w)


def from_vector_part(x: float, y: float, z: float) -> Quaternion:
    """Return the unit quaternion with this vector part and a non-negative scalar part."""
    return unit((x, y, z, math.sqrt(max(0.0, 1.0 - x * x - y * y - z * z))))


def product(p: Sequence[float], q: Sequence[float]) -> Quaternion:
    """Return the Hamilton product p ⊗ q; terms are grouped so that q ⊗ q* has no vector part, not even by rounding."""
    a, b, c, d = p
    x, y, z, w = q
    return Quaternion(
        (d * x + a * w) + (b * z - c * y),
        (d * y + b * w) + (c * x - a * z),
        (d * z + c * w) + (a * y - b * x),
        d * w - a * x - b * y - c * z,
    )


def conjugate(q: Sequence[float]) -> Quaternion:
    x, y, z, w = q
    return Quaternion(-x, -y, -z, w)


def from_rotation_vector(vector: Sequence[float]) -> Quaternion:
    """Return the rotation about the direction of a vector by its length, rad; a frame turned so has the conjugate."""
    angle = math.hypot(*vector)
    scale = math.sin(0.5 * angle) / angle if angle else 0.5
    x, y, z = (scale * part for part in vector)
    return Quaternion(x, y, z, math.cos(0.5 * angle))


def from_gibbs_vector(vector: Sequence[float]) -> Quaternion:
    """Return the rotation whose Gibbs or Rodrigues vector, tan(φ/2) along its axis, is given."""
    scalar = 1.0 / math.hypot(1.0, *vector)
    x, y, z = (scalar * part for part in vector)
    return Quaternion(x, y, z, scalar)


def from_modified_rodrigues(parameters: Sequence[float]) -> Quaternion:
    """Return the rotation whose modified Rodrigues parameters, tan(φ/4) along its axis, are given."""
    square = math.fsum(part * part for part in parameters)
    x, y, z = (2.0 * part / (1.0 + square) for part in parameters)
    return Quaternion(x, y, z, (1.0 - square) / (1.0 + square))


def rotation_vector(q: Sequence[float]) -> Vector:
    """Return the direction of the axis of a rotation times its angle, at most half a turn, rad."""
    x, y, z, w = q
    sine = math.copysign(math.hypot(x, y, z), w)
    scale = 2.0 * math.atan2(abs(sine), abs(w)) / sine if sine else 2.0
    return scale * x, scale * y, scale * z


_FORMS: Final[tuple[tuple[str, str, Callable[[Sequence[float]], Quaternion]], ...]] = (
    ("", "xyzw", unit),
    ("gibbs_", "xyz", from_gibbs_vector),
    ("mrp_", "xyz", from_modified_rodrigues),
    ("rotation_", "xyz", from_rotation_vector),
    ("", "xyz", lambda parts: from_vector_part(*parts)),
)
"""Prefix and components of the quantities that together are an attitude, and the function of their values."""


def attitude_fields(row: Row) -> tuple[list[Field], Callable[[Sequence[float]], Quaternion]] | None:
    """Return the fields in which a row reports an attitude, and the function of their values; None if there are none."""
    by_quantity = {field.value: field for field in reversed([*row.named_fields.values()])}
    for prefix, letters, rotation in _FORMS:
        names = [f"attitude.{prefix}{letter}" for letter in letters]
        if by_quantity.keys() >= set(names):
            return [by_quantity[name] for name in names], rotation
    return None


def attitude_in(row: Row, values: Mapping[str, Value]) -> Quaternion:
    """Return the attitude in a row as the unit reports it: as a quaternion, Gibbs vector, MRPs or rotation vector.

    Raises BenchError: the row has no such attitude, it is flagged invalid, or it is no attitude.
    """
    named_fields = attitude_fields(row)
    if named_fields is None:
        raise BenchError(f"row '{row.name}' reports no quaternion, Gibbs vector, MRPs or rotation vector")
    if any(
        values.get(field.name) is False
        for field in row.named_fields.values()
        if field.value == "attitude.valid"
    ):
        raise BenchError(f"the attitude is not valid (reason {values.get('reason', '?')!s})")
    fields, rotation = named_fields
    return rotation([float(values[field.name]) * (factor(field.unit, "rad") or 1.0) for field in fields])


def as_reported(attitude: Quaternion, conventions: Conventions) -> Quaternion:
    """Return an attitude from ICRS to the sensor with the direction and axes of a unit's `[conventions]`."""
    turned = product(from_matrix(conventions.rows), attitude)
    return conjugate(turned) if conventions.quaternion == "attitude" else turned


def from_reported(reported: Quaternion, conventions: Conventions) -> Quaternion:
    """Return the attitude from ICRS to the sensor that a unit reports; the inverse of `as_reported`."""
    turned = conjugate(reported) if conventions.quaternion == "attitude" else reported
    return product(conjugate(from_matrix(conventions.rows)), turned)


def from_radec_roll(ra_deg: float, dec_deg: float, roll_deg: float) -> Quaternion:
    """Return the attitude with this boresight and roll.

    Roll is the angle by which celestial north is turned counter-clockwise in the image from image up. The
    rows of the matrix are x = −sin(roll)·n − cos(roll)·e, y = −cos(roll)·n + sin(roll)·e and z = b, with the
    unit vectors n and e to north and east at the boresight b.
    """
    ra, dec, roll = (math.radians(v) for v in (ra_deg, dec_deg, roll_deg))
    boresight = (math.cos(dec) * math.cos(ra), math.cos(dec) * math.sin(ra), math.sin(dec))
    north = (-math.sin(dec) * math.cos(ra), -math.sin(dec) * math.sin(ra), math.cos(dec))
    east = (-math.sin(ra), math.cos(ra), 0.0)
    sine, cosine = math.sin(roll), math.cos(roll)
    row_x = tuple(-sine * n - cosine * e for n, e in zip(north, east, strict=True))
    row_y = tuple(-cosine * n + sine * e for n, e in zip(north, east, strict=True))
    return from_matrix((row_x, row_y, boresight))


def from_matrix(rows: Sequence[Sequence[float]]) -> Quaternion:
    """Return the quaternion that rotates vectors as a matrix does, given by rows (Shepperd's method)."""
    (a, b, c), (d, e, f), (g, h, i) = rows
    squares = (1.0 + a - e - i, 1.0 - a + e - i, 1.0 - a - e + i, 1.0 + a + e + i)
    largest = squares.index(max(squares))
    parts = (
        (squares[0], b + d, c + g, h - f),
        (b + d, squares[1], f + h, c - g),
        (c + g, f + h, squares[2], d - b),
        (h - f, c - g, d - b, squares[3]),
    )[largest]
    length = math.sqrt(sum(part * part for part in parts))
    return Quaternion(*(part / length for part in parts))


def cross(a: Vector, b: Vector) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def from_directions(in_sensor: tuple[Vector, Vector], in_icrs: tuple[Vector, Vector]) -> Quaternion:
    """Return the attitude with which two directions in ICRS are seen in the sensor (TRIAD, Black 1964)."""

    def triad(first: Vector, second: Vector) -> list[list[float]]:
        third = cross(first, second)
        return [[part / math.hypot(*axis) for part in axis] for axis in (first, third, cross(first, third))]

    pairs = list(zip(triad(*in_sensor), triad(*in_icrs), strict=True))
    return from_matrix(
        [[sum(a[row] * b[column] for a, b in pairs) for column in range(3)] for row in range(3)]
    )


def to_matrix(q: Quaternion) -> tuple[Vector, Vector, Vector]:
    """Return the rows of the matrix that rotates vectors as a quaternion does: the sensor's axes in ICRS."""
    x, y, z, w = q
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


def to_radec_roll(q: Quaternion) -> tuple[float, float, float]:
    """Return right ascension and declination of the boresight and the roll, in degrees, RA and roll from 0 to 360.

    Roll follows from the rows of the matrix in `from_radec_roll`: −y·n is its cosine, −x·n its sine.
    """
    row_x, row_y, along = to_matrix(q)
    ra, dec = math.atan2(along[1], along[0]), math.asin(min(1.0, max(-1.0, along[2])))
    north = (-math.sin(dec) * math.cos(ra), -math.sin(dec) * math.sin(ra), math.cos(dec))
    sine, cosine = (-math.fsum(a * b for a, b in zip(row, north, strict=True)) for row in (row_x, row_y))
    roll = math.degrees(math.atan2(sine, cosine))
    return math.degrees(ra) % 360.0, math.degrees(dec), roll % 360.0


def attitude_error(measured: Quaternion, truth: Quaternion) -> AttitudeDifference:
    """Compare two attitudes; a quaternion and its negative are the same attitude."""
    x, y, z, w = product(measured, conjugate(truth))  # from the true into the measured sensor frame
    cross = 2.0 * math.atan2(math.hypot(x, y), math.hypot(z, w))
    total = 2.0 * math.atan2(math.sqrt(x * x + y * y + z * z), abs(w))
    roll = 2.0 * math.atan2(abs(z), abs(w))
    return AttitudeDifference(cross * ARCSEC_PER_RAD, roll * ARCSEC_PER_RAD, total * ARCSEC_PER_RAD)


def interpolate(first: Quaternion, second: Quaternion, fraction: float) -> Quaternion:
    """Return the attitude at `fraction` of the shortest rotation from `first` to `second`."""
    whole = rotation_vector(product(second, conjugate(first)))
    return product(from_rotation_vector([fraction * part for part in whole]), first)
