"""A serial link: framing, header, check, and the stack that puts them together."""
