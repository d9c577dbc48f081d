"""Unmodelled effects of the simulated plant, as plug-ins: one file per effect."""
