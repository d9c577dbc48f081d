"""Checks of a diagnosis: one kind of mistake in a recording or its model per file."""
