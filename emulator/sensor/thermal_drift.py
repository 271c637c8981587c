"""Effects of temperature on the optics: focal length, distortion and direction of the boresight."""

from __future__ import annotations

import dataclasses

import numpy as np

from starhil.emulator.sensor.model import SensorModel
from starid.arrays import Array
from starid.attitude import ARCSEC_PER_RAD
from starid.camera import Camera


def drifted_camera(camera: Camera, sensor: SensorModel, temperature_c: float) -> Camera:
    """Return the camera at a temperature; unchanged at the sensor's `reference_c` or without drift."""
    above = temperature_c - sensor.reference_c
    if above == 0.0 or (sensor.focal_drift == 0.0 and sensor.k1_drift == 0.0):
        return camera
    scale = 1.0 + sensor.focal_drift * above
    k1, k2, p1, p2, k3 = camera.distortion
    return dataclasses.replace(
        camera,
        focal_px=(camera.focal_px[0] * scale, camera.focal_px[1] * scale),
        distortion=(k1 + sensor.k1_drift * above, k2, p1, p2, k3),
    )


def boresight_drift_rad(sensor: SensorModel, temperature_c: float) -> Array:
    """Return the rotation vector (3,) of the optics relative to the mounting, radians, sensor frame."""
    drift = np.array([sensor.boresight_drift_x, sensor.boresight_drift_y, sensor.boresight_drift_z])
    return np.asarray(drift * ((temperature_c - sensor.reference_c) / ARCSEC_PER_RAD))
