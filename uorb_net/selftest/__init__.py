"""uORB's own self test, on the shared bus of this machine: what each part does, and how it is run."""
