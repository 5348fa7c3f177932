"""Grasps of an object by a parallel gripper, computed once per object and cached by content."""
