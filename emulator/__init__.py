"""The star-sensor emulator: truth, sky and sensor model, device, links and command line."""
