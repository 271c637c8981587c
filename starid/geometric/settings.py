"""Columns of the settings that the identification kernels take, one array of numbers."""

from __future__ import annotations

from typing import Final

SEARCH_TOLERANCE: Final = 0
"""Largest error of a triangle's side, radians."""
MAGNITUDE_GATE: Final = 1
"""Largest deviation of a star's magnitude from what its flux says, magnitudes."""
MAX_TRIANGLES: Final = 2
"""Triangles of detections looked up before giving up."""
SCALE_TOLERANCE: Final = 3
"""Relative error of the focal length, 0 where it is known."""
WINDOW: Final = 4
"""First matching window, pixels."""
TEST_WINDOW: Final = 5
"""Window of the sequential test, radians."""
LARGEST_SIGMA: Final = 6
"""Largest centroid noise believed, pixels per axis."""
LOG_CHANCE: Final = 7
"""Logarithm of the largest probability of a false answer, lost in space."""
LOG_CHANCE_TRACKING: Final = 8
"""The same near a predicted attitude."""
PX_PER_RAD: Final = 9
"""Least pixels per radian in the field."""
SIGMAS_KNOWN: Final = 10
"""Not 0 where the errors of the positions are given."""
FIELD_PX: Final = 11
"""Pixels in the field."""
PART_STARS: Final = 12
"""Brightest detections of each part of the field that triangles are made of, 0 for none."""
SETTING_COUNT: Final = 13

NOTHING: Final = 0
ACCEPTED: Final = 1
TOO_FEW: Final = 2
"""Status of an answer."""
