"""Reading of MJCF: allowed files and sizes, inertias of meshes and geoms, joint terms."""
