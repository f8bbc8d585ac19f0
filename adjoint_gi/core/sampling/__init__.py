"""Random and quasi-random points, and maps from them."""
