"""Random procedures under random fault plans, and what has to be true after each."""
