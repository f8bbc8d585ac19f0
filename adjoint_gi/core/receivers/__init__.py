"""Where an answer is wanted."""
