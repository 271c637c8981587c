"""Wire protocols: interface definitions, codecs, framing, CANopen, transports and exports."""
