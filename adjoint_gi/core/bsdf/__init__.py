"""How surfaces scatter."""
