"""Evaluation of methods on trials: metrics, intervals, closed loop, benchmark and report."""
