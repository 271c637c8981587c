"""Solving photographs by any camera: the field of view may be unknown, and the lens is calibrated."""
