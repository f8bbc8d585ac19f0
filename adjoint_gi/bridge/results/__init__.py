"""What bakes leave in the file."""
