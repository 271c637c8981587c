"""The sky of a run: objects at typed directions, and what follows from date and orbit."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal, TypeAlias

from starhil.emulator.sensor.sky.ephemeris import (
    Observer,
    Vector,
    earth_seen_by,
    hidden_by,
    moon_seen_by,
    planets_seen_by,
    sun_seen_by,
)
from starhil.emulator.sensor.sky.objects import EarthLimb, Moon, SkyObjects, SunGlare
from starhil.emulator.sensor.sky.satellites import Satellites

BodySource: TypeAlias = Literal["typed", "ephemeris"]
"""Where Sun, Moon, Earth and planets are: only where they are typed in, or where the date puts them."""

PLACE: Final = ("ra_deg", "dec_deg")
"""Keys of a body's direction."""

_ANYWHERE: Final = dict.fromkeys(PLACE, 0.0)
_STYLES: Final[dict[str, Any]] = {
    "sun": SunGlare(**_ANYWHERE, exclusion_deg=30.0, reach_deg=90.0),
    "moon": Moon(**_ANYWHERE, reach_deg=90.0),
    "earth": EarthLimb(**_ANYWHERE),
}
"""Defaults of the bodies that the date places."""

DATE_FIELDS: Final = {
    "sun": (),
    "moon": ("diameter_deg", "magnitude", "illuminated", "bright_limb_deg"),
    "earth": ("radius_deg", "atmosphere_deg", "sun_ra_deg", "sun_dec_deg"),
}
"""Fields that follow from the date, besides the direction."""


@dataclass(frozen=True)
class SkyView:
    """What a sensor sees at one time: objects, the observer by whose motion the stars are displaced, and satellites."""

    objects: SkyObjects
    observer: Observer | None = None
    satellites: Satellites | None = None


def has_aberration(values: Mapping[str, Any]) -> Any:
    """Return whether a table `[sky]` shows stars with aberration: its key `aberration`, else whether it has a date."""
    return values.get("aberration", values.get("date") is not None or values.get("bodies") == "ephemeris")


class Sky:
    """The sky of a table `[sky]` in a profile (`starhil.emulator.sensor.sky.tables`): the fields of `SkyObjects`, and three more.

    - `date`: set if the stars are to be seen with aberration and parallax;
    - `bodies`: a `BodySource`; with `ephemeris`, a table `sun`, `moon` or `earth` with a direction replaces
      the body of the date;
    - `aberration`: false for stars without aberration and parallax all the same.

    A table `sun`, `moon` or `earth` without a direction does not place the body, but gives its look wherever the date
    or a fault puts it.
    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        fields = dict(values)
        fields.pop("date", None)
        self.by_date = fields.pop("bodies", "typed") == "ephemeris"
        """Whether the date places Sun, Moon, Earth and planets."""
        self._moving = has_aberration(values)
        fields.pop("aberration", None)
        self._looks = {name: _look(fields.get(name)) for name in _STYLES}
        """Fields of bodies in the profile, without the directions: they also hold for bodies of the date and of faults."""
        self._styles = {
            name: _styled(name, style if self.by_date else type(style)(**_ANYWHERE), fields)
            for name, style in _STYLES.items()
        }
        self._fields = fields
        self._typed = SkyObjects.from_dict(fields)

    def view(
        self,
        unix_s: float | None = None,
        position_m: Vector | None = None,
        velocity_m_s: Vector | None = None,
        faults: Mapping[str, Any] | None = None,
    ) -> SkyView:
        """Return the sky at a date, Unix time (None: only bodies that are given), and a place.

        Position and velocity (3,) are relative to the Earth's centre, GCRS; None: at the centre. Faults are fields of
        `SkyObjects` that replace the profile's; of a body, its fields.
        """
        objects = self._with_faults(faults) if faults else self._typed
        if unix_s is None:
            return SkyView(objects)
        observer = Observer(unix_s, position_m, velocity_m_s)
        satellites = None
        if objects.satellites is not None and position_m is not None and velocity_m_s is not None:
            satellites = Satellites(objects.satellites, unix_s, position_m, velocity_m_s, observer.to_sun)
        if self.by_date:
            objects = self._with_bodies(objects, observer)
        return SkyView(objects, observer if self._moving else None, satellites)

    def _with_faults(self, faults: Mapping[str, Any]) -> SkyObjects:
        """Return the typed objects, changed by faults; a body that a fault places looks as in the profile."""
        fields = {**self._fields, **faults}
        for name, look in self._looks.items():
            if isinstance(faults.get(name), Mapping):
                fields[name] = {**look, **faults[name]}
        return SkyObjects.from_dict(fields)

    def _with_bodies(self, objects: SkyObjects, observer: Observer) -> SkyObjects:
        """Add the bodies of the date, except given ones and bodies hidden by the Earth."""
        changes: dict[str, Any] = {"planets": objects.planets + planets_seen_by(observer)}
        earth = objects.earth or earth_seen_by(observer, self._styles["earth"])
        changes["earth"] = earth
        if objects.sun is None:
            changes["sun"] = sun_seen_by(observer, self._styles["sun"], earth)
        if objects.moon is None:
            moon = moon_seen_by(observer, self._styles["moon"])
            if not hidden_by(earth, moon):
                changes["moon"] = moon
        return dataclasses.replace(objects, **changes)


def _look(table: Any) -> dict[str, Any]:
    """Return the fields of a body's table except its direction."""
    fields = table if isinstance(table, Mapping) else {}
    return {key: value for key, value in fields.items() if key not in PLACE}


def _styled(name: str, style: Any, fields: dict[str, Any]) -> Any:
    """Return the defaults of a body, changed by its table if that has no direction; the table is then removed."""
    table = fields.get(name)
    if table is None or not table.keys().isdisjoint(PLACE):
        return style
    del fields[name]
    return dataclasses.replace(style, **table)
