"""Surfaces cut into finite elements."""
