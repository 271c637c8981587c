"""SPICE kernels: attitudes from a CK, positions from an SPK, both by `spiceypy`, which is optional.

A truth file is a meta-kernel (``KPL/MK``) that loads the CK, its clock (SCLK) and the leap seconds (LSK); like all
programs that use SPICE, this one finds relative names from the working directory. An SPK in it gives the position
relative to the Earth of the spacecraft to which the structure of the CK belongs: of -44000, that is -44.

SPICE transforms to J2000, which is ICRS there, and interpolates. Rows are SPICE's at the times of the records of
segments of type 3, between which the rotation is uniform, and at steps of `STEP_S` in segments of other types, within
each interval for which the CK has attitudes. Segments of type 1 have none between their records, and are not read.
"""

from __future__ import annotations

import math
import threading
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from starhil.emulator.errors import EmulatorError
from starhil.emulator.truth.orbit import OrbitState
from starhil.emulator.truth.standard_frames import Block, Row, truth_of
from starhil.emulator.truth.table import FileTruth
from starhil.protocol.icd.conventions import NANOSECONDS
from starid.attitude import Attitude

META_KERNEL: Final = "KPL/MK"
STEP_S: Final = 0.1
MAX_ROWS: Final = 2_000_000
J2000_UNIX_S: Final = 946_728_000.0
"""2000-01-01T12:00:00 UTC, from which SPICE counts."""

EARTH: Final = 399
DISCRETE: Final = 1
"""Type of segments without attitudes between their records."""

UNIFORM: Final = 3
"""Type of segments whose records can be read one by one."""

NEEDS_RATES: Final = False
"""Whether SPICE is to leave out segments without rates."""

MAX_INTERVALS: Final = 200_000
"""Largest number of intervals of a CK."""

MAX_NAME: Final = 79
"""Longest name of a meta-kernel, such that the longest of the others fits into the 80 characters of a text in SPICE."""

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
            said = (
                getattr(error, "long", "") or getattr(error, "short", "") or str(error)
            )  # not all have both
            raise EmulatorError(f"{path}: SPICE: {' '.join(said.split())}") from None
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
        (structure,) = structures
        blocks = [block for name in kernels for block in _blocks(spice, path, name, structure)]
    return truth_of(path, blocks, smooth=False)


def _blocks(spice: Any, path: Path, kernel: str, structure: int) -> Iterator[Block[Row]]:
    """Yield the rows of each interval of each segment of a CK."""
    cell = spice.cell_double(2 * MAX_INTERVALS)
    covered = spice.ckcov(kernel, structure, NEEDS_RATES, "INTERVAL", 0.0, "SCLK", cell)
    intervals = [spice.wnfetd(covered, number) for number in range(spice.wncard(covered))]
    segments = []
    handle = spice.dafopr(kernel)
    try:
        spice.dafbfs(handle)
        while spice.daffna():
            summary = spice.dafgs(5)
            (begin, end), (_, _, kind, has_rates, *_) = spice.dafus(summary, 2, 6)
            if kind == DISCRETE:
                raise EmulatorError(
                    f"truth file {path}: a segment of type 1 in its CK has no attitudes between its records; "
                    "write it as type 3"
                )
            records = None
            if kind == UNIFORM:
                count = spice.cknr03(handle, summary)
                records = [spice.ckgr03(handle, summary, number)[0] for number in range(1, count + 1)]
            segments.append((begin, end, bool(has_rates), records))
    finally:
        spice.dafcls(handle)
    # SPICE has one search at a time, which reading attitudes would end
    last_that_begins = {begin: number for number, (begin, *_) in enumerate(segments, 1)}
    for number, (begin, end, has_rates, records) in enumerate(segments, 1):
        low = bisect_left(intervals, begin, key=lambda interval: interval[1])
        high = bisect_right(intervals, end, key=lambda interval: interval[0])
        for first, last in ((max(begin, first), min(end, last)) for first, last in intervals[low:high]):
            if records is None:
                ticks = _steps(spice, structure, first, last)
            else:
                ticks = records[bisect_left(records, first) : bisect_right(records, last)]
            dates_ns = [_unix_ns(spice, structure, tick) for tick in ticks]
            if len(ticks) > 1 and last_that_begins.get(ticks[-1], 0) > number:
                ticks[-1] = math.nextafter(ticks[-1], ticks[0])  # SPICE prefers the later segment
            rows = [_row(spice, structure, tick, has_rates=has_rates) for tick in ticks]
            if rows:
                yield Block(f"truth file {path}, segment {number}", dates_ns, rows)


def _steps(spice: Any, structure: int, first: float, last: float) -> list[float]:
    """Return times from one tick of a clock to another, at most `STEP_S` apart."""
    clock = spice.ckmeta(structure, "SCLK")
    begin, end = (spice.sct2e(clock, tick) for tick in (first, last))
    count = min(int((end - begin) / STEP_S) + 2, MAX_ROWS)
    inner = [spice.sce2c(clock, et) for et in np.linspace(begin, end, count)[1:-1]]
    return [first, *inner, *([last] if last > first else ())]


def _unix_ns(spice: Any, structure: int, tick: float) -> int:
    """Return the date of a tick as Unix time, nanoseconds."""
    et = spice.sct2e(spice.ckmeta(structure, "SCLK"), tick)
    unix_s = float(et - spice.deltet(et, "ET") + J2000_UNIX_S)
    return round(unix_s * NANOSECONDS)


def _row(spice: Any, structure: int, tick: float, *, has_rates: bool) -> Row:
    """Return what SPICE has at a tick."""
    rate, orbit = None, None
    if has_rates:
        matrix, rate, _ = spice.ckgpav(structure, tick, 0.0, "J2000")
        rate = matrix @ rate
    else:
        matrix, _ = spice.ckgp(structure, tick, 0.0, "J2000")
    if spice.ktotal("SPK"):
        et = spice.sct2e(spice.ckmeta(structure, "SCLK"), tick)
        state, _ = spice.spkez(spice.ckmeta(structure, "SPK"), et, "J2000", "NONE", EARTH)
        orbit = OrbitState(1e3 * state[:3], 1e3 * state[3:])
    return Row(Attitude.from_matrix(matrix), rate, orbit)


def write_kernels(truth: FileTruth, path: Path, structure: int) -> None:
    """Write the spans of a truth with dates as segments of a CK, its clock, the leap seconds, and a meta-kernel of these.

    Parameters
    ----------
    path
        The meta-kernel; the others have its name and their own suffixes.
    structure
        Number of the sensor in the CK, at most -1000; that of the spacecraft and its clock is a thousandth of it.
    """
    spice = load_spice()
    if not path.name.isascii() or len(path.name) > MAX_NAME:
        raise EmulatorError(
            f"{path}: SPICE cannot read a file of this name; give one of at most {MAX_NAME} ASCII characters"
        )
    files = {suffix: path.with_suffix(suffix) for suffix in (".tls", ".tsc", ".bc")}
    names = ",\n".join("'" + file.name.replace("'", "''") + "'" for file in files.values())
    # beside the old ones until they are whole: these may be what is converted, and the disk may be full
    with TemporaryDirectory(prefix=".starhil-", dir=path.parent) as folder:
        parts = {suffix: Path(folder, f"part{suffix}") for suffix in files}
        _write_parts(spice, truth, parts, structure, path)
        parts[path.suffix] = Path(folder, "part.tm")
        parts[path.suffix].write_text(META.format(names), encoding="ascii")
        for suffix, file in (files | {path.suffix: path}).items():
            parts[suffix].replace(file)


def _write_parts(spice: Any, truth: FileTruth, files: Mapping[str, Path], structure: int, path: Path) -> None:
    """Write all kernels but the meta-kernel."""
    has_rates = truth.rates_rad_s is not None
    with _kernels(spice, path):
        files[".tls"].write_text(_leap_seconds(), encoding="ascii")
        spice.furnsh(str(files[".tls"]))
        zero_s = truth.spans[0].begin_s
        begin_et = (truth.start_unix_s or 0.0) + zero_s - J2000_UNIX_S
        begin_et += spice.deltet(begin_et, "UTC")
        clock = CLOCK.replace("$", str(-structure // 1000)).format(spice.unitim(begin_et, "ET", "TDT"))
        files[".tsc"].write_text(clock, encoding="ascii")
        handle = spice.ckopn(str(files[".bc"]), "starhil", 0)
        for span in truth.spans:
            times, states = truth.states_in(span)
            ticks = TICKS_PER_S * (times - zero_s)
            matrices = np.array([state.attitude.matrix for state in states])
            rates = np.zeros((len(ticks), 3))
            if has_rates:
                rates = np.einsum("nji,nj->ni", matrices, [state.rate_rad_s for state in states])
            spice.ckw03(
                handle, ticks[0], ticks[-1], structure, "J2000", has_rates, "starhil",
                len(ticks), ticks, [spice.m2q(matrix) for matrix in matrices], rates, 1, ticks[:1],
            )  # fmt: skip
        spice.ckcls(handle)


def _leap_seconds() -> str:
    """Return a leap-seconds kernel with the table of `erfa`."""
    import erfa

    return LEAP_SECONDS.format("\n".join(
        f"{row['tai_utc']:g}, @{row['year']}-{row['month']:02d}-01"
        for row in erfa.leap_seconds.get()
        if row["year"] >= 1972
    ))  # fmt: skip
