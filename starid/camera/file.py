"""Camera profiles: a camera and its calibration in a small TOML file.

The table ``[camera]`` holds the keys of `starid.camera.Camera.to_dict`. Only this table is read, so a device
profile that has one is also a camera profile. The table ``[calibration]`` records where the values come from.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from starid.camera.calibration import NAMES, Calibration
from starid.camera.camera import Camera
from starid.errors import StaridError
from starid.storage.files import read_text, write_atomically


def save_camera(path: str | Path, camera: Camera, calibration: Calibration | None = None) -> None:
    """Write a camera profile atomically.

    Parameters
    ----------
    path : path
        File to write or replace.
    camera : Camera
        The camera.
    calibration : Calibration, optional
        If given, its figures and covariance are written too.

    Raises
    ------
    StaridError
        The file cannot be written.
    """
    tables: dict[str, Mapping[str, Any]] = {"camera": camera.to_dict()}
    if calibration is not None:
        tables["calibration"] = {
            "frames": len(calibration.attitudes),
            "stars": calibration.star_count,
            "rms_px": calibration.rms_px,
            "sigma_px": calibration.sigma_px,
            "estimated": list(calibration.estimated),
            "parameters": list(NAMES),
            "sigma": [calibration.sigmas[name] for name in NAMES],
            "covariance": calibration.covariance.tolist(),
        }
    lines = []
    for name, table in tables.items():
        lines += [f"[{name}]", *(f"{key} = {_toml(value)}" for key, value in table.items()), ""]
    text = "\n".join(lines)
    target = Path(path)
    try:
        write_atomically(target, lambda part: part.write_text(text, encoding="utf-8"))
    except OSError as error:
        raise StaridError(
            f"camera profile {target}: cannot be written ({error.strerror}); choose another path"
        ) from None


def load_camera(path: str | Path) -> Camera:
    """Read the camera of a profile.

    Raises
    ------
    StaridError
        The file is missing or not TOML, has no table [camera], or holds an unknown key or invalid value.
    """
    source = Path(path)
    try:
        content = tomllib.loads(read_text(source))
    except FileNotFoundError:
        raise StaridError(f"camera profile {source}: no such file; write one with starid calibrate") from None
    except OSError as error:
        raise StaridError(f"camera profile {source}: cannot be read ({error.strerror})") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise StaridError(f"camera profile {source}: is not valid TOML ({error}); correct it") from None
    except ValueError:
        raise StaridError(
            f"camera profile {source}: is not valid TOML (a number has too many digits); correct it"
        ) from None
    table = content.get("camera")
    if not isinstance(table, dict):
        raise StaridError(
            f"camera profile {source}: no table [camera]; add one with width, height and fov_deg"
        )
    try:
        return Camera.from_dict(table)
    except StaridError as error:
        raise StaridError(f"camera profile {source}: {error}") from None


def _toml(value: object) -> str:
    """Format a value as TOML: a number, text without special characters, or a list of these."""
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, list):
        return f"[{', '.join(_toml(item) for item in value)}]"
    return repr(value)
