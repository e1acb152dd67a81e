"""The bench: from a bench file to connected instruments that refuse what is outside their limits."""
