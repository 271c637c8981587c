"""Control of a run: faults, scenarios and the control channel."""
