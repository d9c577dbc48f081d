"""Verbs of twins: fit and compare one, compare methods on them."""
