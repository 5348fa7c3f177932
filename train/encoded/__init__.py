"""Training from tokens that are made once a run: many trainings of small models in minutes."""
