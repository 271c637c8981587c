"""The wire: interface definition, framing, segmentation and transports (sans-I/O codecs first)."""
