"""Jobs of `submit`, `resume` and `extend`: on this machine, on a cluster or detached."""
