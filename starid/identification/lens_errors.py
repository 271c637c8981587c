"""The uncertainty of the camera in that of an attitude."""

from __future__ import annotations

from dataclasses import replace

from starid.arithmetic.arrays import Array
from starid.camera import Camera
from starid.camera.position_errors import attitude_covariance
from starid.identification.geometric.refinement import PRIOR_FREEDOM
from starid.identification.solution import Solution


def with_lens_errors(
    solution: Solution,
    camera: Camera,
    camera_covariance: Array,
    xy_px: Array,
    errors_px: Array,
    offset_px: Array,
) -> Solution:
    """Return a solution by a calibrated camera with the covariance that its stars' and the camera's errors give it.

    The arguments after the solution are those of `starid.camera.position_errors.attitude_covariance`.
    """
    covariance, noise_px = attitude_covariance(
        camera, camera_covariance, xy_px, errors_px, offset_px, PRIOR_FREEDOM
    )
    return replace(solution, covariance=covariance, sigma_px=noise_px)
