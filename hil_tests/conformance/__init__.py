"""Conformance: table-driven cases that look for faults in a device over its bus, on hardware as well as on the emulator."""
