"""The keys of `[sky]` in a profile, and of optical faults: those of the sky objects, and a few more."""

from __future__ import annotations

from typing import Annotated, Final, Self

from pydantic import BaseModel, Field, model_validator

from starhil.emulator.sensor.sky.objects import BODY_KINDS, SkyObjects
from starhil.emulator.sensor.sky.view import DATE_FIELDS, PLACE, BodySource
from starhil.emulator.simulation.config_model import Date, Strict, model_of


class _ObjectKeys(Strict):
    """Keys of optical faults besides those of the sky objects."""

    blocked_share: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """Fraction of the image beyond a straight edge of an object near the lens."""


class _SkyKeys(_ObjectKeys):
    """Keys of `[sky]` besides those of the sky objects."""

    date: Date | None = None
    bodies: BodySource = "typed"
    aberration: bool | None = None

    @model_validator(mode="after")
    def _nothing_computed_is_given(self) -> Self:
        for name, fields in DATE_FIELDS.items() if self.bodies == "ephemeris" else ():
            body = getattr(self, name)
            keys = (
                () if body is None or not body.model_fields_set.isdisjoint(PLACE) else body.model_fields_set
            )
            for field in fields:
                if field in keys:
                    raise ValueError(
                        f"{name}.{field} follows from the date; leave it out, or give ra_deg and dec_deg"
                    )
        return self


class _BodyKeys(Strict):
    """A body that may lack its direction: its other keys then hold wherever the date or a fault places it."""

    @model_validator(mode="after")
    def _whole_direction(self) -> Self:
        for given, other in (PLACE, PLACE[::-1]):
            if given in self.model_fields_set and other not in self.model_fields_set:
                raise ValueError(f"{other} is missing; a direction is ra_deg and dec_deg")
        return self


OPTICAL_FAULT: Final[type[BaseModel]] = model_of(SkyObjects, _ObjectKeys)
"""Objects that a fault adds to the sky of the profile."""

SKY: Final[type[BaseModel]] = model_of(
    SkyObjects,
    _SkyKeys,
    replaced={name: model_of(kind, _BodyKeys, optional=PLACE) | None for name, kind in BODY_KINDS.items()},
)
"""Table `[sky]` of a profile."""
