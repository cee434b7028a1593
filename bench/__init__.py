"""Measured ratios: each module's ``run`` compares this package with a control in the same run."""
