"""The geometry of a camera: directions to pixels and back, and its calibration."""

from starid.camera.camera import DEFAULT_CAMERA, DEFAULT_FOV_DEG, Camera, Model

__all__ = ["DEFAULT_CAMERA", "DEFAULT_FOV_DEG", "Camera", "Model"]
