"""A robot's hand at a target: poses where it would grip, their clearances, and how its arm reaches them."""
