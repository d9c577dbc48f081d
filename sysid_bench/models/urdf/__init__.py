"""Reading of URDF: canonical text, link tree, joint types, inertia repair."""
