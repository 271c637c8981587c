"""Pointing requests of a page (a slew, a turn or a fixed attitude), converted to the truth of the body."""

from __future__ import annotations

import re
from typing import Any, Final

import numpy as np
from pydantic import ValidationError

from starhil.emulator.errors import EmulatorError
from starhil.emulator.truth.config import AttitudeConfig
from starhil.protocol.files.validation import problems
from starid.attitude import Attitude
from starid.catalog import load_catalog
from starid.catalog.star_names import STAR_NAMES

DEFAULT_RATE_DEG_S: Final = 0.5
MAX_NUMBER: Final = 1e12

_HIP: Final = re.compile(r"(?:HIP\s*)?(\d{1,9})", re.IGNORECASE)


def pointing_request(
    motion: dict[str, Any],
    truth: dict[str, Any],
    mount: Attitude | None,
    catalog_path: str | None,
    epoch: float,
) -> dict[str, Any]:
    """Return the control channel request that sets the truth.

    Parameters
    ----------
    motion
        `kind`: `slew`, `rate` or `fixed`. For `slew` and `fixed`, `to` has `star` (a name, or HIP and a
        number), or `ra_deg` and `dec_deg`; without `roll_deg`, the roll is kept. An empty `to` is the current
        attitude. `slew` also has `max_rate_deg_s`, and `rate` has `rate_deg_s`: three numbers, sensor frame.
    truth
        Current truth of the sensor, in the format of the control channel's answer.
    mount
        Rotation body→sensor; None if the frames are equal.
    catalog_path, epoch
        The star catalogue.
    """
    to_body = np.eye(3) if mount is None else mount.matrix.T
    here = Attitude(np.array(truth["quaternion_xyzw"]))

    def of_body(sensor: Attitude) -> dict[str, Any]:
        return {"quaternion_xyzw": Attitude.from_matrix(to_body @ sensor.matrix).quaternion_xyzw.tolist()}

    kind = motion.get("kind")
    content: dict[str, Any] = {"attitude": of_body(here)}
    if kind == "rate":
        rate = motion.get("rate_deg_s")
        if not isinstance(rate, list) or len(rate) != 3 or not all(map(is_number, rate)):
            raise EmulatorError("rate_deg_s: three numbers are needed")
        content["rate_deg_s"] = (to_body @ np.array(rate)).tolist()
    elif kind in ("slew", "fixed"):
        target = of_body(_target(motion.get("to") or {}, here, catalog_path, epoch))
        if kind == "slew":
            speed = motion.get("max_rate_deg_s") or DEFAULT_RATE_DEG_S
            content["segments"] = [{"do": "slew", "to": target, "max_rate_deg_s": speed}]
        else:
            content["attitude"] = target
    else:
        raise EmulatorError("kind: must be slew, rate or fixed")
    return {"do": "set_truth", "truth": {"kind": kind, **content}}


def is_number(value: object) -> bool:
    """Return whether a value is a number with which the truth can be computed."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < MAX_NUMBER


def _target(to: dict[str, Any], here: Attitude, catalog_path: str | None, epoch: float) -> Attitude:
    """Return the attitude of the sensor that a page requests."""
    if not to:
        return here
    target = {key: to[key] for key in ("ra_deg", "dec_deg", "roll_deg") if to.get(key) is not None}
    if to.get("star"):
        target["ra_deg"], target["dec_deg"] = find_star(str(to["star"]), catalog_path, epoch)
    target.setdefault("roll_deg", here.roll_deg)
    try:
        return AttitudeConfig.model_validate(target).build()
    except ValidationError as error:
        raise EmulatorError(*map(str, problems(error, AttitudeConfig, target))) from None


def find_star(text: str, catalog_path: str | None, epoch: float) -> tuple[float, float]:
    """Return right ascension and declination, degrees, of a star by name or Hipparcos number."""
    star = text.strip()
    named = {name.lower(): hip for hip, name in STAR_NAMES.items()}
    number = _HIP.fullmatch(star)
    hip = int(number[1]) if number is not None else named.get(star.lower())
    if hip is None:
        raise EmulatorError(f"star {star!r}: unknown; give a proper name such as Rigel, or HIP and a number")
    catalog = load_catalog(catalog_path, epoch)
    rows = np.flatnonzero(catalog.hip == hip)
    if len(rows) == 0:
        raise EmulatorError(f"star HIP {hip}: not in the catalogue")
    return float(np.degrees(catalog.ra_rad[rows[0]])), float(np.degrees(catalog.dec_rad[rows[0]]))
