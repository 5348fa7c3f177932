"""Grasps: where a parallel gripper can take an object, found once an object and kept by content."""
