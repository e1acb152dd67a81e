"""The bench: from a bench file to connected instruments that refuse values outside their limits."""
