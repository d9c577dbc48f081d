"""Design of motions and of commands for actuators."""
