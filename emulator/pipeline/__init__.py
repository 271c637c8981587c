"""The image pipeline: renders, detects and identifies in a worker process, and the queue in front of it."""
