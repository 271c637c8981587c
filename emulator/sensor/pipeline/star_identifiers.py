"""The current star identifier, and building of a new one in the background when parameters change.

A new limiting magnitude or camera needs a new star index, which takes seconds to build. Until it is
ready, frames are solved with the current identifier.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from starhil.emulator.errors import EmulatorError
from starhil.emulator.sensor.pipeline.messages import CatalogUpset
from starid.camera import Camera
from starid.catalog import StarCatalog
from starid.errors import StaridError
from starid.identification.star_identifier import StarIdentifier, make_identifier

if TYPE_CHECKING:
    from starid.identification.geometric.identifier import Identifier


@dataclass(frozen=True)
class StarIdentifierSetup:
    """Everything a star identifier depends on."""

    algorithm: str
    camera: Camera
    """Camera as calibrated in the device's parameters."""
    margin: float
    """Tolerance of triangle sides relative to the nominal one; geometric algorithm only."""
    options: tuple[tuple[str, Any], ...]
    """Fields of the algorithm's options, sorted by name."""
    upsets: tuple[CatalogUpset, ...] = ()
    """Bits flipped in the directions of the stars; geometric algorithm only."""

    def make(self, catalog: StarCatalog) -> StarIdentifier:
        """Make the star identifier, which takes seconds if its index is not cached on disk."""
        options = dict(self.options)
        if self.algorithm != "geometric":
            return make_identifier(self.algorithm, self.camera, catalog, **options)
        from starid.identification.geometric.identifier import Effort, Identifier

        nominal = Effort()
        options["effort"] = replace(nominal, tolerance_px=nominal.tolerance_px * self.margin)
        identifier = Identifier(self.camera, catalog, **options)
        for upset in self.upsets:
            identifier = _with_upset(identifier, upset)
        return identifier


def _with_upset(identifier: Identifier, upset: CatalogUpset) -> Identifier:
    """Return the identifier with one bit of a star's direction flipped; unchanged if it lacks the star."""
    rows = np.flatnonzero(identifier.stars.hip == upset.hip)
    if len(rows) == 0:
        return identifier
    direction = identifier.directions[rows[0]].copy()
    bits = direction.astype(np.float32).view(np.uint32)
    bits[upset.component] ^= np.uint32(1 << upset.bit)
    direction[upset.component] = bits.view(np.float32)[upset.component]
    return identifier.with_direction(int(rows[0]), direction)


class StarIdentifiers:
    """Provides the star identifier for a setup, or the previous one while it is being built.

    It is built in a thread if `in_background`; otherwise, and for the first one, `get` blocks until that is done.
    """

    def __init__(self, make: Callable[[StarIdentifierSetup], StarIdentifier], *, in_background: bool) -> None:
        self._make = make
        self._in_background = in_background
        self._current: tuple[StarIdentifierSetup, StarIdentifier] | None = None
        self._failed: tuple[StarIdentifierSetup, EmulatorError | StaridError] | None = None
        self._build: tuple[StarIdentifierSetup, Future[StarIdentifier]] | None = None

    def get(self, setup: StarIdentifierSetup) -> tuple[StarIdentifier, bool]:
        self._adopt_finished_build()
        if self._current is None or not self._in_background:
            return self.build(setup), True
        current_setup, identifier = self._current
        if current_setup == setup:
            return identifier, True
        if self._failed is not None and self._failed[0] == setup:
            error = self._failed[1]
            raise type(error)(str(error))
        if self._build is None:
            self._build = (setup, self._start_build(setup))
        return identifier, False

    def build(self, setup: StarIdentifierSetup) -> StarIdentifier:
        """Return the star identifier for this setup, and discard a build in the background."""
        self._build = None
        if self._current is None or self._current[0] != setup:
            self._current = (setup, self._make(setup))
        return self._current[1]

    def _adopt_finished_build(self) -> None:
        """Switch to a finished build, even if the setup has changed since; the next one will replace it."""
        if self._build is None or not self._build[1].done():
            return
        (setup, future), self._build = self._build, None
        try:
            self._current = (setup, future.result())
        except (EmulatorError, StaridError) as error:
            self._failed = (setup, error)

    def _start_build(self, setup: StarIdentifierSetup) -> Future[StarIdentifier]:
        future: Future[StarIdentifier] = Future()

        def build() -> None:
            try:
                future.set_result(self._make(setup))
            except Exception as error:  # noqa: BLE001 (raised again by future.result())
                future.set_exception(error)

        threading.Thread(target=build, name="star-identifier", daemon=True).start()
        return future
