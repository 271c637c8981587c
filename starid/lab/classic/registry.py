"""The published algorithms by name."""

from __future__ import annotations

import importlib
from typing import Any, Final, cast

from starid.camera import DEFAULT_CAMERA, Camera
from starid.catalog import StarCatalog
from starid.identification import star_identifier
from starid.identification.star_identifier import StarIdentifier

CLASSICS: Final = (
    "pyramid",
    "grid",
    "modified-grid",
    "improved-grid",
    "match-group",
    "geometric-voting",
    "iterative",
    "subgraph",
    "log-polar",
    "vector-pattern",
    "svd",
    "oriented-svd",
    "pole-star",
    "radial-cyclic",
    "radial-dynamic-cyclic",
    "multi-poles",
    "ant-colony",
    "correlation",
)
"""Names of the published algorithms; module and class are named after them (`oriented_svd`, `OrientedSvdIdentifier`)."""


def make_identifier(
    algorithm: str, camera: Camera = DEFAULT_CAMERA, catalog: StarCatalog | None = None, **options: Any
) -> StarIdentifier:
    """Make a star identifier as `starid.make_identifier` does, or one of `CLASSICS`."""
    if algorithm not in CLASSICS:
        return star_identifier.make_identifier(algorithm, camera, catalog, **options)
    return cast("StarIdentifier", class_of(algorithm)(camera, catalog, **options))


def class_of(algorithm: str) -> Any:
    """Return the class of one of `CLASSICS`."""
    module = importlib.import_module(f"starid.lab.classic.{algorithm.replace('-', '_')}")
    return getattr(module, f"{algorithm.title().replace('-', '')}Identifier")
