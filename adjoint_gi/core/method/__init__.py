"""What a method is, and how it is driven."""
