"""Robot models: `load.load_robot` turns a manifest and a payload into a `robot.RobotModel`.

Files: sources, urdf (text, links), mjcf (files, inertias), dh_table, data_sets, manifest. Robot:
assembly (free base, locked joints, payload), tree, joint_terms (and limits), sensor, coupling/
(mimic joints, closed chains). Others: pairing (Pinocchio), model_checks, lint, writing/ (identified
models), random_robot.
"""
