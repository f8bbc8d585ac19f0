"""Monte Carlo transport: walks that gather and walks that shoot."""
