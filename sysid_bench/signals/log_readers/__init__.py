"""Readers of recorded files: one format per file."""
