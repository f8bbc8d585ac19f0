"""T, T* and the schemes on diffuse elements."""
