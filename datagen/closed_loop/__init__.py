"""The closed loop: robots are sent to methods' picks, arrive with an error, plan from there, and execute."""
