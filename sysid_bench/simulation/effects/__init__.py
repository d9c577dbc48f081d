"""Unmodelled effects of the simulated plant, as plug-ins."""
