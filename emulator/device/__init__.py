"""The device: modes, parameters, time, frames, and the quantities and actions that rows are bound to."""
