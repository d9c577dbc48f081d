"""Completion of verbs, options and values in a shell: quick, so almost nothing is imported."""
