"""The bench: from a bench file to connected instruments that refuse what exceeds their limits."""
