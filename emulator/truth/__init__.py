"""Where the sensor looks: the truth of a run, from a formula, a file or a live feed."""
