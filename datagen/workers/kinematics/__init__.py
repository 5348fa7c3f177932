"""How bodies on trees of joints move, reach and touch, in machine code."""
