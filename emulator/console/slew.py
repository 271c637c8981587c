"""A slew of the truth to a direction or a star."""

from __future__ import annotations

import re
from typing import Any, Final

import numpy as np

from starhil.emulator.errors import EmulatorError
from starid.catalog import load_catalog
from starid.star_names import STAR_NAMES

DEFAULT_RATE_DEG_S: Final = 0.5

_HIP: Final = re.compile(r"(?:HIP\s*)?(\d+)", re.IGNORECASE)


def slew_request(
    to: dict[str, Any], truth: dict[str, Any], max_rate_deg_s: object, catalog_path: str | None, epoch: float
) -> dict[str, Any]:
    """Return the control channel's request for a slew from the present truth.

    Parameters
    ----------
    to
        `star` (a name, or HIP and its number), or `ra_deg` and `dec_deg`; `roll_deg` is kept if left out.
    truth
        Present truth, as the control channel answers it.
    max_rate_deg_s
        Highest body rate; None for the default.
    catalog_path, epoch
        The star catalogue.

    Raises
    ------
    EmulatorError
        No such star.
    """
    target = {key: to[key] for key in ("ra_deg", "dec_deg", "roll_deg") if to.get(key) is not None}
    if to.get("star"):
        target["ra_deg"], target["dec_deg"] = find_star(str(to["star"]), catalog_path, epoch)
    target.setdefault("roll_deg", truth["roll_deg"])
    rate = DEFAULT_RATE_DEG_S if max_rate_deg_s is None else max_rate_deg_s
    return {
        "do": "set_truth",
        "truth": {
            "kind": "slew",
            "attitude": {"quaternion_xyzw": truth["quaternion_xyzw"]},
            "segments": [{"do": "slew", "to": target, "max_rate_deg_s": rate}],
        },
    }


def find_star(text: str, catalog_path: str | None, epoch: float) -> tuple[float, float]:
    """Return right ascension and declination, degrees, of a star by name or Hipparcos number.

    Raises
    ------
    EmulatorError
        There is no such star.
    """
    wanted = text.strip()
    named = {name.lower(): hip for hip, name in STAR_NAMES.items()}
    number = _HIP.fullmatch(wanted)
    hip = int(number[1]) if number is not None else named.get(wanted.lower())
    if hip is None:
        raise EmulatorError(
            f"star {wanted!r}: unknown; give a proper name such as Rigel, or HIP and its number"
        )
    catalog = load_catalog(catalog_path, epoch)
    rows = np.flatnonzero(catalog.hip == hip)
    if len(rows) == 0:
        raise EmulatorError(f"star HIP {hip}: not in the catalogue")
    return float(np.degrees(catalog.ra_rad[rows[0]])), float(np.degrees(catalog.dec_rad[rows[0]]))
