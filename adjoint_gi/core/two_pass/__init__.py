"""Elements first, walks that gather after."""
