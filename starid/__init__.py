"""Star catalogue, camera, detection, identification and attitude: the numerics of a star tracker.

Public names are imported from their modules on first use, to keep ``import starid`` quick.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from starid.attitude import Attitude as Attitude
    from starid.camera import Camera as Camera
    from starid.camera.file import load_camera as load_camera
    from starid.camera.file import save_camera as save_camera
    from starid.catalog import StarCatalog as StarCatalog
    from starid.catalog import load_catalog as load_catalog
    from starid.catalog.aberration import aberrated as aberrated
    from starid.catalog.earth import earth_velocity as earth_velocity
    from starid.identification.geometric.identifier import Identifier as Identifier
    from starid.identification.solution import Solution as Solution
    from starid.identification.star_identifier import make_identifier as make_identifier
    from starid.identification.tracker import Tracker as Tracker
    from starid.identification.undetected import missing_stars as missing_stars
    from starid.imaging.detection import Detections as Detections
    from starid.imaging.detection import DetectionSettings as DetectionSettings
    from starid.imaging.detection import detect as detect

_HOMES: Final = {
    "Attitude": "starid.attitude",
    "Camera": "starid.camera",
    "DetectionSettings": "starid.imaging.detection",
    "Detections": "starid.imaging.detection",
    "Identifier": "starid.identification.geometric.identifier",
    "Solution": "starid.identification.solution",
    "StarCatalog": "starid.catalog",
    "Tracker": "starid.identification.tracker",
    "aberrated": "starid.catalog.aberration",
    "detect": "starid.imaging.detection",
    "earth_velocity": "starid.catalog.earth",
    "load_camera": "starid.camera.file",
    "load_catalog": "starid.catalog",
    "make_identifier": "starid.identification.star_identifier",
    "missing_stars": "starid.identification.undetected",
    "save_camera": "starid.camera.file",
}
"""Public name → module that holds it."""


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'starid' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
