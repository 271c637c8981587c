"""What stands around a unit under test: emulator, links, control channel, bus, folder."""
