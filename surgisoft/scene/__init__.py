"""Geometry: meshes, collision, rays, ablation, camera. Knows no arm physics."""
