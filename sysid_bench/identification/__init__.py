"""Identification: parameters from regressor and torque, without access to robot model or engine."""
