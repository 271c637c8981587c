"""Truth and orbit files; the content of a file, not its name, says which format it has.

===============  ==================================================================  =================
format           begins with                                                         module
===============  ==================================================================  =================
CCSDS AEM, OEM   ``CCSDS_AEM_VERS``, ``CCSDS_OEM_VERS``, or an XML element           `ccsds_file`
STK .a, .e       ``stk.v.``                                                          `stk_file`
SPICE            ``KPL/MK``, a meta-kernel                                           `spice_file`
CSV              anything else                                                       `csv_file`
===============  ==================================================================  =================

The first useable date of a file is its time zero. Messages about CSV do not quote the file, because a client of the
control channel may name files that it must not read; those about the others quote only names of frames and formats.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from starhil.emulator.errors import EmulatorError
from starhil.emulator.truth.ccsds_file import is_ccsds, read_aem, read_oem
from starhil.emulator.truth.csv_file import read_csv
from starhil.emulator.truth.spice_file import META_KERNEL, read_kernels
from starhil.emulator.truth.stk_file import STK, read_attitude, read_ephemeris
from starhil.emulator.truth.table import FileTruth, OrbitTable
from starhil.protocol.files.user_file import read_user_text

MAX_BYTES: Final = 500_000_000
"""Maximum size of a truth file: a day at 50 rows per second."""


def read_truth_file(path: Path) -> FileTruth:
    text = _text("truth file", path)
    if is_ccsds(text):
        return read_aem(path, text)
    if text.startswith(STK):
        return read_attitude(path, text)
    if text.startswith(META_KERNEL):
        return read_kernels(path)
    return read_csv(path, text)


def read_orbit_file(path: Path) -> OrbitTable:
    """Read positions and velocities with dates."""
    text = _text("orbit file", path)
    if is_ccsds(text):
        return read_oem(path, text)
    if text.startswith(STK):
        return read_ephemeris(path, text)
    raise EmulatorError(f"orbit file {path}: must be a CCSDS OEM or an STK ephemeris (.e)")


def _text(what: str, path: Path) -> str:
    try:
        return read_user_text(path, MAX_BYTES)
    except UnicodeDecodeError as error:
        reason = f"not UTF-8, {error.reason}; of SPICE, give a meta-kernel"
    except OSError as error:
        reason = error.strerror or str(error)
    raise EmulatorError(f"{what} {path}: cannot be read ({reason})")
