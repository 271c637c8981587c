"""Reading of TOML files."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from starhil.emulator.errors import EmulatorError, explained
from starid.files import read_text


def read_toml(path: Path, what: str) -> dict[str, Any]:
    """Read a TOML file; `what` is its kind, for messages: `profile`, `scenario`."""
    try:
        with explained(f"{what} {path}: cannot be read", "give a TOML file"):
            text = read_text(path)
        return tomllib.loads(text)
    except UnicodeDecodeError as error:
        raise EmulatorError(f"{what} {path}: not UTF-8 ({error.reason}); give a TOML file") from None
    except tomllib.TOMLDecodeError as error:
        raise EmulatorError(f"{what} {path}: not TOML ({error})") from None
    except RecursionError:
        raise EmulatorError(f"{what} {path}: nested too deeply") from None
