"""SPICE kernels: attitudes from a CK, positions from an SPK, both by `spiceypy`, which is optional.

A truth file is a meta-kernel (``KPL/MK``) that loads the CK, its clock (SCLK) and the leap seconds (LSK); like all
programs that use SPICE, this one finds relative names from the working directory. An SPK in it gives the position
relative to the Earth of the spacecraft to which the structure of the CK belongs: of -44000, that is -44.

SPICE transforms to J2000, which is ICRS there, and interpolates. Rows are SPICE's at the times of the records of
segments of type 3, between which the rotation is uniform, and at steps of `STEP_S` in segments of other types.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np

from starhil.emulator.errors import EmulatorError
from starhil.emulator.truth.orbit import OrbitState
from starhil.emulator.truth.standard_frames import NANOSECONDS, Row, truth_of
from starhil.emulator.truth.table import FileTruth
from starid.attitude import Attitude

META_KERNEL: Final = "KPL/MK"
STEP_S: Final = 0.1
MAX_ROWS: Final = 2_000_000
J2000_UNIX_S: Final = 946_728_000.0
"""2000-01-01T12:00:00 UTC, from which SPICE counts."""

EARTH: Final = 399
FORWARD: Final = 3
"""Type of segments whose records can be read one by one."""

TICKS_PER_S: Final = 1_000_000
"""Resolution of the clock of a written CK."""

_LOCK: Final = threading.Lock()
"""SPICE has one set of kernels for the whole process."""


def load_spice() -> Any:
    """Return the module `spiceypy`."""
    try:
        import spiceypy
    except ImportError:
        raise EmulatorError("SPICE kernels need the package spiceypy: pip install 'starhil[spice]'") from None
    return spiceypy


@contextmanager
def _kernels(spice: Any, path: Path) -> Iterator[None]:
    """Have SPICE for oneself, without kernels before and after."""
    with _LOCK:
        spice.kclear()
        try:
            yield
        except spice.exceptions.SpiceyError as error:
            raise EmulatorError(
                f"{path}: SPICE: {' '.join(str(error.long or error.short).split())}"
            ) from None
        finally:
            spice.kclear()


def read_kernels(path: Path) -> FileTruth:
    """Read the attitudes of the one structure that the CK of a meta-kernel has, and its positions if it has an SPK."""
    spice = load_spice()
    with _kernels(spice, path):
        spice.furnsh(str(path))
        kernels = [spice.kdata(index, "CK")[0] for index in range(spice.ktotal("CK"))]
        structures = {structure for name in kernels for structure in spice.ckobj(name)}
        if len(structures) != 1:
            raise EmulatorError(
                f"truth file {path}: its CKs have {len(structures)} structures, must have one"
            )
        structure = structures.pop()
        segments = [ticks for name in kernels for ticks in _ticks(spice, name)]
        blocks = [_rows(spice, structure, ticks) for ticks in segments]
    return truth_of(path, blocks, smooth=False)


def _ticks(spice: Any, kernel: str) -> Iterator[np.ndarray[Any, Any]]:
    """Yield the clock's ticks at which each segment of a CK is read."""
    handle = spice.dafopr(kernel)
    try:
        spice.dafbfs(handle)
        while spice.daffna():
            summary = spice.dafgs(5)
            (begin, end), (structure, _, kind, *_) = spice.dafus(summary, 2, 6)
            if kind == FORWARD:
                count = spice.cknr03(handle, summary)
                yield np.array([spice.ckgr03(handle, summary, number)[0] for number in range(1, count + 1)])
            else:
                clock = spice.ckmeta(structure, "SCLK")
                first, last = (spice.sct2e(clock, ticks) for ticks in (begin, end))
                count = min(int((last - first) / STEP_S) + 2, MAX_ROWS)
                inner = [spice.sce2c(clock, et) for et in np.linspace(first, last, count)[1:-1]]
                yield np.array([begin, *inner, end])
    finally:
        spice.dafcls(handle)


def _rows(spice: Any, structure: int, ticks: np.ndarray[Any, Any]) -> list[Row]:
    clock, spacecraft = spice.ckmeta(structure, "SCLK"), spice.ckmeta(structure, "SPK")
    has_orbit = spice.ktotal("SPK") > 0
    rows = []
    for tick in ticks:
        try:
            matrix, rate, _ = spice.ckgpav(structure, tick, 0.0, "J2000")
        except spice.exceptions.NotFoundError:  # no angular velocities in the CK
            matrix, _ = spice.ckgp(structure, tick, 0.0, "J2000")
            rate = None
        et = spice.sct2e(clock, tick)
        orbit = None
        if has_orbit:
            state, _ = spice.spkez(spacecraft, et, "J2000", "NONE", EARTH)
            orbit = OrbitState(1e3 * state[:3], 1e3 * state[3:])
        unix_s = et - spice.deltet(et, "ET") + J2000_UNIX_S
        attitude = Attitude.from_matrix(matrix)
        rows.append(
            Row(round(unix_s * NANOSECONDS), attitude, None if rate is None else matrix @ rate, orbit)
        )
    return rows


def write_kernels(truth: FileTruth, path: Path, structure: int) -> None:
    """Write the rows of a truth with dates as a CK, its clock, the leap seconds, and a meta-kernel of these.

    Parameters
    ----------
    path
        The meta-kernel; the others have its name and their own suffixes.
    structure
        Number of the sensor in the CK, at most -1000; that of the spacecraft and its clock is a thousandth of it.
    """
    spice = load_spice()
    files = {suffix: path.with_suffix(suffix) for suffix in (".tls", ".tsc", ".bc")}
    matrices = np.array([attitude.matrix for attitude in truth.attitudes])
    ticks = TICKS_PER_S * (truth.times_s - truth.times_s[0])
    rates = np.zeros((len(ticks), 3))
    if truth.rates_rad_s is not None:
        rates = np.einsum("nji,nj->ni", matrices, truth.rates_rad_s)
    with _kernels(spice, path):
        for file in files.values():
            file.unlink(missing_ok=True)  # SPICE does not overwrite
        files[".tls"].write_text(_leap_seconds(), encoding="ascii")
        spice.furnsh(str(files[".tls"]))
        begin_et = (truth.start_unix_s or 0.0) + float(truth.times_s[0]) - J2000_UNIX_S
        begin_et += spice.deltet(begin_et, "UTC")
        files[".tsc"].write_text(
            _clock(-structure // 1000, spice.unitim(begin_et, "ET", "TDT")), encoding="ascii"
        )
        handle = spice.ckopn(str(files[".bc"]), "starhil", 0)
        spice.ckw03(
            handle, ticks[0], ticks[-1], structure, "J2000", truth.rates_rad_s is not None, "starhil",
            len(ticks), ticks, [spice.m2q(matrix) for matrix in matrices], rates, 1, ticks[:1],
        )  # fmt: skip
        spice.ckcls(handle)
        names = ", ".join(f"'{file.name}'" for file in files.values())
        path.write_text(_kernel("MK", KERNELS_TO_LOAD=names), encoding="ascii")


def _leap_seconds() -> str:
    """Return a leap-seconds kernel: SPICE's definition of ET, and the table of `erfa`."""
    import erfa

    table = erfa.leap_seconds.get()
    rows = [
        f"{row['tai_utc']:g}, @{row['year']}-{row['month']:02d}-01" for row in table if row["year"] >= 1972
    ]
    constants = {"DELTA_T_A": "32.184", "K": "1.657D-3", "EB": "1.671D-2", "M": "6.239996D0 1.99096871D-7"}
    return _kernel(
        "LSK",
        **{f"DELTET/{name}": value for name, value in constants.items()},
        **{"DELTET/DELTA_AT": "\n".join(rows)},
    )


def _clock(number: int, begin_tt_s: float) -> str:
    """Return a clock kernel of ticks of `1 / TICKS_PER_S` from a terrestrial time, seconds past J2000."""
    of_type_1 = {
        "TIME_SYSTEM": "2",
        "N_FIELDS": "2",
        "MODULI": f"4294967296 {TICKS_PER_S}",
        "OFFSETS": "0 0",
        "OUTPUT_DELIM": "1",
        "COEFFICIENTS": f"0 {begin_tt_s!r} 1",
    }
    partition = {"START": "0", "END": f"{4294967295 * TICKS_PER_S}"}
    return _kernel(
        "SCLK",
        **{"SCLK_KERNEL_ID": "@2000-01-01", f"SCLK_DATA_TYPE_{number}": "1"},
        **{f"SCLK_PARTITION_{name}_{number}": value for name, value in partition.items()},
        **{f"SCLK01_{name}_{number}": value for name, value in of_type_1.items()},
    )


def _kernel(kind: str, **values: str) -> str:
    """Return a text kernel."""
    lines = "".join(f"{name} = ( {value} )\n" for name, value in values.items())
    return f"KPL/{kind}\n\\begindata\n{lines}\\begintext\n"
