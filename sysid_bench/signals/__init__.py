"""Recordings from files to filtered rows: log descriptions, readers, filters, pipelines."""
