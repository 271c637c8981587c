"""Real ports and buses: tty, pty, TCP, SocketCAN, python-can, and the CAN hub."""
