"""What carries topics between hosts: PX4's uORBCommunicator verbs and their implementations.

This package knows nothing of `uorb_net`. Zenoh is imported when a channel is started, not before.
"""
