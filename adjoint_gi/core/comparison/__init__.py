"""Methods against one reference within one budget, as numbers, pictures and a page."""
