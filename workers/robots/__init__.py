"""Robots: one file of cited constants each. ROBOTS is the registry; `open_robot` opens one."""
