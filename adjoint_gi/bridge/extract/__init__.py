"""Depsgraph to SceneArrays."""
