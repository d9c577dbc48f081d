"""Checks of a compiled model: finite numbers, unit warnings, MuJoCo's own warnings."""
