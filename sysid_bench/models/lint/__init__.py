"""Checks of a model file as a model of dynamics, from the file alone."""
