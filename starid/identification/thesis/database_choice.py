"""Choice of the feature database of an identifier: a given file, or the camera's database from the cache."""

from __future__ import annotations

import dataclasses
import hashlib
import logging
from collections.abc import Collection
from pathlib import Path
from typing import Final

import numpy as np

from starid.catalog import StarCatalog
from starid.identification.thesis.database import (
    DatabaseError,
    DatabaseParameters,
    FeatureDatabase,
    build_database,
)
from starid.identification.thesis.database_file import load_database, save_database
from starid.storage.cache import cache_dir, evict, mark_used

DATABASE_VERSION: Final = 1
"""Part of the name of a cached database; incremented when its contents change."""

_log = logging.getLogger(__name__)


def given_database(path: Path, parameters: DatabaseParameters, stars: Collection[str]) -> FeatureDatabase:
    """Load a database file, if it fits the identifier.

    Parameters
    ----------
    path
        File written by `save_database`.
    parameters
            Parameters of the database that the identifier would build; grid and brightness limit may differ.
        stars
            Identities of the star lists from which the file may have been made.

    Raises
    ------
    DatabaseError
        The file cannot be used, or belongs to another camera, catalogue, band or geometry.
    """
    database = load_database(path)
    made = database.parameters
    if made.geometry != parameters.geometry:
        raise DatabaseError(
            f"database: {path} is {made.geometry}; a sensor needs one with --geometry {parameters.geometry}"
        )
    numbers = (made.focal_px, made.half_width_px)
    if not np.allclose(numbers, (parameters.focal_px, parameters.half_width_px), rtol=1e-6):
        raise DatabaseError(
            f"database: {path} belongs to another camera: focal length {numbers[0]:.2f} px and field radius "
            f"{numbers[1]:.2f} px, not {parameters.focal_px:.2f} and {parameters.half_width_px:.2f}"
        )
    if made.direction != parameters.direction or made.full_field != parameters.full_field:
        raise DatabaseError(f"database: {path} does not hold circles of the brightest stars; build it again")
    if made.band != parameters.band:
        raise DatabaseError(
            f"database: {path} has {made.band} magnitudes; a sensor needs one with --band {parameters.band}"
        )
    if database.catalog_identity not in stars:
        raise DatabaseError(
            f"database: {path} belongs to another catalogue or epoch ({database.catalog_identity}); build it again"
        )
    return database


def obtain_database(stars: StarCatalog, parameters: DatabaseParameters, *, cache: bool) -> FeatureDatabase:
    """Map the database from the cache, or build it and, if possible, cache it.

    Parameters
    ----------
    stars, parameters
        Stars and parameters of the database.
    cache
        Use the cache folder.

    Raises
    ------
    DatabaseError, StaridError
        The parameters do not define a grid, or no star is left.
    """
    if not cache:
        return build_database(stars, parameters)
    text = repr((DATABASE_VERSION, stars.identity, dataclasses.astuple(parameters)))
    key = hashlib.sha256(text.encode()).hexdigest()[:16]
    path = cache_dir() / f"features-{key}.bin"
    stored = _load(path)
    if stored is not None:
        mark_used(path)
        return stored
    database = build_database(stars, parameters)
    try:
        save_database(database, path)
        evict(keep=path)
    except DatabaseError as error:
        _log.warning("%s: built again each time", error)
    return database


def _load(path: Path) -> FeatureDatabase | None:
    """Load a cached database; None if there is none or, with a warning in the log, it cannot be used."""
    try:
        if not path.is_file():
            return None
        return load_database(path)
    except (OSError, DatabaseError) as error:
        _log.warning("cache file %s is not usable (%s): built again", path, error)
        return None
