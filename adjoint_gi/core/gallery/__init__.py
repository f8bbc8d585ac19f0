"""Scenes built by hand, without Blender."""
