"""Robot models: `load.load_robot` turns a manifest and a payload into a `robot.RobotModel`.

Files: urdf/ (canonical text, inertia repair), mjcf/ (files, inertias, joint terms), dh/ (tables).
Robot: tree, joint_terms, limits, payload, tool, sensor, lock_joints, free_base, coupling/ (mimic
joints, closed chains). Others: pairing (Pinocchio), checks/ (units), writing/ (identified models),
random/.
"""
