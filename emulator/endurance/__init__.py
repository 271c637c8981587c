"""The emulator as the unit under test of an endurance run: in memory, in simulated time."""
