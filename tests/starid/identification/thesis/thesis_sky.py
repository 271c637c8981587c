"""Shared by the tests of the thesis's algorithms: catalogue at its epoch, databases built once per run."""

from __future__ import annotations

import functools

import numpy as np

from starid.catalog import StarCatalog, load_catalog
from starid.identification.thesis.database import DatabaseParameters, FeatureDatabase, build_database
from starid.identification.thesis.lsi import LostInSpace


@functools.cache
def thesis_catalog() -> StarCatalog:
    return load_catalog(epoch=1991.25)


@functools.cache
def database(percent: float) -> FeatureDatabase:
    return build_database(thesis_catalog(), DatabaseParameters(overlap=percent / 100.0))


@functools.cache
def lost_in_space(percent: float, precision: str = "exact") -> LostInSpace:
    return LostInSpace(database(percent), precision=precision)


def thesis_frames(every: int = 1):
    """Centres of the 1 701 published frames, or of every n-th of them."""
    k, m = np.meshgrid(np.arange(63), np.arange(27), indexing="ij")
    return (22.0 + 5.0 * k).ravel()[::every], (-68.0 + 5.0 * m).ravel()[::every]
