"""What the sensor sees and what comes of it: sky, lens, pixels, and the pipeline that makes and solves frames."""
