"""The test bench: OBC client, session runner, pytest plugin and conformance suite."""
