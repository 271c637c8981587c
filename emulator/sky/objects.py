"""What else a star sensor sees, or does not see: bodies, stray light, hidden parts of the field, false and missing stars.

All are plain values, so that profiles and tests can name them; how they look is in `starhil.emulator.sky.light`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final, Self

from starhil.emulator.errors import EmulatorError

_ANGLE: Final = (-360.0, 360.0)
_MOST_OBJECTS: Final = 100_000


@dataclass(frozen=True)
class Moon:
    """The Moon: a disc that saturates, and the light that it scatters in the lens.

    Attributes
    ----------
    ra_deg, dec_deg : float
        Direction of its centre, ICRS.
    diameter_deg : float
        Apparent diameter.
    magnitude : float
        V of the whole disc; −12.7 when full.
    illuminated : float
        Share of the disc that is lit, 0…1.
    bright_limb_deg : float
        Position angle of the middle of the bright limb, from north through east.
    glare_share : float
        Share of its light that the lens scatters over the field, falling with the square of the angle.
    """

    ra_deg: float
    dec_deg: float
    diameter_deg: float = 0.52
    magnitude: float = -12.7
    illuminated: float = 1.0
    bright_limb_deg: float = 90.0
    glare_share: float = 1e-3


@dataclass(frozen=True)
class SunGlare:
    """Stray light of the Sun, which itself stays outside the field, behind the baffle's edge.

    Attributes
    ----------
    ra_deg, dec_deg : float
        Direction of the Sun, ICRS.
    electrons_s : float
        Electrons/s/pixel where the Sun is 30° away; it falls with the cube of the angle.
    """

    ra_deg: float
    dec_deg: float
    electrons_s: float = 1000.0


@dataclass(frozen=True)
class EarthLimb:
    """The Earth's disc before part of the sky.

    Attributes
    ----------
    ra_deg, dec_deg : float
        Direction of the Earth's centre, ICRS.
    radius_deg : float
        Angular radius of the Earth: 64° from 700 km above it.
    electrons_s : float
        Electrons/s/pixel of its face: 0 over the night side, millions by day.
    atmosphere_deg : float
        Height over which the limb fades.
    """

    ra_deg: float
    dec_deg: float
    radius_deg: float = 64.0
    electrons_s: float = 1e6
    atmosphere_deg: float = 0.15


@dataclass(frozen=True)
class PointSource:
    """A planet, satellite or other point of light that is in no star catalogue.

    Attributes
    ----------
    ra_deg, dec_deg : float
        Direction, ICRS.
    magnitude : float
        V, as the sensor sees it.
    name : str
        For the truth.
    """

    ra_deg: float
    dec_deg: float
    magnitude: float
    name: str = ""


@dataclass(frozen=True)
class Obstruction:
    """A dark thing near the lens that covers part of the image: all beyond a straight edge, or inside a polygon.

    Attributes
    ----------
    share : float
        Share of the image that lies beyond the edge, 0…1; not used with a polygon.
    angle_deg : float
        Direction in which the edge is left, 0 to the right, 90 down.
    polygon_px : tuple of (x, y)
        Corners, pixels; empty for the edge.
    softness_px : float
        Width over which it fades, as it is out of focus.
    """

    share: float = 0.5
    angle_deg: float = 0.0
    polygon_px: tuple[tuple[float, float], ...] = ()
    softness_px: float = 3.0


_RANGES: Final[dict[str, tuple[float, float]]] = {
    "ra_deg": _ANGLE,
    "dec_deg": (-90.0, 90.0),
    "diameter_deg": (1e-3, 90.0),
    "magnitude": (-30.0, 20.0),
    "illuminated": (0.0, 1.0),
    "bright_limb_deg": _ANGLE,
    "glare_share": (0.0, 1.0),
    "electrons_s": (0.0, 1e12),
    "radius_deg": (0.1, 179.0),
    "atmosphere_deg": (1e-3, 20.0),
    "share": (0.0, 1.0),
    "angle_deg": _ANGLE,
    "polygon_px": (-1e5, 1e5),
    "softness_px": (0.0, 1000.0),
    "false_stars": (0, _MOST_OBJECTS),
    "fixed_false_stars": (0, _MOST_OBJECTS),
    "false_star_magnitudes": (-5.0, 20.0),
    "missing_stars": (0, _MOST_OBJECTS),
    "cosmic_rays_s": (0.0, 1e6),
}


@dataclass(frozen=True)
class SkyObjects:
    """All that is in the field or before it besides the stars.

    Attributes
    ----------
    moon, sun, earth : optional
        The bodies, where there are.
    planets : tuple of PointSource
        Points of light at fixed directions.
    obstructions : tuple of Obstruction
        What covers parts of the image.
    false_stars : int
        Points of light at random places, others in every frame.
    fixed_false_stars : int
        Points of light at random places of the image, the same in all frames of a run.
    false_star_magnitudes : (float, float)
        Their magnitudes are uniform between these.
    missing_stars : int
        That many of the brightest catalogue stars of the field are not drawn.
    cosmic_rays_s : float
        Mean number of particles that cross the detector in a second, each leaving a streak.
    blank : bool
        No light at all reaches the detector.

    Raises
    ------
    EmulatorError
        A value is out of range.
    """

    moon: Moon | None = None
    sun: SunGlare | None = None
    earth: EarthLimb | None = None
    planets: tuple[PointSource, ...] = ()
    obstructions: tuple[Obstruction, ...] = ()
    false_stars: int = 0
    fixed_false_stars: int = 0
    false_star_magnitudes: tuple[float, float] = (1.0, 5.5)
    missing_stars: int = 0
    cosmic_rays_s: float = 0.0
    blank: bool = False

    def __post_init__(self) -> None:
        for body in (self.moon, self.sun, self.earth, *self.planets, *self.obstructions):
            if body is not None:
                _check(type(body).__name__, body)
        _check("SkyObjects", self)
        low, high = self.false_star_magnitudes
        if low > high:
            raise EmulatorError(
                f"sky false_star_magnitudes: {low} to {high} given, the brighter one comes first"
            )

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Sky objects from plain values, as TOML and JSON hold them.

        Keys are those of this class; bodies are tables with the keys of theirs, lists of tables for `planets` and
        `obstructions`. `blocked_share` stands for one obstruction with a straight edge.
        """
        given = dict(values)
        share = given.pop("blocked_share", None)
        for name, kind in (("moon", Moon), ("sun", SunGlare), ("earth", EarthLimb)):
            if given.get(name) is not None:
                given[name] = _body(name, kind, given[name])
        for name, element in (("planets", PointSource), ("obstructions", Obstruction)):
            rows = given.get(name, ())
            if not isinstance(rows, (list, tuple)):
                raise EmulatorError(f"sky {name}: a list of tables is needed")
            given[name] = tuple(_body(name, element, row) for row in rows)
        if share is not None and share != 0:
            given["obstructions"] = (
                *given["obstructions"],
                _body("blocked_share", Obstruction, {"share": share}),
            )
        if "false_star_magnitudes" in given:
            given["false_star_magnitudes"] = _pair("false_star_magnitudes", given["false_star_magnitudes"])
        made: Self = _body("", cls, given)
        return made

    @property
    def any_light_or_cover(self) -> bool:
        """Whether something changes the sky's light over areas."""
        return bool(self.moon or self.sun or self.earth or self.obstructions or self.blank)


def _pair(name: str, value: Any) -> tuple[float, float]:
    """Two numbers."""
    if not isinstance(value, (list, tuple)) or len(value) != 2:
        raise EmulatorError(f"sky {name}: {value!r} given, two numbers needed")
    return (value[0], value[1])


def _body(name: str, kind: Any, values: Any) -> Any:
    """Make one of the classes above from a table, or pass one that is made."""
    where = f"sky {name}".strip()
    if isinstance(values, kind):
        return values
    if not isinstance(values, Mapping):
        raise EmulatorError(f"{where}: {values!r} given, a table needed")
    fields = {field.name: field for field in dataclasses.fields(kind)}
    unknown = sorted(values.keys() - fields.keys())
    if unknown:
        raise EmulatorError(f"{where}: unknown key {unknown[0]!r}; known are {', '.join(sorted(fields))}")
    required = {key for key, field in fields.items() if field.default is dataclasses.MISSING}
    missing = sorted(required - values.keys())
    if missing:
        raise EmulatorError(f"{where}: key {missing[0]!r} is missing")
    chosen = dict(values)
    if "polygon_px" in chosen:
        if not isinstance(chosen["polygon_px"], (list, tuple)):
            raise EmulatorError(f"{where}: polygon_px is a list of corners [x, y]")
        chosen["polygon_px"] = tuple(_pair("polygon_px", corner) for corner in chosen["polygon_px"])
    return kind(**chosen)


def _flat(value: Any) -> Iterator[Any]:
    """Each value of a tuple, of the tuples in it, or the value itself."""
    if isinstance(value, tuple):
        for element in value:
            yield from _flat(element)
    else:
        yield value


def _check(where: str, body: Any) -> None:
    """Check the values of one of the classes above."""
    for field in dataclasses.fields(body):
        value = getattr(body, field.name)
        if type(field.default) is bool and not isinstance(value, bool):
            raise EmulatorError(f"sky {where} {field.name}: {value!r} given, true or false needed")
        if type(field.default) is str and not isinstance(value, str):
            raise EmulatorError(f"sky {where} {field.name}: {value!r} given, a text needed")
        if field.name not in _RANGES:
            continue
        low, high = _RANGES[field.name]
        whole = isinstance(low, int)
        for number in _flat(value):
            good = isinstance(number, int if whole else (int, float)) and not isinstance(number, bool)
            if not good or not low <= number <= high:
                kind = "a whole number" if whole else "a number"
                raise EmulatorError(
                    f"sky {where} {field.name}: {number!r} given, {kind} {low:g}…{high:g} needed"
                )
