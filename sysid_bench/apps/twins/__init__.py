"""Twins of recorded robots: effects fitted from a recording, replays, and how well they agree."""
