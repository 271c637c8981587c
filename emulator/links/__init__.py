"""Links that connect the device to a bus: serial, CAN and CANopen."""
