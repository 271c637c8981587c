"""The sensor's camera: optics, detector, noise, fixed pattern, and the renderer of its images."""
