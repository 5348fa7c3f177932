"""Motion: whether and how an arm gets its hand to a grasp, without physics."""
