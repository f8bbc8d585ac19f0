"""T and T* on elements x directions."""
