"""Accuracy of models against the cost of their labels, and the label source to buy next."""
