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

LEAP_SECONDS: Final = """KPL/LSK
\\begindata
DELTET/DELTA_T_A = ( 32.184 )
DELTET/K = ( 1.657D-3 )
DELTET/EB = ( 1.671D-2 )
DELTET/M = ( 6.239996D0 1.99096871D-7 )
DELTET/DELTA_AT = ( {} )
\\begintext
"""
"""A leap-seconds kernel: SPICE's definition of ET."""

CLOCK: Final = f"""KPL/SCLK
\\begindata
SCLK_KERNEL_ID = ( @2000-01-01 )
SCLK_DATA_TYPE_$ = ( 1 )
SCLK_PARTITION_START_$ = ( 0 )
SCLK_PARTITION_END_$ = ( {4294967295 * TICKS_PER_S} )
SCLK01_TIME_SYSTEM_$ = ( 2 )
SCLK01_N_FIELDS_$ = ( 2 )
SCLK01_MODULI_$ = ( 4294967296 {TICKS_PER_S} )
SCLK01_OFFSETS_$ = ( 0 0 )
SCLK01_OUTPUT_DELIM_$ = ( 1 )
SCLK01_COEFFICIENTS_$ = ( 0 {{!r}} 1 )
\\begintext
"""
"""A kernel of the clock with the number $: ticks from a terrestrial time, seconds past J2000."""

META: Final = """KPL/MK
\\begindata
KERNELS_TO_LOAD = ( {} )
\\begintext
"""

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
        blocks = [rows for name in kernels for rows in _segments(spice, name)]
    return truth_of(path, blocks, smooth=False)


def _segments(spice: Any, kernel: str) -> list[list[Row]]:
    """Return the rows of each segment of a CK."""
    segments = []
    handle = spice.dafopr(kernel)
    try:
        spice.dafbfs(handle)
        while spice.daffna():
            summary = spice.dafgs(5)
            (begin, end), (structure, _, kind, has_rates, *_) = spice.dafus(summary, 2, 6)
            clock = spice.ckmeta(structure, "SCLK")
            if kind == FORWARD:
                count = spice.cknr03(handle, summary)
                ticks = [spice.ckgr03(handle, summary, number)[0] for number in range(1, count + 1)]
            else:
                first, last = (spice.sct2e(clock, tick) for tick in (begin, end))
                count = min(int((last - first) / STEP_S) + 2, MAX_ROWS)
                inner = [spice.sce2c(clock, et) for et in np.linspace(first, last, count)[1:-1]]
                ticks = [begin, *inner, end]
            segments.append((structure, ticks, bool(has_rates)))
    finally:
        spice.dafcls(handle)
    # SPICE has one search at a time, which reading attitudes would end
    return [
        [_row(spice, structure, tick, has_rates=has_rates) for tick in ticks]
        for structure, ticks, has_rates in segments
    ]


def _row(spice: Any, structure: int, tick: float, *, has_rates: bool) -> Row:
    rate, orbit = None, None
    if has_rates:
        matrix, rate, _ = spice.ckgpav(structure, tick, 0.0, "J2000")
        rate = matrix @ rate
    else:
        matrix, _ = spice.ckgp(structure, tick, 0.0, "J2000")
    et = spice.sct2e(spice.ckmeta(structure, "SCLK"), tick)
    if spice.ktotal("SPK"):
        state, _ = spice.spkez(spice.ckmeta(structure, "SPK"), et, "J2000", "NONE", EARTH)
        orbit = OrbitState(1e3 * state[:3], 1e3 * state[3:])
    unix_s = et - spice.deltet(et, "ET") + J2000_UNIX_S
    return Row(round(unix_s * NANOSECONDS), Attitude.from_matrix(matrix), rate, orbit)


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
        clock = CLOCK.replace("$", str(-structure // 1000)).format(spice.unitim(begin_et, "ET", "TDT"))
        files[".tsc"].write_text(clock, encoding="ascii")
        handle = spice.ckopn(str(files[".bc"]), "starhil", 0)
        spice.ckw03(
            handle, ticks[0], ticks[-1], structure, "J2000", truth.rates_rad_s is not None, "starhil",
            len(ticks), ticks, [spice.m2q(matrix) for matrix in matrices], rates, 1, ticks[:1],
        )  # fmt: skip
        spice.ckcls(handle)
        names = ", ".join(f"'{file.name}'" for file in files.values())
        path.write_text(META.format(names), encoding="ascii")


def _leap_seconds() -> str:
    """Return a leap-seconds kernel with the table of `erfa`."""
    import erfa

    return LEAP_SECONDS.format("\n".join(
        f"{row['tai_utc']:g}, @{row['year']}-{row['month']:02d}-01"
        for row in erfa.leap_seconds.get()
        if row["year"] >= 1972
    ))  # fmt: skip
