"""Phi = <L, g> = <W, Le> (Eq. 3 and 4)."""
