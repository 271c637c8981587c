"""Truth files in CSV, and truth logs.

A truth file has one header line. Columns, in any order:

- ``t``: simulation time in seconds, increasing from row to row;
- either ``qx, qy, qz, qw`` (quaternion ICRS→sensor, scalar last) or ``ra_deg, dec_deg, roll_deg``;
- optional ``wx_deg_s, wy_deg_s, wz_deg_s``: body rate in the sensor frame. Without them, the rate between two rows is
  constant;
- optional ``x_m, y_m, z_m, vx_m_s, vy_m_s, vz_m_s``: position and velocity relative to the Earth's centre, GCRS,
  with cubic interpolation.

A truth log (`starhil run --truth-log`) is accepted too, to repeat a run: the columns ``run_time_s``, ``true_qx`` …
``true_qw`` and ``true_wx_deg_s`` … are used, the others ignored.

Empty lines and lines that begin with ``#`` are ignored.
"""

from __future__ import annotations

import csv
import math
from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from starhil.emulator.errors import EmulatorError
from starhil.emulator.truth.feed_message import checked_attitude
from starhil.emulator.truth.feed_rates import SHORTEST_S, FeedError
from starhil.emulator.truth.orbit import OrbitState
from starhil.emulator.truth.plausibility import doubt_between, doubt_of_orbit
from starhil.emulator.truth.source import MAX_RATE_DEG_S
from starhil.emulator.truth.table import FileTruth
from starhil.protocol.files.user_file import read_user_text
from starid.attitude import Attitude, rate_between
from starid.storage.files import read_number

QUATERNION_COLUMNS: Final = ("qx", "qy", "qz", "qw")
ANGLE_COLUMNS: Final = ("ra_deg", "dec_deg", "roll_deg")
RATE_COLUMNS: Final = ("wx_deg_s", "wy_deg_s", "wz_deg_s")
POSITION_COLUMNS: Final = ("x_m", "y_m", "z_m")
VELOCITY_COLUMNS: Final = ("vx_m_s", "vy_m_s", "vz_m_s")
ORBIT_COLUMNS: Final = (*POSITION_COLUMNS, *VELOCITY_COLUMNS)

MAX_LOG_BYTES: Final = 500_000_000
LATEST_S: Final = 2e11
"""Largest number of seconds in a truth log: 6000 years."""

LOG_COLUMNS: Final = {
    "run_time_s": "t",
    **{f"true_{name}": name for name in (*QUATERNION_COLUMNS, *RATE_COLUMNS)},
}
"""Column of a truth log → column of a truth file."""

BOUNDS: Final = {
    "t": 1e9,
    **dict.fromkeys(QUATERNION_COLUMNS, 1e9),
    "ra_deg": 1e6,
    "dec_deg": 90.0,
    "roll_deg": 1e6,
    **dict.fromkeys(RATE_COLUMNS, MAX_RATE_DEG_S),
    **dict.fromkeys(POSITION_COLUMNS, 1e12),
    **dict.fromkeys(VELOCITY_COLUMNS, 1e5),
}
"""Largest absolute value in each column; right ascension and roll may exceed a full turn."""


def read_csv(path: Path, text: str) -> FileTruth:
    """Read the text of a truth file; a message names the line of the fault but does not quote it."""
    lines = [
        (n, line) for n, line in enumerate(text.splitlines(), 1) if line.strip() and line.strip()[0] != "#"
    ]
    if not lines:
        raise EmulatorError(f"truth file {path}: empty; the first line names the columns, e.g. t,qx,qy,qz,qw")
    columns = [name.strip() for name in _cells(f"truth file {path} line {lines[0][0]}", lines[0][1])]
    if "run_time_s" in columns and "true_qx" in columns:
        columns = [LOG_COLUMNS.get(name, "") for name in columns]
    needed = _attitude_columns(f"truth file {path} line {lines[0][0]}", columns)
    has_rates, has_orbit = RATE_COLUMNS[0] in columns, POSITION_COLUMNS[0] in columns
    times: list[float] = []
    attitudes: list[Attitude] = []
    rates: list[list[float]] = []
    orbit: list[OrbitState] = []
    for (before, _), (number, line) in pairwise(lines):
        where = f"truth file {path} line {number}"
        row = _parse_row(where, columns, line)
        if times and row["t"] - times[-1] < SHORTEST_S:
            raise EmulatorError(
                f"{where}: t is not later than in the previous row, by at least {SHORTEST_S:g} s"
            )
        times.append(row["t"])
        attitudes.append(_attitude(where, needed, row))
        if has_orbit:
            position, velocity = (
                [row[name] for name in names] for names in (POSITION_COLUMNS, VELOCITY_COLUMNS)
            )
            orbit.append(OrbitState(np.array(position), np.array(velocity)))
            doubt = doubt_of_orbit(orbit[-1])
            if doubt:
                raise EmulatorError(f"{where}: {doubt}")
            doubt = doubt_between(orbit[-2], orbit[-1], times[-1] - times[-2]) if orbit[1:] else ""
            if doubt:
                raise EmulatorError(f"truth file {path} line {before}: {doubt}")
        if has_rates:
            rates.append([math.radians(row[name]) for name in RATE_COLUMNS])
        elif len(times) > 1:
            rate = np.degrees(rate_between(attitudes[-2], attitudes[-1], times[-1] - times[-2]))
            if np.abs(rate).max() > MAX_RATE_DEG_S:
                raise EmulatorError(
                    f"{where}: the rotation from the previous row is faster than {MAX_RATE_DEG_S:g} degrees per second; "
                    f"give {', '.join(RATE_COLUMNS)} if the attitude jumps"
                )
    if not times:
        raise EmulatorError(f"truth file {path}: no rows after the header; add at least one")
    rate_array = np.array(rates) if has_rates else None
    return FileTruth(np.array(times), attitudes, rate_array, orbit=orbit if has_orbit else None)


def read_log(path: Path, *, measured: bool) -> FileTruth:
    """Read the true attitudes of a truth log, or its valid measurements, with the dates of the device's clock.

    Rates are those of the truth; a measured attitude may have none.
    """
    prefix = "measured_" if measured else "true_"
    needed = [prefix + name for name in QUATERNION_COLUMNS]
    try:
        rows = list(csv.DictReader(read_user_text(path, MAX_LOG_BYTES).splitlines()))
        valid = [row for row in rows if row[needed[0]]]
        first_s, run_s = (_in_bounds(rows[0][name]) for name in ("time_of_exposure_s", "run_time_s"))
        start_unix_s = round(first_s - run_s, 6)
        times = np.array([_in_bounds(row["run_time_s"]) for row in valid])
        attitudes = [Attitude(np.array([read_number(row[name]) for name in needed])) for row in valid]
        rates = (
            None
            if measured
            else [[read_number(row[f"true_{name}"]) for name in RATE_COLUMNS] for row in valid]
        )
    except (
        OSError,
        UnicodeDecodeError,
        csv.Error,
        KeyError,
        ValueError,
        TypeError,
        AttributeError,
        IndexError,
    ):
        raise EmulatorError(
            f"{path}: not a truth log with rows; of other files without dates, give --date"
        ) from None
    radians = None if rates is None else np.radians(rates)
    return FileTruth(times, attitudes, radians, start_unix_s=start_unix_s)


def _in_bounds(cell: str) -> float:
    """Return a time or date, seconds; ValueError for one that no clock has."""
    seconds = read_number(cell)
    if abs(seconds) > LATEST_S:
        raise ValueError(f"{cell}: no date")
    return seconds


def _cells(where: str, line: str) -> list[str]:
    try:
        return next(csv.reader([line]))
    except csv.Error as error:
        raise EmulatorError(f"{where}: not CSV ({error})") from None


def _attitude_columns(where: str, columns: list[str]) -> tuple[str, ...]:
    readable = {"t", *QUATERNION_COLUMNS, *ANGLE_COLUMNS, *RATE_COLUMNS, *ORBIT_COLUMNS}
    unknown = [name for name in columns if name not in readable | {""}]
    if unknown:
        number = columns.index(unknown[0]) + 1
        raise EmulatorError(f"{where}: column {number} is unknown; known: {', '.join(sorted(readable))}")
    twice = next((name for name, count in Counter(columns).items() if name and count > 1), None)
    if twice is not None:
        raise EmulatorError(f"{where}: column {twice} appears twice; remove one")
    for group in (RATE_COLUMNS, ORBIT_COLUMNS):
        missing = [name for name in group if name not in columns]
        if 0 < len(missing) < len(group):
            raise EmulatorError(f"{where}: column {missing[0]} is missing; give {', '.join(group)} or none")
    both = [[name for name in names if name in columns] for names in (QUATERNION_COLUMNS, ANGLE_COLUMNS)]
    if all(both):
        raise EmulatorError(
            f"{where}: columns {', '.join(both[0])} and {', '.join(both[1])} both give the attitude; remove one set"
        )
    for needed in (QUATERNION_COLUMNS, ANGLE_COLUMNS):
        if "t" in columns and all(name in columns for name in needed):
            return needed
    raise EmulatorError(f"{where}: must have column t and either qx, qy, qz, qw or ra_deg, dec_deg, roll_deg")


def _parse_row(where: str, columns: list[str], line: str) -> dict[str, float]:
    cells = _cells(where, line)
    if len(cells) != len(columns):
        raise EmulatorError(f"{where}: {len(cells)} values for {len(columns)} columns")
    row: dict[str, float] = {}
    for name, cell in zip(columns, cells, strict=True):
        if not name:
            continue
        try:
            row[name] = read_number(cell)
        except ValueError:
            raise EmulatorError(f"{where}: {name} is not a number") from None
        if abs(row[name]) > BOUNDS[name]:
            raise EmulatorError(f"{where}: {name} is outside ±{BOUNDS[name]:g}")
    return row


def _attitude(where: str, needed: tuple[str, ...], row: dict[str, float]) -> Attitude:
    values = [row[name] for name in needed]
    if needed is ANGLE_COLUMNS:
        return Attitude.from_radec_roll(*values)
    try:
        return checked_attitude("the quaternion", np.array(values), "rotation")
    except FeedError as error:
        raise EmulatorError(f"{where}: {error}") from None
