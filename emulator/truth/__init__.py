"""The true attitude of the sensor during a run: computed, from a file or from a live feed."""
