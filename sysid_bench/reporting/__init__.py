"""Rows become tables, figures, pages and recordings."""
