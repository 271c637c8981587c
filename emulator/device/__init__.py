"""The device: modes, parameters, time, frames, and the handlers of every row of the interface definition."""
