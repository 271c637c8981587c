"""Wire protocols: interface definitions, codecs, framing, segmentation, CANopen, transports and exports."""
