"""Trials: planned grasps executed in physics."""
