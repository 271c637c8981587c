"""Positions of the settings in the array that the identification kernels receive."""

from __future__ import annotations

from typing import Final

SEARCH_TOLERANCE: Final = 0
"""Largest error of a triangle's side, radians."""
MAGNITUDE_GATE: Final = 1
"""Largest deviation of a star's catalogue magnitude from the one of its flux."""
MAX_TRIANGLES: Final = 2
"""Most triangles of detections looked up."""
SCALE_TOLERANCE: Final = 3
"""Relative error of the focal length, 0 where it is known."""
WINDOW: Final = 4
"""First matching window, pixels."""
TEST_WINDOW: Final = 5
"""Window of the sequential test, radians."""
LARGEST_SIGMA: Final = 6
"""Largest centroid noise accepted, pixels per axis."""
LOG_CHANCE: Final = 7
"""Logarithm of the largest probability of a false answer, lost in space."""
LOG_CHANCE_TRACKING: Final = 8
"""The same near a predicted attitude."""
PX_PER_RAD: Final = 9
"""Least pixels per radian in the field."""
SIGMAS_KNOWN: Final = 10
"""Not 0 where the caller provides the errors of the positions."""
FIELD_PX: Final = 11
"""Pixels in the field."""
PART_STARS: Final = 12
"""Brightest detections of each part of the field that form triangles, 0 for none."""
BETA_X: Final = 13
BETA_Y: Final = 14
BETA_Z: Final = 15
"""Velocity of the observer over that of light, ICRS; zeros where aberration is not corrected."""
SETTING_COUNT: Final = 16

NOTHING: Final = 0
ACCEPTED: Final = 1
TOO_FEW: Final = 2
"""Status of an answer."""
