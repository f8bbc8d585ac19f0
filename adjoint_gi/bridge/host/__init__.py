"""Blender itself: versions, files, preferences, notices."""
