"""What verbs do with the task `actuators`: identify, excite, diagnose."""
