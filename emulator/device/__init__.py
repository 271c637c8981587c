"""The device: modes, parameters, time, frames, and the quantities and actions to which rows are bound."""
