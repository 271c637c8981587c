"""CAN frames, and messages in them."""
