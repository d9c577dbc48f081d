"""Checks of a model, one family per file; each yields findings."""
