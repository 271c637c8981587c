"""The camera of the sensor: optics, detector, noise and fixed pattern, and the renderer of its images."""
