"""Star identification with `solve-field` of astrometry.net, which is run once for each scene.

The program reads positions from a FITS table and writes the projection as a FITS header; the few lines of code
for both are here. The Debian packages `astrometry.net` and `astrometry-data-tycho2-10-19` contain the program
and an index of patterns from 1° to 33°.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from starid.attitude import Attitude
from starid.attitude.wahba import solve_wahba
from starid.camera import Camera

PROGRAM: Final = "solve-field"
TIME_LIMIT_S: Final = 5.0
"""Limit of the processor time per scene."""

SCALE_MARGIN: Final = 0.05
"""Relative uncertainty of the field width passed to the program."""

_CARD: Final = 80
_BLOCK: Final = 2880
_PROBES: Final = 3


def installed() -> bool:
    return shutil.which(PROGRAM) is not None


def version() -> str:
    answer = subprocess.run([PROGRAM, "--version"], capture_output=True, text=True, check=False)  # noqa: S603
    words = (answer.stdout + answer.stderr).replace(",", " ").split()
    return next((word for word in words if word[:1].isdigit()), "unknown")


def find_attitude(
    camera: Camera, xy_px: NDArray[np.float64], flux: NDArray[np.float64], folder: Path
) -> NDArray[np.float64] | None:
    """Return the ICRS→sensor matrix (3, 3) of a scene, or None if the program finds none.

    Parameters
    ----------
    camera : Camera
        Pinhole without distortion.
    xy_px, flux : ndarray (n, 2), (n,)
        Positions and brightness.
    folder : Path
        Folder for the files of the program.
    """
    table, header = folder / "field.xyls", folder / "field.wcs"
    header.unlink(missing_ok=True)
    table.write_bytes(star_table(xy_px, flux, camera))
    width = camera.fov_deg
    command = [
        PROGRAM, "--no-plots", "--overwrite", "--dir", str(folder),
        "--width", str(camera.width), "--height", str(camera.height),
        "--x-column", "X", "--y-column", "Y", "--sort-column", "FLUX",
        "--scale-units", "degwidth",
        "--scale-low", f"{width * (1.0 - SCALE_MARGIN):.4f}", "--scale-high", f"{width * (1.0 + SCALE_MARGIN):.4f}",
        "--tweak-order", "1", "--crpix-center", "--no-remove-lines", "--uniformize", "0", "--cpulimit", f"{TIME_LIMIT_S:g}",
        *(word for name in ("new-fits", "match", "rdls", "corr", "index-xyls", "solved") for word in (f"--{name}", "none")),
        "--wcs", str(header), str(table),
    ]  # fmt: skip
    subprocess.run(command, capture_output=True, check=False)  # noqa: S603 -- our own command line
    if not header.is_file():
        return None
    return attitude_of(read_header(header.read_bytes()), camera).matrix


def _cards(values: Mapping[str, str]) -> bytes:
    """Return a FITS header block."""
    text = "".join(f"{key:<8}= {value:>20}".ljust(_CARD) for key, value in values.items()) + "END".ljust(
        _CARD
    )
    return text.ljust(-(-len(text) // _BLOCK) * _BLOCK).encode("ascii")


def star_table(xy_px: NDArray[np.float64], flux: NDArray[np.float64], camera: Camera) -> bytes:
    """Return a FITS file with a table of X, Y (counted from 1) and FLUX."""
    rows = np.column_stack([xy_px + 1.0, flux]).astype(">f8")
    columns = {
        key: value
        for number, name in enumerate(("X", "Y", "FLUX"), 1)
        for key, value in ((f"TTYPE{number}", f"'{name:<8}'"), (f"TFORM{number}", "'1D      '"))
    }
    primary = _cards({"SIMPLE": "T", "BITPIX": "8", "NAXIS": "0", "EXTEND": "T"})
    extension = {
        "XTENSION": "'BINTABLE'", "BITPIX": "8", "NAXIS": "2", "NAXIS1": "24", "NAXIS2": str(len(rows)), "PCOUNT": "0",
        "GCOUNT": "1", "TFIELDS": "3", **columns, "IMAGEW": str(camera.width), "IMAGEH": str(camera.height),
    }  # fmt: skip
    data = rows.tobytes()
    return primary + _cards(extension) + data.ljust(-(-len(data) // _BLOCK) * _BLOCK, b"\0")


def read_header(content: bytes) -> dict[str, float]:
    numbers: dict[str, float] = {}
    for start in range(0, len(content), _CARD):
        card = content[start : start + _CARD].decode("ascii", "replace")
        if card.startswith("END "):
            break
        if card[8:10] == "= ":
            try:
                numbers[card[:8].strip()] = float(card[10:].partition("/")[0])
            except ValueError:
                continue  # text or a logical value
    return numbers


def attitude_of(header: Mapping[str, float], camera: Camera) -> Attitude:
    """Return the attitude of a camera from the gnomonic projection of its image (CRVAL, CRPIX, CD)."""
    ra, dec = np.radians([header["CRVAL1"], header["CRVAL2"]])
    steps = np.linspace(0.1, 0.9, _PROBES)
    xy = np.array([[x * camera.width, y * camera.height] for x in steps for y in steps])
    matrix = np.array([[header["CD1_1"], header["CD1_2"]], [header["CD2_1"], header["CD2_2"]]])
    plane = np.radians((xy + 1.0 - [header["CRPIX1"], header["CRPIX2"]]) @ matrix.T)
    centre = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    north = np.cross(centre, east)
    sky = centre + plane[:, :1] * east + plane[:, 1:] * north
    return solve_wahba(camera.back_project(xy), sky / np.linalg.norm(sky, axis=1, keepdims=True))
