"""Verbs of `sysid-bench`: a file for each, its request, what runs, and its result."""
