"""`uorb demo`: a vehicle of two hosts on this machine, an autopilot and a companion computer.

Each host is a process with a bus of its own; a link over Zenoh joins them, as it would join two boards.
"""
