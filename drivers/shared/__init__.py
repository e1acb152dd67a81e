"""Protocol code that several drivers share."""
