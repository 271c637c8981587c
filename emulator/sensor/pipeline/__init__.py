"""The image pipeline: rendering, detection and identification in a worker process, and its request queue."""
