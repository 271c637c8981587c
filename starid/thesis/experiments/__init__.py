"""The thesis's experiments, made again from the real catalogue, beside what was published."""
