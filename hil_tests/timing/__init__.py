"""Links under load: lost frames, latency, jitter."""
