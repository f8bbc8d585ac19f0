"""Methods against one reference, on Blender's scene: asked, run, shown, written."""
