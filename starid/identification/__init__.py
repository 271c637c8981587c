"""Star identification, and the attitude that follows from it."""
