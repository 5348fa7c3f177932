"""Estimates of success rates from cheap and dear labels, and the choice of candidates to label."""
