"""Spatial algebra: inertial parameters of rigid bodies, quaternions and rotation matrices."""
