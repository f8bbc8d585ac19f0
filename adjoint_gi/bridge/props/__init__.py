"""What is asked: Blender properties and requests."""
