"""What is lit: arrays, colours, triangles in Embree."""
