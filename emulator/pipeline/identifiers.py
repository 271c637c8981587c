"""The identifier that answers, and the one that is made beside it when the device's parameters ask for another.

Another limiting magnitude or another camera needs another star index, which takes seconds to build. The one in force
answers meanwhile.
"""

from __future__ import annotations

import importlib
import inspect
import threading
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, Final, get_args, get_type_hints

from starhil.emulator.errors import EmulatorError
from starid.camera import Camera
from starid.catalog import StarCatalog
from starid.errors import StaridError
from starid.interface import ALGORITHMS, StarIdentifier, make_identifier

_KINDS: Final[dict[str, tuple[type, ...]]] = {
    "float": (int, float),
    "int": (int,),
    "bool": (bool,),
    "str": (str,),
}
"""Word in an annotation → what a profile may give for it."""


@dataclass(frozen=True)
class IdentifierChoice:
    """What an identifier is made for.

    Attributes
    ----------
    algorithm
        `geometric`, `lsi` or `rsi`.
    camera
        The device's own idea of its camera.
    margin
        Largest error of a triangle's side as a share of the nominal one; the geometric algorithm's.
    options
        Keywords of the algorithm's class and their values, sorted.
    """

    algorithm: str
    camera: Camera
    margin: float
    options: tuple[tuple[str, Any], ...]

    def make(self, catalog: StarCatalog) -> StarIdentifier:
        """Make it; seconds where its index is not on the disk.

        Raises
        ------
        EmulatorError, StaridError
            No such option, or no index can be made of these values.
        """
        options = dict(self.options)
        self._check(options)
        if self.algorithm == "geometric":
            from starid.geometric.identifier import Effort

            nominal = Effort()
            options["effort"] = replace(nominal, tolerance_px=nominal.tolerance_px * self.margin)
        return make_identifier(self.algorithm, self.camera, catalog, **options)

    def _check(self, options: dict[str, Any]) -> None:
        """Refuse an option that the algorithm does not have, or of another type."""
        module, name = ALGORITHMS[self.algorithm]
        known = _known_options(getattr(importlib.import_module(module), name))
        for option, value in options.items():
            if option not in known:
                raise EmulatorError(
                    f"identifier.{option}: no option of the algorithm {self.algorithm}; known: {', '.join(sorted(known))}"
                )
            allowed = tuple(kind for word, kinds in _KINDS.items() if word in known[option] for kind in kinds)
            if not isinstance(value, allowed) or (isinstance(value, bool) and bool not in allowed):
                raise EmulatorError(
                    f"identifier.{option}: {value!r} given, {known[option].removesuffix(' | None')} needed"
                )


def _known_options(algorithm: type) -> dict[str, str]:
    """Options of an algorithm's class and their types: its keywords, and the fields of its options."""
    types = {name: str(item.annotation) for name, item in inspect.signature(algorithm).parameters.items()}
    for held in get_args(get_type_hints(vars(algorithm)["__init__"]).get("options")):
        if is_dataclass(held):
            types |= {field.name: str(field.type) for field in fields(held)}
    return {name: kind for name, kind in types.items() if any(word in kind for word in _KINDS)}


@dataclass(frozen=True)
class _Job:
    """An identifier in the making."""

    choice: IdentifierChoice
    future: Future[StarIdentifier]


class Identifiers:
    """Gives the identifier for a choice, or the one before it while that is being made.

    Parameters
    ----------
    make
        Makes an identifier.
    beside
        Make them in a thread; otherwise where they are asked for, and whoever asks waits.
    """

    def __init__(self, make: Callable[[IdentifierChoice], StarIdentifier], *, beside: bool) -> None:
        self._make = make
        self._beside = beside
        self._in_force: tuple[IdentifierChoice, StarIdentifier] | None = None
        self._refused: tuple[IdentifierChoice, EmulatorError | StaridError] | None = None
        self._job: _Job | None = None

    def get(self, choice: IdentifierChoice) -> tuple[StarIdentifier, bool]:
        """Return the identifier in force, and whether it is the one for this choice.

        Raises
        ------
        EmulatorError, StaridError
            None can be made for this choice; said again each time that it is asked for.
        """
        self._take_finished()
        if self._in_force is None or not self._beside:
            if self._in_force is None or self._in_force[0] != choice:
                self._in_force = (choice, self._make(choice))
            return self._in_force[1], True
        in_force, identifier = self._in_force
        if in_force == choice:
            return identifier, True
        if self._refused is not None and self._refused[0] == choice:
            error = self._refused[1]
            raise type(error)(str(error))
        if self._job is None:
            self._job = self._start(choice)
        return identifier, False

    def _take_finished(self) -> None:
        """Put an identifier that is ready in force; one that nobody asks for any more goes with the next."""
        if self._job is None or not self._job.future.done():
            return
        job, self._job = self._job, None
        try:
            self._in_force = (job.choice, job.future.result())
        except (EmulatorError, StaridError) as error:
            self._refused = (job.choice, error)

    def _start(self, choice: IdentifierChoice) -> _Job:
        future: Future[StarIdentifier] = Future()

        def work() -> None:
            try:
                future.set_result(self._make(choice))
            except Exception as error:  # noqa: BLE001 (raised again where the result is taken)
                future.set_exception(error)

        threading.Thread(target=work, name="identifier", daemon=True).start()
        return _Job(choice, future)
