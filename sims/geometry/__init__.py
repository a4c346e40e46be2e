"""Paths, vectors, meshes and kinematics that the sims share."""
