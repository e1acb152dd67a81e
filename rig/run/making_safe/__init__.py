"""Make a bench safe whose run cannot: the guard, and what may be lifted off what it presses."""
