"""Indices into the array of settings for the identification kernels."""

from __future__ import annotations

from typing import Final

SEARCH_TOLERANCE: Final = 0
"""Largest error of a triangle's side, radians."""
MAGNITUDE_GATE: Final = 1
"""Largest difference between a star's catalogue magnitude and the magnitude from its flux."""
MAX_TRIANGLES: Final = 2
"""Largest number of triangles of detections looked up."""
SCALE_TOLERANCE: Final = 3
"""Relative error of the focal length; 0 if it is known."""
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
"""Lowest scale in the field, pixels per radian."""
SIGMAS_KNOWN: Final = 10
"""Non-zero if the caller provides position errors."""
FIELD_PX: Final = 11
"""Number of pixels in the field."""
PART_STARS: Final = 12
"""Number of detections, brightest first, that form triangles in each part of the field; 0 for none."""
BETA_X: Final = 13
BETA_Y: Final = 14
BETA_Z: Final = 15
"""Velocity of the observer over the speed of light, ICRS; zeros if aberration is not corrected."""
SETTING_COUNT: Final = 16

NOTHING: Final = 0
ACCEPTED: Final = 1
TOO_FEW: Final = 2
"""Status of an answer."""
