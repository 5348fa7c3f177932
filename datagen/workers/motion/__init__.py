"""Motion planning of an arm to a grasp, without physics."""
