"""What slip and roll trials share: a skin pressed on an object at a controlled normal force."""
