"""The links that bind the device to a wire: serial and CAN."""
