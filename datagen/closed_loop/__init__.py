"""The closed loop: robots are sent to the picks of methods, arrive off them, plan from there, and execute."""
