"""The camera of the sensor: optics, detector, noise, fixed pattern, and the renderer."""
