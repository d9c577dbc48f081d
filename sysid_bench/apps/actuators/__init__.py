"""Actuators of robots with known links: armature, friction, offset and delay from recordings."""
