"""Identification of photographs by any camera: the field may be unknown, the calibration is found."""
