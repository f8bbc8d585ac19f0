"""The step between solving and writing that takes noise out."""
