"""Diagnosis of recordings: evidence, findings, and checks that are run group by group."""
