"""One bake, in the foreground or in the background."""
