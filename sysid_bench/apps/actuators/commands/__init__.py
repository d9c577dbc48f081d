"""Verbs identify, excite and diagnose with the task `actuators`."""
