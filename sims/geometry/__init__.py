"""Paths, vectors, meshes and kinematics shared by the sims."""
