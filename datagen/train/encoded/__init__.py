"""Training from tokens that are made once per run: many trainings of small models in minutes."""
