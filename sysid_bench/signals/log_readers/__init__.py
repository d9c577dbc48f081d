"""Readers of recorded files, by what a file holds: arrays, tables or messages."""
