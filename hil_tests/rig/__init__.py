"""The surroundings of a unit under test: emulator, links, control channel, bus, folder."""
