"""Results of long computations on disk: a sealed file per finished part, and a plan that identifies them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from starid.errors import StaridError
from starid.storage.files import open_regular, read_text, write_atomically

PLAN_FILE: Final = "plan.json"
SEAL: Final = "seal_"
"""Name of the array with the seal of a part."""

Results = dict[str, NDArray[Any]]
"""Results of a part: named arrays."""


def write_results(path: Path, results: Mapping[str, NDArray[Any]]) -> None:
    """Write the results of a part atomically.

    Raises
    ------
    OSError
        The file cannot be written.
    """

    def write(temporary: Path) -> None:
        with temporary.open("wb") as stream:
            np.savez_compressed(stream, **results)  # type: ignore[arg-type]  # no result is named allow_pickle

    write_atomically(path, write)


def read_results(path: Path, what: str) -> Results:
    """Read the results of a part.

    Parameters
    ----------
    path
        The file.
    what
        The kind of computation, for messages.

    Raises
    ------
    StaridError
        The file is damaged.
    """
    try:
        with open_regular(path) as stream, np.load(stream, allow_pickle=False) as stored:
            return {name: np.asarray(stored[name]) for name in stored.files}
    except Exception as error:  # numpy and zipfile raise nearly any for a damaged file
        raise StaridError(
            f"{what}: {path} cannot be read ({error}); remove it to compute it again"
        ) from error


class ResultStore:
    """A folder with a plan and one file per finished part.

    Parameters
    ----------
    folder
        Created if missing.
    plan
        What the results depend on: JSON values, and tables one level deep.
    what
        The kind of computation, for messages.

    Raises
    ------
    StaridError
        The folder contains another plan, or cannot be used.
    """

    def __init__(self, folder: Path, plan: Mapping[str, Any], what: str) -> None:
        self.folder = folder
        self._what = what
        plan_file = folder / PLAN_FILE
        content = json.loads(json.dumps(plan))
        self._plan = json.dumps(content, sort_keys=True)
        try:
            if plan_file.exists():
                self._check_same(plan_file, content)
                return
            text = json.dumps(content, indent=1, sort_keys=True)
            write_atomically(plan_file, lambda temporary: temporary.write_text(text, encoding="utf-8"))
        except OSError as error:
            raise StaridError(
                f"{what}: {folder} cannot be used: {error.strerror}; give another folder"
            ) from error

    def file(self, part: str) -> Path:
        return self.folder / f"{part}.npz"

    def load(self, part: str) -> Results | None:
        """Return the results of a part, or None if it is not finished.

        Raises
        ------
        StaridError
            The file is damaged, was changed, or belongs to another part or plan.
        """
        file = self.file(part)
        if not file.exists():
            return None
        results = read_results(file, self._what)
        seal = results.pop(SEAL, None)
        if seal is None or str(seal) != self._seal(part, results):
            raise StaridError(
                f"{self._what}: {file} was not written by this {self._what} or was changed; remove it to compute "
                "it again"
            )
        return results

    def save(self, part: str, results: Mapping[str, NDArray[Any]]) -> None:
        """Save the results of a finished part.

        Raises
        ------
        StaridError
            The file cannot be written.
        """
        file = self.file(part)
        try:
            write_results(file, {**results, SEAL: np.array(self._seal(part, results))})
        except OSError as error:
            raise StaridError(
                f"{self._what}: {file} cannot be written: {error.strerror}; run the same command again to resume"
            ) from error

    def _seal(self, part: str, results: Mapping[str, NDArray[Any]]) -> str:
        """Return a hash of plan, part and results."""
        seal = hashlib.sha256(repr((self._plan, part)).encode())
        for name, values in sorted(results.items()):
            seal.update(repr((name, values.dtype.descr, values.shape)).encode())
            seal.update(values.tobytes())
        return seal.hexdigest()

    def _check_same(self, plan_file: Path, content: dict[str, Any]) -> None:
        """Reject a plan file with other content; the error names the first difference."""
        try:
            kept = json.loads(read_text(plan_file))
        except (ValueError, RecursionError) as error:
            raise StaridError(
                f"{self._what}: {plan_file} cannot be read ({error}): give another folder"
            ) from error
        there, here = _flat(kept if isinstance(kept, dict) else {}), _flat(content)
        for key in sorted(there.keys() | here.keys()):
            if there.get(key) != here.get(key):
                made_by = key.startswith("made_by.")
                remedy = "the version that made it" if made_by else "the same options"
                raise StaridError(
                    f"{self._what}: {plan_file} holds another plan: {key} is {there.get(key)!r} there and "
                    f"{here.get(key)!r} here: give another folder, or {remedy}"
                )


def _flat(content: Mapping[str, Any]) -> dict[str, Any]:
    """Flatten a plan: keys of inner tables become TABLE.KEY."""
    flat: dict[str, Any] = {}
    for key, value in content.items():
        if isinstance(value, dict):
            flat |= {f"{key}.{inner}": item for inner, item in value.items()}
        else:
            flat[key] = value
    return flat
