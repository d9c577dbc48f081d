"""Verb of sites of results."""
