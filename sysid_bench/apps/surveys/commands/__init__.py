"""Verb of surveys: the cross-check of every model of a collection."""
